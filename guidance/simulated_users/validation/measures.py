"""Measures of simulated people, in motor tasks and in unguided play, beside those of people and their sources."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users.validation.adaptation_tasks import (
    FIELDS,
    after_effects,
    compensation,
    random_field,
    spontaneous_recovery,
)
from guidance.simulated_users.validation.motor_tasks import (
    Reaches,
    fitts_slopes,
    mechanics,
    reaches,
    reaction_times,
    timing_errors,
)
from guidance.simulated_users.validation.playstyles import classify_styles, features, identification_rate

SKILLS = (-1.5, 0.0, 1.5)  # of the people whose rounds are counted, in SD of the usual population
ANYTHING = (-math.inf, math.inf)
# Each measure: its unit, what people show, and where that comes from. Without a source it is a demand of this project.
MEASURES = {
    "simple visual reaction time": ("s", (0.200, 0.260), "Woods et al. 2015: 213 ms, n = 1469"),
    "Fitts's law, slope": ("s/bit", (0.08, 0.20), "MacKenzie 1992, devices that follow the hand"),
    "timing of a blow, SD": ("s", (0.010, 0.040), "Tresilian 2004: 10 ms skilled"),
    "stiffness of the hand, from pushes": ("N/m", (60.0, 600.0), "van Beek et al. 2015: 135 N/m"),
    "its damping over its stiffness": ("s", (0.03, 0.08), "van Beek et al. 2015: 0.048 s"),
    "reaches with one peak of speed": ("share", (0.80, 1.0), "Morasso 1981"),
    **{
        f"{field}, {measure}": ("share", human, source)
        for field in FIELDS
        for measure, human, source in (
            ("compensated after 30 s", (0.50, 0.85), "Smith et al. 2006, Albert & Shadmehr 2018: .54 to .83"),
            ("compensated after 2 min", (0.70, 0.87), "the same: in the end .75 to .87"),
            ("after-effect", (0.0, 1.25), "Shadmehr & Mussa-Ivaldi 1994: opposite, about as large"),
        )
    },
    "curl field, spontaneous recovery": ("share", (0.0, 0.5), "Smith et al. 2006: some of the first field"),
    "curl field of random sign, learned": ("share", (-0.1, 0.1), "Scheidt et al. 2001: its mean, 0"),
    "speed of the hand in play, 99.9 %": ("m/s", (0.0, 1.5), "the workspace of an Omega.7"),
    "playstyle told from a game, unseen people": ("share", (0.35, 1.0), "chance is 1 of 6"),
    "person told from another game": ("share", (0.10, 1.0), "chance is 1 of all"),
    **{f"rounds won, skill {skill:+.1f}": ("share", ANYTHING, "more with more skill") for skill in SKILLS},
    **{f"shots stopped, skill {skill:+.1f}": ("share", ANYTHING, "more with more skill") for skill in SKILLS},
}


def as_table(results: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """A row per measure: mean and SD over people, the human range, whether the mean is in it, and the source."""
    rows = []
    for name, values in results.items():
        unit, (low, high), source = MEASURES[name]
        mean, sd = float(np.nanmean(values)), float(np.nanstd(values))
        human = "" if low == -math.inf else f"{low:g} to {high:g}"
        rows.append([name, unit, mean, sd, human, "yes" if low <= mean <= high else "NO", source])
    return pd.DataFrame(rows, columns=["measure", "unit", "mean", "sd", "human", "within", "source"])


def in_the_laboratory(
    people: np.ndarray, variant: str, seed: int, adaptation: bool = True
) -> tuple[dict[str, np.ndarray], Reaches]:
    """The measures of the laboratory, a value per person each, and the reaches behind some of them."""
    data = reaches(people, seed=seed)
    _, damping, stiffness = mechanics(people, variant=variant, seed=seed, adaptation=adaptation).T
    results = {
        "simple visual reaction time": reaction_times(people, seed=seed).mean(axis=1),
        "Fitts's law, slope": fitts_slopes(data),
        "timing of a blow, SD": np.nanstd(timing_errors(people, seed=seed), axis=1),
        "stiffness of the hand, from pushes": stiffness,
        "its damping over its stiffness": damping / stiffness,
        "reaches with one peak of speed": (data.peaks() == 1).mean(axis=1),
    }
    if adaptation:
        results |= compensation(people, variant, seed) | after_effects(people, variant, seed)
        results["curl field, spontaneous recovery"] = spontaneous_recovery(people, variant, seed)
        results["curl field of random sign, learned"] = random_field(people, variant, seed)
    return results, data


def style_measures(known: Sequence[Tensor], unseen: Sequence[Tensor], table: TableSpec) -> dict[str, np.ndarray]:
    """How well playstyle and person are told from a game.

    Args:
        known, unseen: of each archetype the observations (people, 2 games, ticks, 12) of different people.
    """
    style = np.repeat(np.arange(len(known)), len(known[0]))
    first, one, another = (
        np.concatenate([features(observation[:, game], table) for observation in group])
        for group, game in ((known, 0), (unseen, 0), (unseen, 1))
    )
    return {
        "playstyle told from a game, unseen people": classify_styles(first, style, one) == style,
        "person told from another game": np.array([identification_rate(one, another)]),
    }
