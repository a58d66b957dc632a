"""Validate the simulated people on human motor tasks and playstyles, before any guidance.

    airhockey validate_users                              40 people in the laboratory, 120 at the table
    airhockey validate_users users.variant=goal_sharing   another response to forces
    airhockey validate_users +preset=smoke                seconds, to see that it runs

Prints each measure beside the human range and its source. Writes human_measures.csv (the same) and four figures into its run
folder: speeds.png (speed profiles of reaches), push.png (displacement of the hand by a force), places.png (where each
playstyle keeps its paddle) and shots.png (velocities of the puck after a stroke).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.files import atomic_write
from airhockey_marl.experiment.registry import construct

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from torch import Tensor

    from airhockey_marl.players.players import Player
    from guidance.simulated_users import Advisors, Population

SKILLS = (-1.5, 0.0, 1.5)  # of the people whose rounds are counted, in SD of the usual population
SKILL_TRIAL = 3000
ANYTHING = (-math.inf, math.inf)
# Each measure: its unit, what people show, and where that comes from. Without a source it is a demand of this project.
MEASURES = {
    "simple visual reaction time": ("s", (0.200, 0.260), "Woods et al. 2015: 213 ms, n = 1469"),
    "Fitts's law, slope": ("s/bit", (0.08, 0.20), "MacKenzie 1992, devices that follow the hand"),
    "timing of a blow, SD": ("s", (0.010, 0.040), "Tresilian 2004: 10 ms skilled"),
    "stiffness of the hand, from pushes": ("N/m", (60.0, 600.0), "van Beek et al. 2015: 135 N/m"),
    "its damping over its stiffness": ("s", (0.03, 0.08), "van Beek et al. 2015: 0.048 s"),
    "reaches with one peak of speed": ("share", (0.80, 1.0), "Morasso 1981"),
    "speed of the hand in play, 99.9 %": ("m/s", (0.0, 1.5), "the workspace of an Omega.7"),
    "playstyle told from a game, unseen people": ("share", (0.35, 1.0), "chance is 1 of 6"),
    "person told from another game": ("share", (0.10, 1.0), "chance is 1 of all"),
    **{f"rounds won, skill {skill:+.1f}": ("share", ANYTHING, "more with more skill") for skill in SKILLS},
    **{f"shots stopped, skill {skill:+.1f}": ("share", ANYTHING, "more with more skill") for skill in SKILLS},
}


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for values that cannot be used."""
    require_counts(cfg, "threads")
    require_counts(cfg, "laboratory", "per_style", least=2)
    require_counts(cfg, "seed", least=0)
    require_numbers(cfg, "play_seconds", least=10.0)


def main(cfg: DictConfig) -> None:
    """Measure the people, print the table, and draw the figures."""
    import torch

    from airhockey_marl.envs.physics import TableSpec
    from guidance.simulated_users import Population, load_advisors, sample_people
    from guidance.simulated_users.force_response import Variant, check_variant
    from guidance.simulated_users.validation.figures import draw_places, draw_push, draw_shots, draw_speeds
    from guidance.simulated_users.validation.motor_tasks import push_response
    from guidance.study.setup import load_opponent

    with report_input_errors():
        check_variant(cfg.users.variant)
        population: Population = construct(Population, cfg.users.population, "users.population")
        advisors = load_advisors(cfg.users.advisors)
        opponent = load_opponent(cfg)
    torch.set_num_threads(cfg.threads)
    people = sample_people(cfg.laboratory, cfg.seed, population)
    found, data = in_the_laboratory(people, cfg.users.variant, cfg.seed)
    styles, play = at_the_table(
        population, cfg.per_style, cfg.play_seconds, opponent, cfg.users.variant, advisors, cfg.seed
    )
    skills = by_skill(population, 6 * cfg.per_style, opponent, cfg.users.variant, advisors, cfg.seed)
    table = as_table({**found, **styles, **skills})
    folder = Path(HydraConfig.get().runtime.output_dir)
    with atomic_write(folder / "human_measures.csv") as temporary:
        table.to_csv(temporary, index=False)
    pushed = {name: push_response(people, name, seed=cfg.seed) for name in Variant.__members__}
    names = list(population.style.archetypes)
    draw_speeds(data, folder / "speeds.png")
    draw_push(pushed, folder / "push.png")
    draw_places(dict(zip(names, play, strict=True)), TableSpec(), folder / "places.png")
    draw_shots(dict(zip(names, play, strict=True)), TableSpec(), folder / "shots.png")
    print(table.to_string(index=False, float_format=lambda number: f"{number:.3g}"))
    print(f"\nfigures: {folder}")


