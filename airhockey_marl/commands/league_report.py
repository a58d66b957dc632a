"""Report the strength of a league: payoff matrix, ratings, saves, and the STD by situation.

    airhockey league_report                         the shipped league
    airhockey league_report run=outputs/train/...   one of your own

Writes league_report.html, the page, league_report.json, payoff.csv, ratings.csv, the figures and match.gif into its run
folder, and what TensorBoard reads.
"""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import load_json
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import output_folder


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "every", "rounds", "match_rounds", "save_tables", "std_tables")
    require_counts(cfg, "exploit_generations", least=0)
    require_numbers(cfg, "std_seconds")


def main(cfg: DictConfig) -> None:
    from airhockey_marl.evaluation.league_metrics import EvaluationConfig, check_league, evaluate_league
    from airhockey_marl.evaluation.league_report import LAYOUT, TAGS, log_to_tensorboard, summary, write_report
    from airhockey_marl.evaluation.matches import match_options
    from airhockey_marl.evaluation.ratings import read_matches
    from airhockey_marl.experiment.tensorboard import log_run_header, open_writer, tensorboard_dir
    from airhockey_marl.league.league import League
    from airhockey_marl.self_play.best_response import best_response

    with report_input_errors():
        run = Path(cfg.run)
        league = League.load(run / "league.safetensors")
        matches = read_matches(run / "matches.csv") if (run / "matches.csv").is_file() else None
        check_league(league, matches)
        card = read_card(run / "card.json", league.hashes)
        if cfg.exploit_generations and "config" not in card:
            raise InputError(f"exploit_generations = {cfg.exploit_generations} needs a finished run: {run} has no card")
        training = OmegaConf.create(card.get("config", {}))
        sizes = cfg.every, cfg.rounds, cfg.match_rounds, cfg.save_tables, cfg.std_tables, cfg.std_seconds
        config = EvaluationConfig(*sizes, cfg.seed, **match_options(training.get("env", {})))
    folder, progress, responses = output_folder(cfg), ProgressBar(), None
    if cfg.exploit_generations:
        last, rounds = len(league) - 1, cfg.match_rounds
        responses = best_response(training, league, last, cfg.exploit_generations, rounds, cfg.seed, progress)
    metrics = evaluate_league(league, matches, config, responses, progress)
    progress.close()
    write_report(folder, league, matches, card, config, metrics)
    with open_writer(tensorboard_dir(folder)) as writer:
        log_run_header(writer, cfg, TAGS, LAYOUT)
        log_to_tensorboard(writer, folder, metrics, card.get("steps", metrics.last))
    for row in summary(metrics):
        print(f"{row.outcome:>4}  {row.claim}: {row.observation}")
    print(f"report: {folder / 'league_report.html'}")


def read_card(path: Path, hashes: list[str]) -> dict:
    """The card beside a league, without its list of hashes; {} if there is none, as while a run is not finished."""
    if not path.is_file():
        return {}
    card = load_json(path)
    if card.get("hashes") != hashes:
        raise InputError(f"{path} is the card of another league: its hashes are not those of league.safetensors")
    return {key: value for key, value in card.items() if key != "hashes"} | {"hash_of_last": hashes[-1]}
