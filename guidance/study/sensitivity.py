"""Sensitivity analysis: populations whose assumed parameters are varied over a Latin hypercube."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from math import log

import pandas as pd
from scipy.stats import qmc

from airhockey_marl.experiment.validation import check_counts, check_numbers
from guidance.simulated_users import Population
from guidance.simulated_users.population import LogNormal, ScaledBeta, Share

WORTH = "worth."  # prefix of the parameters of the intentions' utilities


def latin_hypercube(parameters: Sequence[str], points: int, largest: float, seed: int) -> pd.DataFrame:
    """Factors between 1 / largest and largest, evenly distributed on a logarithmic scale.

    Returns:
        (points, parameters): in each column every one of `points` equal slices of the range occurs once.

    Raises:
        ValueError: `points` is below 1, `largest` not above 1, or a parameter occurs twice.
    """
    check_counts(**{"sensitivity.points": points})
    check_numbers(above=1.0, **{"sensitivity.largest": largest})
    check_counts(0, seed=seed)
    if repeated := {name for name in parameters if list(parameters).count(name) > 1}:
        raise ValueError(f"sensitivity.parameters: {', '.join(sorted(repeated))} more than once")
    unit = qmc.LatinHypercube(len(parameters), rng=seed).random(points)
    return pd.DataFrame(largest ** (2 * unit - 1), columns=list(parameters))


def scale_assumptions(population: Population, factors: Mapping[str, float]) -> Population:
    """The population with each named parameter multiplied by its factor.

    Of a distribution, the median and the limits are multiplied; a share is limited to 1. The utility of an intention,
    `worth.<name>`, has no meaningful zero: ln(factor) is added to it.

    Raises:
        ValueError: a parameter does not exist.
    """
    kinds, changes, worth = {item.name: item.type for item in fields(Population)}, {}, dict(population.worth)
    for name, factor in factors.items():
        check_numbers(above=0.0, **{f"factors[{name!r}]": factor})
        if name.removeprefix(WORTH) in worth and name.startswith(WORTH):
            constant, *terms = worth[name.removeprefix(WORTH)]
            worth[name.removeprefix(WORTH)] = [constant + log(factor), *terms]
        elif name in kinds and kinds[name] not in (Mapping[str, Sequence[float]],):
            changes[name] = _scaled(getattr(population, name), factor, kinds[name])
        else:
            raise ValueError(f"sensitivity.parameters: {name} is not a parameter of people")
    return replace(population, **changes, worth=worth)


def _scaled(law: object, factor: float, kind: type) -> object:
    if isinstance(law, LogNormal):
        return law._replace(median=factor * law.median, low=factor * law.low, high=factor * law.high)
    if isinstance(law, ScaledBeta):
        return law._replace(scale=min(1.0, factor * law.scale))
    return min(1.0, factor * law) if kind is Share else factor * law
