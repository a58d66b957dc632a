"""The distribution of every parameter of a person. The numbers, their units and sources are in conf/users/default.yaml.

A parameter theta of person k is log-normal and may depend on skill ~ N(0, 1):

    theta_k = median * exp(log_sd * (on_skill * skill_k + sqrt(1 - on_skill^2) * eps_k)), clipped to [low, high].

Playstyle traits are Beta distributed around the mean of an archetype and do not depend on skill. What is a plain number
is the same for everybody.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from math import erf, inf, sqrt
from typing import Any, NamedTuple, NewType

import numpy as np
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.validation import check_counts

# Numbers that everybody has in common, by what they may be. A plain float may be anything from 0.
Positive = NewType("Positive", float)
Share = NewType("Share", float)  # 0 to 1
Signed = NewType("Signed", float)


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


def is_number(value: object) -> bool:
    """Whether it is a number, and not the one that is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value


def checked(kind: type, name: str, value: object) -> object:
    """`value` as what `kind`, one of this module's or float, says it is.

    Raises:
        ValueError: it is not; names the field, the value and what is allowed.
    """
    if kind is LogNormal:
        return _log_normal(name, value)
    if kind is ScaledBeta:
        return _scaled_beta(name, value)
    for wanted, fits, allowed in (
        (Positive, is_number(value) and value > 0, "above 0"),
        (Share, is_number(value) and 0 <= value <= 1, "in 0..1"),
        (Signed, is_number(value), ""),
        (float, is_number(value) and value >= 0, "of at least 0"),
    ):
        if kind is wanted and not fits:
            raise ValueError(f"users.{name} = {value} must be a number {allowed}".rstrip())
    return value


def _log_normal(name: str, value: object) -> LogNormal:
    if len(value) == 5 and all(map(is_number, value)):
        law = LogNormal(*value)
        if 0 < law.low <= law.median <= law.high < inf and 0 <= law.log_sd < inf and abs(law.on_skill) <= 1:
            return law
    raise ValueError(
        f"users.{name} = {value} must be [median, log-sd, low, high, on skill] with 0 < low <= median <= high, "
        "log-sd >= 0 and on skill in -1..1"
    )


def _scaled_beta(name: str, value: object) -> ScaledBeta:
    if len(value) == 3 and all(map(is_number, value)):
        law = ScaledBeta(*value)
        if 0 <= law.scale <= 1 and law.alpha > 0 and law.beta > 0:
            return law
    raise ValueError(f"users.{name} = {value} must be [scale in 0..1, alpha > 0, beta > 0]")


TRAITS = ("aggression", "press", "bank", "shadow", "power", "guard_depth")
# What an intention is worth in a situation: a constant, and more per unit of four traits and of an open goal.
WORTHS = (
    "away_wait",
    "away_shadow",
    "away_press",
    "behind_recover",
    "behind_block",
    "near_control",
    "near_control_at_rest",
    "near_smash",
    "near_bank",
    "near_block",
    "near_shadow",
)
WORTH_TERMS = 6


