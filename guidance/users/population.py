"""Who the simulated people are: the distribution of every parameter of a person, and draws from it.

A parameter theta of person k is log-normal and may depend on skill ~ N(0, 1):

    theta_k = median * exp(log_sd * (on_skill * skill_k + sqrt(1 - on_skill^2) * eps_k)), clipped to [low, high].

Playstyle traits are Beta distributed around the mean of an archetype and do not depend on skill.

Tags say where a number comes from: [R] read in the named source, [M] from memory, [D] derived, [A] assumed. What is
tagged [A] belongs in a sensitivity sweep.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import erf, inf, sqrt
from typing import NamedTuple

import numpy as np

TRAITS = ("aggression", "press", "bank", "shadow", "power", "guard_depth")


class LogNormal(NamedTuple):
    """A positive parameter; `on_skill` is the correlation of its logarithm with skill."""

    median: float
    log_sd: float
    low: float
    high: float
    on_skill: float

    def draw(self, skill: float, eps: float) -> float:
        """The parameter of someone of this skill; `eps` ~ N(0, 1) is what skill leaves open."""
        spread = self.on_skill * skill + sqrt(1 - self.on_skill**2) * eps
        return float(np.clip(self.median * np.exp(self.log_sd * spread), self.low, self.high))


class ScaledBeta(NamedTuple):
    """A share: `scale` times Beta(alpha, beta)."""

    scale: float
    alpha: float
    beta: float


class Archetype(NamedTuple):
    """Means of the playstyle traits, each in 0..1."""

    aggression: float  # smashes rather than blocks
    press: float  # waits for the opponent at the half-way line
    bank: float  # shoots over a side wall
    shadow: float  # follows the puck sideways while the opponent has it
    power: float  # how hard a smash is
    guard_depth: float  # how far in front of the goal home is


ARCHETYPES = {
    "striker": Archetype(0.85, 0.75, 0.20, 0.60, 0.90, 0.5),
    "wall": Archetype(0.20, 0.10, 0.20, 0.80, 0.40, 0.1),
    "banker": Archetype(0.60, 0.40, 0.85, 0.40, 0.70, 0.4),
    "counter": Archetype(0.50, 0.15, 0.40, 0.10, 0.80, 0.2),
    "presser": Archetype(0.60, 0.90, 0.30, 0.70, 0.60, 0.7),
    "all_round": Archetype(0.50, 0.50, 0.50, 0.50, 0.50, 0.4),
}


@dataclass(frozen=True)
class Population:
    """The distribution of people; the schema of `conf/users/*.yaml`.

    Log-normal parameters are (median, log-sd, low, high, on skill), shares are (scale, alpha, beta).

    Raises:
        ValueError: a distribution is out of range; names the field, the value and what is allowed.
    """

    # seeing
    sight_delay: LogNormal = LogNormal(0.120, 0.12, 0.09, 0.17, -0.3)  # s, [R] Cross 2019: EMG at 90-120 ms
    speed_noise: LogNormal = LogNormal(0.15, 0.51, 0.06, 0.5, -0.4)  # sd of ln(1 + deg/s / 0.3), [R] Moon, 20 people
    heading_noise: LogNormal = LogNormal(3.0, 0.35, 1.5, 6.0, -0.4)  # deg, [A]
    bounce_noise: LogNormal = LogNormal(5.0, 0.45, 2.0, 12.0, -0.4)  # deg, added by a wall, [A]
    bounce_insight: float = 0.5  # P(a bounce is anticipated) = Phi(bounce_insight + skill), [A]
    # deciding
    decision_floor: float = 0.05  # s, the least time from seeing to acting otherwise, [R] Woods 2015
    decision_delay: LogNormal = LogNormal(0.10, 0.35, 0.03, 0.30, -0.3)  # s, on top of it, [R] Woods 2015; clip [A]
    choice_temperature: LogNormal = LogNormal(0.22, 0.45, 0.1, 0.5, -0.3)  # utility, [A]
    dwell: LogNormal = LogNormal(0.21, 0.2, 0.15, 0.30, -0.3)  # s, an intention is kept at least, [A]
    # moving
    plan_period: LogNormal = LogNormal(0.10, 0.2, 0.08, 0.30, 0.0)  # s, [R] Bye & Neilson 2008, Do 2021; log-sd [A]
    preferred_acceleration: LogNormal = LogNormal(10.0, 0.30, 5.0, 25.0, 0.3)  # m/s2 of the hand, [D] 10 cm in 0.3 s
    timing_noise: LogNormal = LogNormal(0.015, 0.3, 0.008, 0.030, -0.4)  # s, [R] Tresilian 2004; log-sd [A]
    noise_along: LogNormal = LogNormal(0.239, 0.23, 0.05, 0.8, -0.4)  # share of speed, [R] Moon; clip [A]
    noise_across: LogNormal = LogNormal(0.039, 0.60, 0.005, 0.25, -0.4)  # share of speed, [R] Moon; clip [A]
    noise_correlation: float = 0.5  # of the logarithms of the two, [R] Moon
    # the arm
    muscle_lag: LogNormal = LogNormal(0.045, 0.1, 0.040, 0.066, 0.0)  # s, [R] optimal-control models; log-sd [A]
    arm_mass: LogNormal = LogNormal(1.0, 0.25, 0.5, 1.8, 0.0)  # kg at the hand, [R] Selen 2009
    device_mass: float = 0.25  # kg at the handle, [A]
    device_damping: float = 1.0  # N s/m at the handle, [A]
    stiffness: LogNormal = LogNormal(150.0, 0.35, 60.0, 400.0, 0.0)  # N/m, [R] van Beek 2015: 135 N/m
    damping_time: float = 0.05  # s, damping / stiffness, [R] van Beek 2015: 6.45 N s/m
    # answering a force
    touch_delay: LogNormal = LogNormal(0.150, 0.15, 0.10, 0.22, 0.0)  # s, [M]
    stiffening_shape: float = 2.0  # of the Gamma of the co-contraction gain, sign [R], size [A]
    stiffening_scale: float = 0.5  # of the same; the gain is clipped to 0-3
    stiffening_lag: float = 0.3  # s, [A]
    resistance: ScaledBeta = ScaledBeta(0.8, 2.0, 2.0)  # share of a conflicting force pushed back, [A]
    slacking: ScaledBeta = ScaledBeta(0.5, 2.0, 4.0)  # share of a supporting force given up, [A]
    sharing: ScaledBeta = ScaledBeta(0.6, 2.0, 3.0)  # weight of the partner's goal, form [R] Takagi 2017, size [A]
    sharing_range: float = 0.03  # m of the hand, how far off a believable goal may be, [A]
    believed_stiffness: float = 100.0  # N/m, a force is read as a spring of it, [A]
    # rating
    rating_gain_log_sd: float = 0.2  # use of the scale: gain ~ logN(0, .), [A]
    rating_bias_sd: float = 0.5  # Likert points, [A]
    rating_noise: float = 0.6  # Likert points, sd of one answer, [A]
    # style and skill
    skill_mean: float = 0.0  # in sd of the usual population
    skill_sd: float = 1.0  # in the same
    trait_concentration: float = 8.0  # of the Beta around the archetype's mean, [A]; .inf: no spread inside one
    archetypes: Mapping[str, Archetype] = field(default_factory=lambda: dict(ARCHETYPES))  # means in 0..1, [A]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.type is LogNormal:
                object.__setattr__(self, item.name, _log_normal(item.name, value))
            elif item.type is ScaledBeta:
                object.__setattr__(self, item.name, _scaled_beta(item.name, value))
            elif item.type is float and not (_is_number(value) and (value >= 0 or item.name in _ANY_SIGN)):
                raise ValueError(f"users.{item.name} = {value} must be a number of at least 0")
        if not self.noise_correlation <= 1:
            raise ValueError(f"users.noise_correlation = {self.noise_correlation} must be in 0..1")
        for name in (
            "stiffening_shape",
            "stiffening_lag",
            "sharing_range",
            "believed_stiffness",
            "trait_concentration",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"users.{name} = {getattr(self, name)} must be above 0")
        for name, means in self.archetypes.items():
            if len(means) != len(TRAITS) or not all(_is_number(mean) and 0 < mean < 1 for mean in means):
                raise ValueError(f"users.archetypes.{name} = {means} must be {len(TRAITS)} means between 0 and 1")
        if not self.archetypes:
            raise ValueError("users.archetypes = {} must hold at least one archetype")
        object.__setattr__(self, "archetypes", {name: Archetype(*means) for name, means in self.archetypes.items()})


_ANY_SIGN = ("bounce_insight", "skill_mean")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value


def _log_normal(name: str, value: object) -> LogNormal:
    if len(value) == 5 and all(map(_is_number, value)):
        law = LogNormal(*value)
        if 0 < law.low <= law.median <= law.high < inf and 0 <= law.log_sd < inf and abs(law.on_skill) <= 1:
            return law
    raise ValueError(
        f"users.{name} = {value} must be [median, log-sd, low, high, on skill] with 0 < low <= median <= high, "
        "log-sd >= 0 and on skill in -1..1"
    )


def _scaled_beta(name: str, value: object) -> ScaledBeta:
    if len(value) == 3 and all(map(_is_number, value)):
        law = ScaledBeta(*value)
        if 0 <= law.scale <= 1 and law.alpha > 0 and law.beta > 0:
            return law
    raise ValueError(f"users.{name} = {value} must be [scale in 0..1, alpha > 0, beta > 0]")


# One record a person, SI units. Where a field has the name of one of `Population`, see there.
PERSON = np.dtype(
    [("archetype", np.int64), ("skill", np.float64), ("foreseen_bounces", np.int64)]
    + [(item.name, np.float64) for item in fields(Population) if item.type is LogNormal]
    + [(name, np.float64) for name in ("bounce_insight", "resistance", "slacking", "sharing", "stiffening")]
    + [(name, np.float64) for name in ("stiffening_lag", "sharing_range", "believed_stiffness", "damping_time")]
    + [(name, np.float64) for name in ("device_mass", "device_damping")]
    + [(name, np.float64) for name in ("rating_gain", "rating_bias", "rating_noise", *TRAITS)]
)

STUDY, TRAINING = 1, 2  # seed streams that never meet


def _draw_person(person: np.void, rng: np.random.Generator, population: Population, archetype: str | None) -> None:
    """Fill one record; the order of the draws is part of what a seed means."""
    names = list(population.archetypes)
    drawn = names[rng.integers(len(names))]
    person["archetype"] = names.index(archetype or drawn)
    skill = population.skill_mean + population.skill_sd * rng.standard_normal()
    person["skill"] = skill
    eps = {item.name: rng.standard_normal() for item in fields(Population) if item.type is LogNormal}
    # The residuals' correlation that gives the wanted one once skill has added its own.
    on_skill = population.noise_along.on_skill * population.noise_across.on_skill
    common = float(np.clip((population.noise_correlation - on_skill) / max(1 - on_skill, 1e-9), 0, 1))
    eps["noise_across"] = common * eps["noise_along"] + sqrt(1 - common**2) * eps["noise_across"]
    for name, value in eps.items():
        person[name] = getattr(population, name).draw(skill, value)
    person["heading_noise"], person["bounce_noise"] = np.radians([person["heading_noise"], person["bounce_noise"]])
    person["decision_delay"] += population.decision_floor
    person["bounce_insight"] = 0.5 * (1 + erf((population.bounce_insight + skill) / sqrt(2)))
    person["foreseen_bounces"] = 1 if skill < 0 else 2
    for name in ("resistance", "slacking", "sharing"):
        law = getattr(population, name)
        person[name] = law.scale * rng.beta(law.alpha, law.beta)
    person["stiffening"] = min(rng.gamma(population.stiffening_shape, population.stiffening_scale), 3.0)
    for name in ("stiffening_lag", "sharing_range", "believed_stiffness", "damping_time", "device_mass"):
        person[name] = getattr(population, name)
    person["device_damping"], person["rating_noise"] = population.device_damping, population.rating_noise
    person["rating_gain"] = np.exp(population.rating_gain_log_sd * rng.standard_normal())
    person["rating_bias"] = population.rating_bias_sd * rng.standard_normal()
    concentration = population.trait_concentration
    for name, mean in zip(TRAITS, population.archetypes[archetype or drawn], strict=True):
        person[name] = mean if np.isinf(concentration) else rng.beta(concentration * mean, concentration * (1 - mean))


def _people(wanted: list[str | None], seed: int, stream: int, population: Population | None) -> np.ndarray:
    population = population or Population()
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise ValueError(f"seed = {seed} must be a whole number of at least 0")
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
    if n < 1:
        raise ValueError(f"people = {n} must be at least 1")
    return _people([archetype] * n, seed, STUDY, population)


def training_people(seed: int, population: Population | None = None) -> np.ndarray:
    """The people whose play trains the user model: one per archetype and three random, nine as in the paper.

    They come from another stream of seeds than `sample_people`, so a study never meets them.
    """
    population = population or Population()
    return _people([*population.archetypes, None, None, None], seed, TRAINING, population)


def personal_streams(n: int, seed: int) -> np.ndarray:
    """(n,) uint64: the state of each person's own splitmix64 stream, far apart in its period."""
    return (np.arange(n, dtype=np.uint64) + np.uint64(seed % 2**63 + 1)) * np.uint64(0xA24BAED4963EE407)
