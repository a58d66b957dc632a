"""Film a simulated person or a recorded game: intention, predictions of the models, and force.

    airhockey watch                              a striker under OAHG (UT), 20 s
    airhockey watch user=wall condition=nhg      somebody else, without guidance
    airhockey watch speed=0.4                    in slow motion
    airhockey watch user=null                    the first person of the study with this seed
    airhockey watch run=outputs/play/...         a game that was played at the window, again

Writes into its run folder: watch.gif, watch.png (six of its moments) and watch.csv (a row per tick).
"""

from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict import TensorDict

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import atomic_write
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.registry import construct
from guidance.display.film import MIN_WIDTH, FilmInfo, draw_sheet, save_film
from guidance.forces.conditions import ADAPTED
from guidance.sessions.tick_log import TickLog, load_recorded_part, scene_facts, tapped_guidance
from guidance.simulated_users import Population, SimulatedUsers, sample_people
from guidance.simulated_users.force_response import check_variant
from guidance.simulated_users.intention import Intention
from guidance.study.games import GameRunner, no_force, play_games
from guidance.study.protocol import CALIBRATION_GAME, RandomStream, spawn_rng_states
from guidance.study.setup import StudySetup, load_setup

LONGEST = 60  # s: all pictures of a film are in memory together
MOST_SKILL = 4.0  # standard deviations


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for values that cannot be used."""
    require_counts(cfg, "threads", "frames_per_second")
    require_counts(cfg, "seed", least=0)
    require_numbers(cfg, "seconds", at_most=LONGEST)
    require_numbers(cfg, "start", least=0.0)
    require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)


def main(cfg: DictConfig) -> None:
    """Film the game, and print how it ended."""
    with report_input_errors():
        check_film(cfg, round(1 / TableSpec().tick))
        check_variant(cfg.users.variant)
        again = None if cfg.run is None else load_recorded_part(Path(cfg.run), cfg.game, cfg.start, cfg.seconds)
    torch.set_num_threads(cfg.threads)
    progress = ProgressBar()
    ticks, facts = again if again is not None else simulated(cfg, progress)
    info = FilmInfo(
        table=TableSpec(),
        title=facts["title"],
        player=facts["player"],
        opponent=facts["opponent"],
        guiding_models=frozenset(facts["used"]),
        is_adapted=facts["adapted"],
        width=cfg.width,
        is_simulated="wanted_x" in ticks,
    )
    folder, tick = Path(HydraConfig.get().runtime.output_dir), info.table.tick
    with atomic_write(folder / "watch.csv") as temporary:
        ticks.to_csv(temporary, index=False, float_format="%.6g")
    with atomic_write(folder / "watch.png") as temporary:
        draw_sheet(ticks, info).save(temporary)
    every = round(1 / (tick * cfg.frames_per_second))
    shown = 10 * round(100 * every * tick / cfg.speed)  # ms; a GIF counts in hundredths of a second
    with atomic_write(folder / "watch.gif") as temporary:
        save_film(temporary, ticks, info, every, shown, partial(progress, "film"))
    progress.close()
    last = ticks.iloc[-1]
    print(f"{info.title}: {last['won']:.0f} to {last['lost']:.0f} after {last['time_s']:g} s")
    print(f"\nfilm: {folder / 'watch.gif'}")


def simulated(cfg: DictConfig, progress: ProgressBar) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Let a simulated person play; the game, and what its film says about it."""
    with report_input_errors():
        setup, person = load_setup(cfg), selected_person(cfg)
    (condition,), adapted = setup.conditions, None

    def begin(game: int) -> tuple[SimulatedUsers, np.ndarray]:
        """The person and the state of the table's random number stream, as in a game of a study."""
        user, table = (spawn_rng_states(cfg.seed, [0], game, s) for s in (RandomStream.USER, RandomStream.TABLE))
        return setup.simulated_users(person, user), table

    if ADAPTED in condition.guidance.models():
        progress("unscored game", 0.0)
        users, serves = begin(CALIBRATION_GAME)
        game = play_games(users, setup.opponent, no_force, setup.protocol, setup.table, serves, True)
        adapted = setup.models.adapted_to(game.demonstrations)
    users, serves = begin(ascii_lowercase.index(condition.letter))
    ticks = play(users, setup, adapted, serves, cfg.seconds)
    archetypes = list(cfg.users.population.style.archetypes)
    player = f"simulated {archetypes[person['archetype'][0]].replace('_', '-')}"
    return ticks, scene_facts(condition, player, f"generation {cfg.opponent}", adapted is not None)


def check_film(cfg: DictConfig, ticks_per_second: int) -> None:
    """Raise for a film that cannot be drawn."""
    require_counts(cfg, "width", least=MIN_WIDTH)
    if ticks_per_second % cfg.frames_per_second:
        raise InputError(f"frames_per_second = {cfg.frames_per_second} must divide {ticks_per_second}")
    require_numbers(cfg, "speed", at_most=ticks_per_second / cfg.frames_per_second)


def selected_person(cfg: DictConfig) -> np.ndarray:
    """(1,) the person that the configuration asks for."""
    population: Population = construct(Population, cfg.users.population, "users.population")
    if cfg.user is not None and cfg.user not in population.style.archetypes:
        raise InputError(f"user = {cfg.user} must be one of {', '.join(population.style.archetypes)}, null")
    if cfg.skill is not None:
        require_numbers(cfg, "skill", least=-MOST_SKILL, at_most=MOST_SKILL)
        population = population.with_parameters(skill_mean=float(cfg.skill), skill_sd=0.0)
    return sample_people(1, cfg.seed, population, cfg.user)


@torch.no_grad()
def play(
    users: SimulatedUsers, setup: StudySetup, adapted: TensorDict | None, serves: np.ndarray, seconds: float
) -> pd.DataFrame:
    """Play one person's game under the one condition of a setup, a round after each goal.

    Args:
        adapted: their own parameters of the user model, batch size (1,), if the condition has UA.
        serves: (1,) uint64, the table's random numbers.

    Returns:
        A row per tick, see `guidance.sessions.tick_log.COLUMNS`, with the desired position of the hand (wanted_x and
        _y, in m of the hand) and the intention.
    """
    (condition,) = setup.conditions
    guidance, tap = tapped_guidance(condition, setup.models, adapted, setup.lookahead_seconds)
    runner, log = GameRunner(users, setup.opponent, setup.table, serves), TickLog(tap, setup.table.tick)
    runner.new_games()
    for _ in range(max(1, round(seconds / setup.table.tick))):
        (wanted_x, wanted_y), intention = users.goal[0], Intention(users.intention[0]).name
        tick = runner.tick(guidance)
        scored = tick.goals != 0
        log(tick, True, scored[0]).update(wanted_x=wanted_x, wanted_y=wanted_y, intention=intention)
        if scored[0]:
            runner.new_rounds(scored)
    return pd.DataFrame(log.rows)
