"""The population that simulated people are drawn from; its distributions and parameters are in two modules.

A parameter theta of person k is log-normal and may depend on skill ~ N(0, 1):

    theta_k = median * exp(log_sd * (on_skill * skill_k + sqrt(1 - on_skill^2) * eps_k)), clipped to [low, high].

Playstyle traits are Beta distributed around the mean of an archetype and do not depend on skill. A parameter that is a
plain number is the same for everybody.
"""

from collections.abc import Sequence
from enum import IntEnum
from math import erf, sqrt

import numpy as np

from guidance.simulated_users.population.distributions import LogNormal, ScaledBeta, is_number
from guidance.simulated_users.population.parameters import SECTIONS, TRAITS, UTILITY_TERMS, Population, UtilityRow

# One record per person, SI units. A field named like a parameter of `Population` is that parameter.
USER_PARAMETERS = np.dtype(
    [("archetype", np.int64), ("skill", np.float64), ("anticipated_bounces", np.int64), ("stiffening_gain", np.float64)]
    + [(name, np.float64) for own in SECTIONS.values() for name in own if name not in ("utility_weights", "archetypes")]
    + [(name, np.float64) for name in ("rating_gain", "rating_bias", *TRAITS)]
    + [("utility_weights", np.float64, (len(UtilityRow), UTILITY_TERMS))]
)

MAX_STIFFENING_GAIN = 3.0


class PeopleStream(IntEnum):
    """Seed streams of people: those of a study are never those of the training data or of the pilot."""

    STUDY = 1
    TRAINING = 2
    PILOT = 3


def sample_people(n: int, seed: int, population: Population | None = None, archetype: str | None = None) -> np.ndarray:
    """Draw n people for a study, all of one archetype or each of a random one.

    Returns:
        (n,) structured array of dtype `USER_PARAMETERS`. The first k are the same people for every n.
    """
    return _sample([archetype] * n, seed, PeopleStream.STUDY, population)


def pilot_people(n: int, seed: int, population: Population | None = None) -> np.ndarray:
    """Draw n people on whom a guidance is set before a study; none of them is drawn for one, see `sample_people`."""
    return _sample([None] * n, seed, PeopleStream.PILOT, population)


def training_people(seed: int, population: Population | None = None) -> np.ndarray:
    """Draw the people whose play trains the user model: one per archetype and three random ones, nine as in the paper.

    Returns:
        (archetypes + 3,) structured array of dtype `USER_PARAMETERS`; none of them is drawn by `sample_people`.
    """
    population = population or Population.default()
    return _sample([*population["archetypes"], None, None, None], seed, PeopleStream.TRAINING, population)


def personal_streams(n: int, seed: int) -> np.ndarray:
    """(n,) uint64: the state of each person's splitmix64 generator, far apart in its period."""
    return (np.arange(n, dtype=np.uint64) + np.uint64(seed % 2**63 + 1)) * np.uint64(0xA24BAED4963EE407)


def _sample(
    archetypes: Sequence[str | None], seed: int, stream: PeopleStream, population: Population | None
) -> np.ndarray:
    population = population or Population.default()
    people = np.zeros(len(archetypes), dtype=USER_PARAMETERS)
    for index, archetype in enumerate(archetypes):
        if archetype is not None and archetype not in population["archetypes"]:
            raise ValueError(f"archetype = {archetype!r} must be one of {', '.join(population['archetypes'])}")
        # One generator per person: person k does not depend on how many are drawn.
        _fill_record(people[index], np.random.default_rng([int(seed), stream, index]), population, archetype)
    return people


def _fill_record(person: np.void, rng: np.random.Generator, population: Population, archetype: str | None) -> None:
    """Draw one person. A seed means these people only as long as the order of the draws stays."""
    names = list(population["archetypes"])
    random_archetype = names[rng.integers(len(names))]
    archetype = archetype or random_archetype
    person["archetype"] = names.index(archetype)
    skill = population["skill_mean"] + population["skill_sd"] * rng.standard_normal()
    person["skill"] = skill
    parameters = population.parameters
    residuals = {name: rng.standard_normal() for name, value in parameters.items() if isinstance(value, LogNormal)}
    # Correlate the residuals so that the two noises have the given correlation, part of which skill already makes.
    by_skill = population["noise_along"].on_skill * population["noise_across"].on_skill
    common = float(np.clip((population["noise_correlation"] - by_skill) / max(1 - by_skill, 1e-9), 0, 1))
    residuals["noise_across"] = common * residuals["noise_along"] + sqrt(1 - common**2) * residuals["noise_across"]
    for name, value in parameters.items():
        if isinstance(value, LogNormal):
            person[name] = value.quantile(skill, residuals[name])
        elif isinstance(value, ScaledBeta):
            person[name] = value.scale * rng.beta(value.alpha, value.beta)
        elif is_number(value):
            person[name] = value
    person["heading_noise"], person["bounce_noise"] = np.radians([person["heading_noise"], person["bounce_noise"]])
    person["decision_delay"] += population["response_delay"]
    person["bounce_anticipation"] = 0.5 * (1 + erf((population["bounce_anticipation"] + skill) / sqrt(2)))
    person["anticipated_bounces"] = 1 if skill < 0 else 2
    gain = rng.gamma(population["stiffening_gain_shape"], population["stiffening_gain_scale"])
    person["stiffening_gain"] = min(gain, MAX_STIFFENING_GAIN)
    person["rating_gain"] = np.exp(population["rating_gain_log_sd"] * rng.standard_normal())
    person["rating_bias"] = population["rating_bias_sd"] * rng.standard_normal()
    person["utility_weights"] = [population["utility_weights"][name] for name in UtilityRow.__members__]
    concentration = population["trait_concentration"]
    for name, mean in zip(TRAITS, population["archetypes"][archetype], strict=True):
        person[name] = mean if np.isinf(concentration) else rng.beta(concentration * mean, concentration * (1 - mean))
