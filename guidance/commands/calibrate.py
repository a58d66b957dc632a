"""Calibrate before a study, on people who are not in it: opponent, guidance, and thresholds of UT.

    airhockey calibrate                               the opponent, the pilot, the thresholds
    airhockey calibrate opponent=55                   without the search for the opponent
    airhockey calibrate guidance=stability 'pilot.people=[]'    the former rule: the guidance stays as configured
    airhockey calibrate resume=outputs/calibrate/...  continue a stopped run

The opponent: the newest generation against which the nine training users win 35 to 55 % of their rounds, which last 12
to 25 s.
The pilot: T_lookahead and its reading, K, F_max, the user prediction model and the optimal action model with which
pilot people win the largest share of rounds under OAHG and UPHG (UA), on average; by successive halving, see
guidance/study/calibration. Only the predictor that errs least at the horizon at which it is used is tried, and
only springs under which the nine can hold the hand still.
T_low and T_high of UT (Eq. 5): so that the mean W_unc in unguided play of the nine is the paper's (section 6.1).
Beside them the former rule for K: the largest that leaves 95 % of the nine hands damped. The state holds one's own
paddle, so UPHG's target moves ahead of the hand by a lead L that grows with T_lookahead, and its spring pushes along
the motion by K L v: negative damping. Stable is K L <= 0.8 (B + b), B the damping of the relaxed arm, b the device's.

Writes into its run folder: calibration.yaml, the values and what they rest on; opponents.csv, predictors.csv,
holding.csv, games.csv (every pilot game), candidates.csv, pilot.png. A value takes effect when it is copied into conf/:
calibration never changes a study by itself.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import write_text
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.run_folder import lock_run_folder, note_headline

if TYPE_CHECKING:
    from guidance.study.calibration.pilot import Pilot
    from guidance.study.protocol import Protocol
    from guidance.study.setup import PlaySetup
    from guidance.user_model.data import Demonstrations

STATE_FILE = "opponents.csv"  # the first that a run writes
OPPONENT_TRIAL, THRESHOLD_TRIAL = 1000, 2000  # in the seeds, where a study has the number of its condition


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "every", "pilot.together", "pilot.unseen")
    require_counts(cfg, "games", "pilot.demonstrations.games", least=2)  # UA from one, uncertainty in the others
    require_counts(cfg, "pilot.demonstrations.ticks", least=100)
    require_numbers(cfg, "w_unc.optimal", "w_unc.user", "low_over_high", at_most=0.999)
    require_numbers(cfg, "stability.rule.share", "stability.rule.of_people", "pilot.holding.of_people", at_most=1.0)
    require_numbers(cfg, "stability.rule.step", "pilot.holding.wander", "pilot.holding.seconds")
    pilot, search = cfg.pilot, cfg.pilot.search
    for name, values in (("people", pilot.people), ("left", pilot.left)):
        if not all(isinstance(value, int) and value >= 1 for value in values):
            raise InputError(f"pilot.{name} = {list(values)} must be whole numbers of at least 1")
    if pilot.people and len(pilot.left) != len(pilot.people) - 1:
        raise InputError(f"pilot.left = {list(pilot.left)} must be a number for each of pilot.people but the last")
    for name, values, most in (
        ("stability.lookaheads", cfg.stability.lookaheads, 1.0),
        ("pilot.search.lookahead", search.lookahead, 1.0),
        ("pilot.search.stiffness", search.stiffness, 1e4),
        ("pilot.search.limit", search.limit, 1e4),
    ):
        if not all(isinstance(value, float) and 0 <= value <= most for value in values):
            raise InputError(f"{name} = {list(values)} must be numbers from 0.0 to {most}")
    for name, values in search.items():
        if not len(values):
            raise InputError(f"pilot.search.{name} = {values} must hold at least one value")


def main(cfg: DictConfig) -> None:
    from airhockey_marl.league.league import League
    from airhockey_marl.players.inference import greedy_player
    from guidance.forces.lookahead import Lookahead
    from guidance.simulated_users import load_population, training_people
    from guidance.statistics.pilot_figure import draw_pilot
    from guidance.study.calibration.search import Tables, choose_guidance
    from guidance.study.calibration.unguided import UnguidedPlay, former_rule, select_opponent, thresholds
    from guidance.study.protocol import Protocol
    from guidance.study.setup import load_lookahead, load_models, load_play_setup

    with report_input_errors():
        nine = training_people(cfg.seed, load_population(cfg.users))
        protocol = construct(Protocol, cfg.study, "study")
        setup = load_play_setup(OmegaConf.merge(cfg, {"opponent": cfg.opponent or 0}))
        league, lookahead, models = League.load(cfg.models.opponents), load_lookahead(cfg), load_models(cfg)
        generations = [cfg.opponent] if cfg.opponent is not None else range(0, len(league), cfg.every)
        opponents = {generation: greedy_player(league.player(generation)) for generation in generations}
        pilot = load_pilot(cfg, setup, protocol) if cfg.pilot.people else None
    unguided = UnguidedPlay(nine, setup, replace(protocol, familiarization=0), cfg.games, cfg.seed)
    progress = ProgressBar()
    with lock_run_folder(cfg) as folder:
        tables = Tables(folder)
        against = partial(unguided.against, opponents, OPPONENT_TRIAL, partial(progress, "opponents"))
        trials = tables.get("opponents", against)
        generation = cfg.opponent
        if generation is None:
            generation = select_opponent(trials, cfg.win_rate, cfg.round_seconds)
        opponent, result = opponents[generation], {"opponent": int(generation)}
        if pilot is not None:
            pilot = replace(pilot, setup=replace(setup, opponent=opponent))
            unseen = partial(unseen_games, cfg, pilot.setup)
            options = OmegaConf.to_container(cfg.pilot, resolve=True)
            best = choose_guidance(pilot, nine, unseen, options, tables, progress)
            draw_pilot(tables.read("candidates"), folder / "pilot.png")
            result["pilot"] = best._asdict()
            lookahead, models = Lookahead(best.lookahead, best.reading), pilot.models(best.league, best.predictor)
        progress("thresholds", 0.0)
        states = unguided.play(opponent, THRESHOLD_TRIAL, demonstrations=True).demonstrations
        result["thresholds"] = thresholds(models, states, cfg.games, lookahead, cfg.w_unc, cfg.low_over_high)
        progress("thresholds", 1.0)
        progress.close()
        ahead = [replace(lookahead, seconds=t) for t in sorted({*cfg.stability.lookaheads, lookahead.seconds})]
        rule = former_rule(models, states, cfg.games, nine, ahead, opponent, cfg.stability.rule, cfg.seed)
        result["evidence"] = {"opponents": trials.round(3).to_dict("records"), "stable": rule, "models": models.hashes}
        text = OmegaConf.to_yaml(OmegaConf.create(result))
        write_text(folder / "calibration.yaml", text)
        note_headline(folder, "calibration.yaml" if pilot is None else ", ".join(map(str, best)))
    print(text)


def load_pilot(cfg: DictConfig, setup: PlaySetup, protocol: Protocol) -> Pilot:
    """The pilot of a configuration."""
    from guidance.simulated_users import load_population, pilot_people
    from guidance.study.calibration.pilot import Pilot
    from guidance.study.models import SHIPPED, Models

    people = pilot_people(sum(cfg.pilot.people), cfg.pilot.seed, load_population(cfg.users))

    def load(league: str, folder: Path) -> Models:
        return Models.load(league, cfg.models.generation, folder / "user.safetensors", folder / "meta.safetensors")

    folders = [SHIPPED / name if (SHIPPED / name).is_dir() else Path(name) for name in cfg.pilot.search.predictor]
    predictors = {folder.name: load(cfg.models.league, folder) for folder in folders}
    leagues = {name: load(file, folders[0]) for name, file in cfg.pilot.search.league.items()}
    return Pilot(people, setup, leagues, predictors, cfg.guidance.spring.reach, protocol, cfg.pilot.seed)


def unseen_games(cfg: DictConfig, setup: PlaySetup) -> Demonstrations:
    """Unguided games of people like the training users, on whom no model was trained."""
    import numpy as np

    from guidance.simulated_users import load_population, training_people
    from guidance.study.demonstrations import collect_demonstrations

    population, seeds = load_population(cfg.users), range(cfg.seed + 1, cfg.seed + 1 + cfg.pilot.unseen)
    people = np.concatenate([training_people(seed, population) for seed in seeds])
    return collect_demonstrations(people, setup, **cfg.pilot.demonstrations, seed=cfg.pilot.seed)