@dataclass(frozen=True)
class Population:
    """The distribution of people; the schema of `population` in `conf/users/*.yaml`, where each field is explained.

    Raises:
        ValueError: a distribution is out of range; names the field, the value and what is allowed.
    """

    # seeing
    sight_delay: LogNormal
    speed_noise: LogNormal
    heading_noise: LogNormal
    bounce_noise: LogNormal
    bounce_insight: Signed
    noise_memory: Share
    degrees_per_meter: Positive
    weber_floor: Positive
    # judging the situation
    still: float
    soon: float
    leaving: float
    out_of_reach: float
    kick: Positive
    leap: Positive
    # deciding
    decision_floor: float
    decision_delay: LogNormal
    delay_noise: float
    choice_temperature: LogNormal
    dwell: LogNormal
    idle: float
    staying: float
    advice: float
    strike_over: float
    worth: Mapping[str, Sequence[float]]
    # placing oneself
    guard_nearest: Positive
    guard_range: float
    stray: float
    follow: Share
    press_at: Positive
    goal_margin: float
    clearance: float
    # striking
    smash_slowest: Positive
    smash_range: float
    control_speed: Positive
    fastest_strike: Positive
    swing: Positive
    at_once: Positive
    soonest_strike: Positive
    soonest_correction: Positive
    strike_slack: float
    effort_to_begin: Positive
    effort_to_go_on: Positive
    aim_spread: float
    aim_past: float
    aim_widest: Share
    # moving
    plan_period: LogNormal
    preferred_acceleration: LogNormal
    quickest_move: Positive
    slowest_move: Positive
    timing_noise: LogNormal
    noise_along: LogNormal
    noise_across: LogNormal
    noise_correlation: Share
    tremor: float
    noise_held: Positive
    carry_through: float
    slow_down: Positive
    # the arm
    muscle_lag: LogNormal
    arm_mass: LogNormal
    device_mass: float
    device_damping: float
    stiffness: LogNormal
    stiffest: Positive
    damping_time: float
    # answering a force
    tactile_delay: LogNormal
    proprioceptive_delay: float
    force_threshold: float
    aim_size: Positive
    full_conflict: Positive
    stiffening_shape: Positive
    stiffening_scale: float
    stiffening_lag: Positive
    resistance: ScaledBeta
    slacking: ScaledBeta
    sharing: ScaledBeta
    sharing_range: Positive
    believed_stiffness: Positive
    believed_ahead: Positive
    trust_memory: Positive
    trust_at_first: Share
    # rating
    hindsight_after: Positive
    stiffening_cost: float
    surprise_memory: Positive
    rating_gain_log_sd: float
    rating_bias_sd: float
    rating_noise: float
    # style and skill
    skill_mean: Signed
    skill_sd: float
    trait_concentration: Positive
    archetypes: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, checked(item.type, item.name, getattr(self, item.name)))
        for name, means in self.archetypes.items():
            if len(means) != len(TRAITS) or not all(is_number(mean) and 0 < mean < 1 for mean in means):
                raise ValueError(f"users.archetypes.{name} = {means} must be {len(TRAITS)} means between 0 and 1")
        if not self.archetypes:
            raise ValueError("users.archetypes = {} must hold at least one archetype")
        for name in sorted(set(self.worth) ^ set(WORTHS)):
            raise ValueError(f"users.worth.{name} {'must be given' if name in WORTHS else 'is worth of nothing'}")
        for name, terms in self.worth.items():
            if len(terms) != WORTH_TERMS or not all(map(is_number, terms)):
                raise ValueError(f"users.worth.{name} = {terms} must be {WORTH_TERMS} numbers")
        if not self.quickest_move <= self.slowest_move:
            raise ValueError(f"users.quickest_move = {self.quickest_move} must be at most slowest_move")

    @classmethod
    def usual(cls, **changes: Any) -> "Population":
        """The population of `conf/users/default.yaml`, but for `changes`.

        Raises:
            ValueError: a change is out of range.
        """
        return cls(**{**_usual(), **changes})


@cache
def _usual() -> dict[str, Any]:
    conf = OmegaConf.to_container(OmegaConf.load(CONF / "users" / "default.yaml").population)
    return {name: value for name, value in conf.items() if not name.startswith("_")}


STUDY, TRAINING = 1, 2  # seed streams that never meet
# One record a person, SI units. Where a field has the name of one of `Population`, see there.
USER_PARAMETERS = np.dtype(
    [("archetype", np.int64), ("skill", np.float64), ("foreseen_bounces", np.int64), ("stiffening", np.float64)]
    + [(item.name, np.float64) for item in fields(Population) if item.name not in ("worth", "archetypes")]
    + [(name, np.float64) for name in ("rating_gain", "rating_bias", *TRAITS)]
    + [("worth", np.float64, (len(WORTHS), WORTH_TERMS))]
)

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
    people = np.zeros(len(wanted), dtype=USER_PARAMETERS)
    for index, archetype in enumerate(wanted):
        if archetype is not None and archetype not in population.archetypes:
            raise ValueError(f"archetype = {archetype!r} must be one of {', '.join(population.archetypes)}")
        # A generator each: who the k-th person is does not depend on how many are asked for.
        _draw_person(people[index], np.random.default_rng([int(seed), stream, index]), population, archetype)
    return people


def sample_people(n: int, seed: int, population: Population | None = None, archetype: str | None = None) -> np.ndarray:
    """Draw n people for a study, of one archetype or of a random one each.

    Returns:
        (n,) structured array of dtype `USER_PARAMETERS`. The first k are the same people for every n.

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
