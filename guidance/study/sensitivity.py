"""Sensitivity analysis: populations whose assumed parameters are varied over a Latin hypercube."""

from collections.abc import Mapping, Sequence
from math import log

import pandas as pd
from scipy.stats import qmc

from airhockey_marl.experiment.validation import check_counts, check_numbers
from guidance.simulated_users import Population
from guidance.simulated_users.population import PARAMETER_TYPES, LogNormal, Proportion, ScaledBeta

UTILITY = "utility_weights."  # followed by one of `UtilityRow`


def latin_hypercube(parameters: Sequence[str], points: int, largest: float, seed: int) -> pd.DataFrame:
    """Factors between 1 / largest and largest, evenly distributed on a logarithmic scale.

    Returns:
        (points, parameters): in each column every one of `points` equal slices of the range occurs once.
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

    Of a log-normal parameter the median and the clip are scaled, of a Beta its scale; no proportion exceeds 1. A
    utility, `utility_weights.<name>`, has no natural zero: ln(factor) is added to its constant.
    """
    parameters, changes, utilities = population.parameters(), {}, dict(population.intention.utility_weights)
    for name, factor in factors.items():
        check_numbers(above=0.0, **{f"factors[{name!r}]": factor})
        row = name.removeprefix(UTILITY)
        if name.startswith(UTILITY) and row in utilities:
            constant, *terms = utilities[row]
            utilities[row] = [constant + log(factor), *terms]
        elif name in parameters and not isinstance(parameters[name], Mapping):
            changes[name] = _scaled(parameters[name], factor, PARAMETER_TYPES[name])
        else:
            raise ValueError(f"sensitivity.parameters: {name} is not a parameter of people")
    return population.with_parameters(**changes, utility_weights=utilities)


def _scaled(value: object, factor: float, kind: type) -> object:
    if isinstance(value, LogNormal):
        return value._replace(median=factor * value.median, low=factor * value.low, high=factor * value.high)
    if isinstance(value, ScaledBeta):
        return value._replace(scale=min(1.0, factor * value.scale))
    return min(1.0, factor * value) if kind is Proportion else factor * value
