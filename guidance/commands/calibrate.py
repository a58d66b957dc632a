"""Calibrate opponent, stiffness and thresholds on unguided play of the nine training users.

    airhockey calibrate

The opponent: the newest generation against which the nine win 35 to 55 % of their rounds, which last 12 to 25 s.
T_low and T_high of UT (Eq. 5): so that the mean W_unc in that play is the paper's (section 6.1).
K of Eq. 4, for T_lookahead: the largest that leaves the hands of 95 % of the nine damped. The state holds one's own
paddle, so UPHG's target moves ahead of the hand by a lead L that grows with T_lookahead, and its spring pushes along
the motion by K L v: negative damping. Stable is K L <= 0.8 (B + b), B the damping of the relaxed arm, b the device's.

Writes calibration.yaml, the values and what they rest on, into its run folder. A value takes effect when it is copied
into conf/: calibration never changes a study by itself.
"""

from dataclasses import replace

from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import write_text
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.run_folder import output_folder

OPPONENT_TRIAL, THRESHOLD_TRIAL = 1000, 2000  # in the seeds, where a study has the number of its condition


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "every")
    require_counts(cfg, "games", least=2)  # UA from one, uncertainty in the others
    require_numbers(cfg, "w_unc.optimal", "w_unc.user", "low_over_high", at_most=0.999)
    require_numbers(cfg, "stability.rule.share", "stability.rule.of_people", at_most=1.0)
    require_numbers(cfg, "stability.rule.step")
    if not all(isinstance(seconds, float) and 0 <= seconds <= 1 for seconds in cfg.stability.lookaheads):
        raise InputError(f"stability.lookaheads = {cfg.stability.lookaheads} must be numbers from 0 to 1")


def main(cfg: DictConfig) -> None:
    import numpy as np

    from airhockey_marl.envs.physics import TableSpec
    from airhockey_marl.league.league import League
    from airhockey_marl.players.inference import greedy_player
    from guidance.simulated_users import SimulatedUsers, load_advisors, load_population, training_people
    from guidance.study import calibration
    from guidance.study.games import Games, no_force, play_games
    from guidance.study.protocol import Protocol, user_and_table_states
    from guidance.study.setup import load_lookahead, load_models

    with report_input_errors():
        people = training_people(cfg.seed, load_population(cfg.users))
        advisors = load_advisors(cfg.users.advisors)
        protocol = replace(construct(Protocol, cfg.study, "study"), familiarization=0)
        models, lookahead = load_models(cfg), load_lookahead(cfg)
        league = League.load(cfg.models.opponents)
        if cfg.opponent is not None:
            league.generation(cfg.opponent)
    progress = ProgressBar()

    def play(generation: int, trial: int, demonstrations: bool = False) -> Games:
        """Each of the nine plays `games` games: rows are person by person."""
        states = [user_and_table_states(cfg.seed, range(len(people)), trial + game) for game in range(cfg.games)]
        minds, serves = (np.stack(part, axis=1).ravel() for part in zip(*states, strict=True))
        users = SimulatedUsers(np.repeat(people, cfg.games), minds, TableSpec(), cfg.users.variant, advisors)
        opponent = greedy_player(league.player(generation))
        return play_games(users, opponent, no_force, protocol, TableSpec(), serves, demonstrations)

    trials = {}
    candidates = [cfg.opponent] if cfg.opponent is not None else range(0, len(league), cfg.every)
    for i, generation in enumerate(candidates):
        games = play(generation, OPPONENT_TRIAL)
        trials[generation] = {
            "win_rate": round(float(np.nanmean(games.results["win_rate"])), 3),
            "round_seconds": round(float(games.seconds.sum() / games.rounds.sum()), 1),
        }
        progress("opponents", (i + 1) / len(candidates))
    opponent = cfg.opponent
    if opponent is None:
        opponent = calibration.select_opponent(trials, cfg.win_rate, cfg.round_seconds)

    progress("thresholds", 0.0)
    states = play(opponent, THRESHOLD_TRIAL, demonstrations=True).demonstrations
    thresholds = {
        name: calibration.threshold(std, cfg.w_unc[name], cfg.low_over_high)
        for name, std in calibration.predicted_std(models, states, cfg.games, lookahead).items()
    }
    progress("thresholds", 1.0)
    progress.close()
    damping = people["stiffness"] * people["damping_time"] + people["device_damping"]
    player, stable = greedy_player(league.player(opponent)), {}
    for seconds in sorted({*cfg.stability.lookaheads, lookahead.seconds}):
        ahead = replace(lookahead, seconds=seconds)
        lead = calibration.target_lead(models, states, cfg.games, ahead)
        stable[seconds] = {
            "lead": round(float(lead.mean()), 4),
            "stiffness": calibration.max_stable_stiffness(lead, damping, **cfg.stability.rule),
            "optimal_wins": round(calibration.lookahead_win_rate(models, player, ahead, cfg.seed), 3),
        }
    values = {
        "opponent": opponent,
        "stiffness": stable[lookahead.seconds]["stiffness"],
        "thresholds": thresholds,
        "evidence": {"opponents": trials, "stable": stable, "models": models.hashes},
    }
    text = OmegaConf.to_yaml(OmegaConf.create(values))
    write_text(output_folder(cfg) / "calibration.yaml", text)
    print(text)