def as_table(found: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """A row per measure: mean and SD over people, the human range, whether the mean is in it, and the source."""
    import numpy as np
    import pandas as pd

    rows = []
    for name, values in found.items():
        unit, (low, high), source = MEASURES[name]
        mean, sd = float(np.nanmean(values)), float(np.nanstd(values))
        human = "" if low == -math.inf else f"{low:g} to {high:g}"
        rows.append([name, unit, mean, sd, human, "yes" if low <= mean <= high else "NO", source])
    return pd.DataFrame(rows, columns=["measure", "unit", "mean", "sd", "human", "within", "source"])


def in_the_laboratory(people: np.ndarray, variant: str, seed: int):
    """The measures of the laboratory, a value per person each, and the reaches behind some of them."""
    import numpy as np

    from guidance.simulated_users.validation.motor_tasks import (
        fitts_slopes,
        mechanics,
        reaches,
        reaction_times,
        timing_errors,
    )

    data = reaches(people, seed=seed)
    _, damping, stiffness = mechanics(people, variant=variant, seed=seed).T
    return {
        "simple visual reaction time": reaction_times(people, seed=seed).mean(axis=1),
        "Fitts's law, slope": fitts_slopes(data),
        "timing of a blow, SD": np.nanstd(timing_errors(people, seed=seed), axis=1),
        "stiffness of the hand, from pushes": stiffness,
        "its damping over its stiffness": damping / stiffness,
        "reaches with one peak of speed": (data.peaks() == 1).mean(axis=1),
    }, data


def at_the_table(
    population: Population,
    per_style: int,
    seconds: float,
    opponent: Player,
    variant: str,
    advisors: Advisors,
    seed: int,
) -> tuple[dict[str, np.ndarray], list[Tensor]]:
    """The measures of unguided play, and the play of each archetype (people, ticks, 12)."""
    import numpy as np

    from airhockey_marl.envs.physics import TableSpec
    from guidance.simulated_users import sample_people
    from guidance.simulated_users.validation.playstyles import classify_styles, features, identification_rate
    from guidance.study.demonstrations import collect_demonstrations
    from guidance.user_model.data import hand_speed

    table = TableSpec()
    ticks, how = round(seconds / table.tick), (table, variant, advisors)

    def games(number: int, seed: int, population: Population, archetype: str | None):
        """Two games of each of `number` people."""
        people = sample_people(number, seed, population, archetype)
        return collect_demonstrations(people, opponent, 2, ticks, *how, seed)

    archetypes = list(population.style.archetypes)
    known, unseen = ([games(per_style, seed + 100 * (k + 1), population, name) for name in archetypes] for k in (0, 1))
    style = np.repeat(np.arange(len(archetypes)), per_style)
    first, one, another = (
        np.concatenate([features(data.observation[:, game], table) for data in group])
        for group, game in ((known, 0), (unseen, 0), (unseen, 1))
    )
    speeds = [hand_speed(data.observation, data.action, table).numpy().ravel() for data in unseen]
    fastest = np.percentile(np.concatenate(speeds), 99.9)
    found = {
        "speed of the hand in play, 99.9 %": np.array([fastest]),
        "playstyle told from a game, unseen people": classify_styles(first, style, one) == style,
        "person told from another game": np.array([identification_rate(one, another)]),
    }
    return found, [data.observation[:, 0] for data in unseen]


def by_skill(
    population: Population, number: int, opponent: Player, variant: str, advisors: Advisors, seed: int
) -> dict[str, np.ndarray]:
    """Rounds won and shots stopped by `number` people of each of `SKILLS`, a value per person each."""
    from airhockey_marl.envs.physics import TableSpec
    from guidance.simulated_users import SimulatedUsers, sample_people
    from guidance.study.games import no_force, play_games
    from guidance.study.protocol import Protocol, RandomStream, spawn_rng_states

    table, won, stopped = TableSpec(), {}, {}
    game = Protocol(familiarization=0, rounds=14, extra_rounds=0, min_seconds=0, round_seconds=30)
    for trial, skill in enumerate(SKILLS):
        people = sample_people(number, seed + 300, population.with_parameters(skill_mean=skill, skill_sd=0.0))
        minds, serves = (
            spawn_rng_states(seed, range(number), SKILL_TRIAL + trial, stream)
            for stream in (RandomStream.USER, RandomStream.TABLE)
        )
        users = SimulatedUsers(people, minds, table, variant, advisors)
        results = play_games(users, opponent, no_force, game, table, serves).results
        won[f"rounds won, skill {skill:+.1f}"] = results["win_rate"]
        stopped[f"shots stopped, skill {skill:+.1f}"] = results["defense_rate"]
    return {**won, **stopped}
