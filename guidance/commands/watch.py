"""Film a simulated person or a recorded game: intention, predictions of the models, and force.

    airhockey watch                              a striker under OAHG (UT), 20 s
    airhockey watch user=wall condition=nhg      somebody else, without guidance
    airhockey watch speed=0.4                    in slow motion
    airhockey watch user=null                    the first person of the study with this seed
    airhockey watch run=outputs/play/...         a game that was played at the window, again

Writes into its run folder: watch.gif, watch.png (six of its moments) and watch.csv (a row per tick).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import atomic_write, write_text
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import output_folder

if TYPE_CHECKING:
    import pandas as pd

LONGEST = 60  # s: all pictures of a film are in memory together
MOST_SKILL = 4.0  # standard deviations


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "frames_per_second")
    require_numbers(cfg, "seconds", at_most=LONGEST)
    require_numbers(cfg, "start", least=0.0)


def main(cfg: DictConfig) -> None:
    from airhockey_marl.envs.physics import TableSpec
    from guidance.display.film import MIN_WIDTH, FilmInfo, draw_sheet, save_film
    from guidance.sessions.tick_log import load_recorded_part
    from guidance.simulated_users.force_response import check_variant

    table = TableSpec()
    with report_input_errors():
        require_counts(cfg, "width", least=MIN_WIDTH)
        ticks_per_second = round(1 / table.tick)
        if ticks_per_second % cfg.frames_per_second:
            raise InputError(f"frames_per_second = {cfg.frames_per_second} must divide {ticks_per_second}")
        require_numbers(cfg, "speed", at_most=ticks_per_second / cfg.frames_per_second)
        check_variant(cfg.users.variant)
        recording = None if cfg.run is None else load_recorded_part(Path(cfg.run), cfg.game, cfg.start, cfg.seconds)
    progress = ProgressBar()
    ticks, facts = recording or simulated(cfg, progress)
    info = FilmInfo(
        table=table,
        title=facts["title"],
        player=facts["player"],
        opponent=facts["opponent"],
        guiding_models=frozenset(facts["used"]),
        is_adapted=facts["adapted"],
        width=cfg.width,
        is_simulated="wanted_x" in ticks,
    )
    folder = output_folder(cfg)
    write_text(folder / "watch.csv", ticks.to_csv(index=False, float_format="%.6g"))
    with atomic_write(folder / "watch.png") as temporary:
        draw_sheet(ticks, info).save(temporary)
    every = round(1 / (table.tick * cfg.frames_per_second))
    duration = 10 * round(100 * every * table.tick / cfg.speed)  # ms; a GIF counts in hundredths of a second
    with atomic_write(folder / "watch.gif") as temporary:
        save_film(temporary, ticks, info, every, duration, partial(progress, "film"))
    progress.close()
    last = ticks.iloc[-1]
    print(f"{info.title}: {last['won']:.0f} to {last['lost']:.0f} after {last['time_s']:g} s")
    print(f"\nfilm: {folder / 'watch.gif'}")


def simulated(cfg: DictConfig, progress: ProgressBar) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Let a simulated person play; the game, and what its film says about it."""
    from guidance.forces.conditions import ADAPTED
    from guidance.sessions.tick_log import record_game, scene_facts
    from guidance.simulated_users import load_population, sample_people
    from guidance.study.games import no_force, play_games
    from guidance.study.protocol import CALIBRATION_GAME, user_and_table_states
    from guidance.study.setup import load_setup

    with report_input_errors():
        setup, population = load_setup(cfg), load_population(cfg.users)
        archetypes = list(population["archetypes"])
        if cfg.user is not None and cfg.user not in archetypes:
            raise InputError(f"user = {cfg.user} must be one of {', '.join(archetypes)}, null")
        if cfg.skill is not None:
            require_numbers(cfg, "skill", least=-MOST_SKILL, at_most=MOST_SKILL)
            population = population.with_parameters(skill_mean=float(cfg.skill), skill_sd=0.0)
    person = sample_people(1, cfg.seed, population, cfg.user)
    (condition,), adapted = setup.conditions, None

    if ADAPTED in condition.guidance.models():
        progress("unscored game", 0.0)
        user, serves = user_and_table_states(cfg.seed, [0], CALIBRATION_GAME)
        users = setup.simulated_users(person, user)
        game = play_games(users, setup.opponent, no_force, setup.protocol, setup.table, serves, True)
        adapted = setup.models.adapted_to(game.demonstrations)
    user, serves = user_and_table_states(cfg.seed, [0], ascii_lowercase.index(condition.letter))
    ticks = record_game(setup.simulated_users(person, user), setup, adapted, serves, cfg.seconds)
    player = f"simulated {archetypes[person['archetype'][0]].replace('_', '-')}"
    return ticks, scene_facts(condition, player, f"generation {cfg.opponent}", adapted is not None)
