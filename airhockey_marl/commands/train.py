"""Train the optimal action model: a league of generations that learn by playing those before them (section 3.2.2).

    airhockey train                          the paper's 100 generations x 200 K steps
    airhockey train +preset=smoke            seconds, to see that it runs
    airhockey train -m seed=0,1,2            three seeds, one after another
    airhockey train collector=multisync collector.workers=4    play collected by four processes
    airhockey train resume=outputs/train/...  continue a stopped run
    tensorboard --logdir outputs             watch

Writes into its run folder: league.safetensors (every generation), matches.csv (each generation against earlier ones and
the scripted players), card.json (configuration and scores), TensorBoard's files, and state.safetensors, from which
`resume` continues. All are written after each generation, whole or not at all; a resumed run ends bit for bit as one
that was never stopped, but for the tags `speed/`, which depend on the clock.
"""

from contextlib import closing

from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import write_json
from airhockey_marl.experiment.run_folder import card_facts, lock_run_folder, note_headline


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "generations", "steps_per_generation", "batch", "env.tables", "env.frame_skip")
    require_counts(cfg, "league.opponents", "league.match_rounds", "league.match_every")
    require_counts(cfg, "shaping.generations", "pictures_every", least=0)
    require_numbers(cfg, "gamma", "league.win_rate_decay", at_most=1.0)
    require_numbers(cfg, "env.round_seconds")
    require_numbers(cfg, "action_cost", least=0.0)
    for total, part in (("batch", "env.tables"), ("steps_per_generation", "batch"), ("env.tables", "league.opponents")):
        dividend, divisor = OmegaConf.select(cfg, total), OmegaConf.select(cfg, part)
        if dividend % divisor:
            raise InputError(f"{total} = {dividend} must be a multiple of {part} = {divisor}")


def main(cfg: DictConfig) -> float:
    """Train; for a sweeper, the last generation's share of decided rounds against the strongest script."""
    import torch

    from airhockey_marl.experiment.tensorboard import log_final_scores
    from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
    from airhockey_marl.self_play.league_training import STRONGEST_SCRIPT, LeagueTraining, model_card, train_league

    with report_input_errors():
        for name in cfg.league.scripted_players:
            SCRIPTED_PLAYERS.find(name, "league.scripted_players")
        torch.manual_seed(cfg.seed)
        training = LeagueTraining(cfg)
    with closing(training.trainer.workers), lock_run_folder(cfg) as folder:
        train_league(training, folder)
        card = model_card(cfg, training.league)
        write_json(folder / "card.json", card | card_facts(cfg, training.seconds))
        scores = card["win_rate_of_last_against"]
        against = {"generation 0": scores["0"], STRONGEST_SCRIPT: scores[STRONGEST_SCRIPT]}
        note_headline(folder, "beats " + ", ".join(f"{name} {rate:.3g}" for name, rate in against.items()))
        # the page shows the first five by name until it is asked for others: the scripts come first
        tags = {
            f"{'against' if name in SCRIPTED_PLAYERS else 'generation'}_{name}": rate for name, rate in scores.items()
        }
        log_final_scores(folder, cfg, tags, card["steps"])
    return scores[STRONGEST_SCRIPT]
