"""People drawn from a population: those of a study, and the nine whose play trains the user model."""

from dataclasses import fields
from math import erf, sqrt

import numpy as np

from airhockey_marl.checks import check_counts
from guidance.users.laws import LogNormal, ScaledBeta, is_number
from guidance.users.population import PERSON, TRAITS, WORTHS, Population

STUDY, TRAINING = 1, 2  # seed streams that never meet
MOST_STIFFENING = 3.0


def _draw_person(person: np.void, rng: np.random.Generator, population: Population, archetype: str | None) -> None:
    """Fill one record; the order of the draws is part of what a seed means."""
    names = list(population.archetypes)
    drawn = names[rng.integers(len(names))]
    person["archetype"] = names.index(archetype or drawn)
    skill = population.skill_mean + population.skill_sd * rng.standard_normal()
    person["skill"] = skill
    laws = {item.name: getattr(population, item.name) for item in fields(Population)}
    eps = {name: rng.standard_normal() for name, law in laws.items() if isinstance(law, LogNormal)}
    # The residuals' correlation that gives the wanted one once skill has added its own.
    on_skill = population.noise_along.on_skill * population.noise_across.on_skill
    common = float(np.clip((population.noise_correlation - on_skill) / max(1 - on_skill, 1e-9), 0, 1))
    eps["noise_across"] = common * eps["noise_along"] + sqrt(1 - common**2) * eps["noise_across"]
    for name, law in laws.items():
        if isinstance(law, LogNormal):
            person[name] = law.draw(skill, eps[name])
        elif isinstance(law, ScaledBeta):
            person[name] = law.scale * rng.beta(law.alpha, law.beta)
        elif is_number(law):
            person[name] = law
    person["heading_noise"], person["bounce_noise"] = np.radians([person["heading_noise"], person["bounce_noise"]])
    person["decision_delay"] += population.decision_floor
    person["bounce_insight"] = 0.5 * (1 + erf((population.bounce_insight + skill) / sqrt(2)))
    person["foreseen_bounces"] = 1 if skill < 0 else 2
    person["stiffening"] = min(rng.gamma(population.stiffening_shape, population.stiffening_scale), MOST_STIFFENING)
    person["rating_gain"] = np.exp(population.rating_gain_log_sd * rng.standard_normal())
    person["rating_bias"] = population.rating_bias_sd * rng.standard_normal()
    person["worth"] = [population.worth[name] for name in WORTHS]
    concentration = population.trait_concentration
    for name, mean in zip(TRAITS, population.archetypes[archetype or drawn], strict=True):
        person[name] = mean if np.isinf(concentration) else rng.beta(concentration * mean, concentration * (1 - mean))


def _people(wanted: list[str | None], seed: int, stream: int, population: Population | None) -> np.ndarray:
    population = population or Population.usual()
    check_counts(0, seed=seed)
    people = np.zeros(len(wanted), dtype=PERSON)
    for index, archetype in enumerate(wanted):
        if archetype is not None and archetype not in population.archetypes:
            raise ValueError(f"archetype = {archetype!r} must be one of {', '.join(population.archetypes)}")
        # A generator each: who the k-th person is does not depend on how many are asked for.
        _draw_person(people[index], np.random.default_rng([int(seed), stream, index]), population, archetype)
    return people


def sample_people(n: int, seed: int, population: Population | None = None, archetype: str | None = None) -> np.ndarray:
    """Draw n people for a study, of one archetype or of a random one each.

    Returns:
        (n,) structured array of dtype `PERSON`. The first k are the same people for every n.

    Raises:
        ValueError: n below 1, a negative seed or an unknown archetype.
    """
    check_counts(people=n)
    return _people([archetype] * n, seed, STUDY, population)


def training_people(seed: int, population: Population | None = None) -> np.ndarray:
    """The people whose play trains the user model: one per archetype and three random, nine as in the paper.

    They come from another stream of seeds than `sample_people`, so a study never meets them.
    """
    population = population or Population.usual()
    return _people([*population.archetypes, None, None, None], seed, TRAINING, population)


def personal_streams(n: int, seed: int) -> np.ndarray:
    """(n,) uint64: the state of each person's own splitmix64 stream, far apart in its period."""
    check_counts(n=n)
    check_counts(0, seed=seed)
    return (np.arange(n, dtype=np.uint64) + np.uint64(seed % 2**63 + 1)) * np.uint64(0xA24BAED4963EE407)
