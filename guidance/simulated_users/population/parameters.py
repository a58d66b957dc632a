"""`Population`: the distribution of every parameter of a simulated person, in the sections of `conf/users/*.yaml`.

Units, sources and the list of assumed values are in `conf/users/default.yaml`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.registry import construct
from guidance.simulated_users.population.distributions import (
    LogNormal,
    Positive,
    Proportion,
    ScaledBeta,
    Signed,
    is_number,
    parse_parameter,
)

TRAITS = ("aggression", "press", "bank", "shadow", "power", "guard_depth")
UTILITY_TERMS = 6  # a constant, the weights of four traits, and that of an open goal


class UtilityRow(IntEnum):
    """Rows of the utility weights: an intention in a situation."""

    away_wait = 0
    away_shadow = 1
    away_press = 2
    behind_recover = 3
    behind_block = 4
    near_control = 5
    near_control_at_rest = 6
    near_smash = 7
    near_bank = 8
    near_block = 9
    near_shadow = 10


class Section:
    """A section of the population; converts its parameters, and names them in errors as the configuration does."""

    key: str

    def __init_subclass__(cls, key: str) -> None:
        cls.key = f"users.population.{key}"

    def __post_init__(self) -> None:
        for item in fields(self):
            value = parse_parameter(item.type, f"{self.key}.{item.name}", getattr(self, item.name))
            object.__setattr__(self, item.name, value)


@dataclass(frozen=True)
class Perception(Section, key="perception"):
    """Delay and noise of vision, and the anticipation of bounces."""

    visual_delay: LogNormal
    speed_noise: LogNormal
    heading_noise: LogNormal
    bounce_noise: LogNormal
    bounce_anticipation: Signed
    noise_autocorrelation: Proportion
    degrees_per_meter: Positive
    weber_min_speed: Positive


@dataclass(frozen=True)
class Situation(Section, key="situation"):
    """Thresholds by which a situation and an event are recognized."""

    min_approach_speed: float
    arrival_horizon: float
    departure_speed: float
    reach_margin: float
    velocity_jump: Positive
    position_jump: Positive


@dataclass(frozen=True)
class Intention(Section, key="intention"):
    """Delays and utilities of the choice between intentions."""

    response_delay: float
    decision_delay: LogNormal
    delay_noise: float
    choice_temperature: LogNormal
    dwell: LogNormal
    reconsider_time: float
    persistence_bonus: float
    advisor_weight: float
    strike_timeout: float
    utility_weights: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        super().__post_init__()
        names = UtilityRow.__members__
        for name in sorted(set(self.utility_weights) ^ set(names)):
            allowed = "must be given" if name in names else f"must be one of {', '.join(names)}"
            raise ValueError(f"{self.key}.utility_weights.{name} {allowed}")
        for name, terms in self.utility_weights.items():
            if len(terms) != UTILITY_TERMS or not all(map(is_number, terms)):
                raise ValueError(f"{self.key}.utility_weights.{name} = {terms} must be {UTILITY_TERMS} numbers")


@dataclass(frozen=True)
class Positioning(Section, key="positioning"):
    """Where the paddle is kept."""

    min_guard_distance: Positive
    guard_range: float
    position_jitter: float
    lateral_tracking_gain: Proportion
    press_distance: Positive
    goal_margin: float
    clearance: float


@dataclass(frozen=True)
class Striking(Section, key="striking"):
    """Speeds, times, effort and aim of a strike."""

    min_smash_speed: Positive
    smash_speed_range: float
    control_speed: Positive
    max_strike_speed: Positive
    swing_time: Positive
    direct_strike_horizon: Positive
    min_strike_time: Positive
    min_correction_time: Positive
    strike_time_slack: float
    start_effort_limit: Positive
    continue_effort_limit: Positive
    aim_spread: float
    opponent_avoidance: float
    max_aim: Proportion


@dataclass(frozen=True)
class Movement(Section, key="movement"):
    """Planning of a movement, and motor noise."""

    plan_period: LogNormal
    preferred_acceleration: LogNormal
    min_move_time: Positive
    max_move_time: Positive
    timing_noise: LogNormal
    noise_along: LogNormal
    noise_across: LogNormal
    noise_correlation: Proportion
    tremor: float
    noise_hold_time: Positive
    follow_through_time: float
    deceleration_time: Positive

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_move_time <= self.max_move_time:
            raise ValueError(f"{self.key}.min_move_time = {self.min_move_time} must be at most max_move_time")


@dataclass(frozen=True)
class Arm(Section, key="arm"):
    """Mechanics of the arm and the device's handle."""

    muscle_lag: LogNormal
    arm_mass: LogNormal
    device_mass: float
    device_damping: float
    stiffness: LogNormal
    max_stiffness_ratio: Positive
    damping_time: float


@dataclass(frozen=True)
class ForceResponse(Section, key="force_response"):
    """Delays and gains of the response to a force."""

    tactile_delay: LogNormal
    proprioceptive_delay: float
    force_threshold: float
    goal_radius: Positive
    saturating_conflict: Positive
    stiffening_gain_shape: Positive
    stiffening_gain_scale: float
    co_contraction_time: Positive
    resistance: ScaledBeta
    slacking: ScaledBeta
    sharing_weight: ScaledBeta
    sharing_range: Positive
    partner_stiffness: Positive
    partner_lead_time: Positive
    trust_time: Positive
    initial_trust: Proportion


@dataclass(frozen=True)
class Rating(Section, key="rating"):
    """The rating proxies and the use of their scale."""

    hindsight_delay: Positive
    stiffening_cost: float
    surprise_time: Positive
    rating_gain_log_sd: float
    rating_bias_sd: float
    rating_noise: float


@dataclass(frozen=True)
class Style(Section, key="style"):
    """Skill and playstyle."""

    skill_mean: Signed
    skill_sd: float
    trait_concentration: Positive
    archetypes: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, means in self.archetypes.items():
            if len(means) != len(TRAITS) or not all(is_number(mean) and 0 < mean < 1 for mean in means):
                raise ValueError(f"{self.key}.archetypes.{name} = {means} must be {len(TRAITS)} means between 0 and 1")
        if not self.archetypes:
            raise ValueError(f"{self.key}.archetypes = {{}} must hold at least one archetype")


@dataclass(frozen=True)
class Population:
    """The distribution of people: `population` in `conf/users/*.yaml`, where each parameter is explained.

    Each section may be given as a mapping. Names of parameters are unique over all sections.

    Raises:
        ValueError: a parameter is missing, unknown or out of range; names its key, the value and what is allowed.
    """

    perception: Perception
    situation: Situation
    intention: Intention
    positioning: Positioning
    striking: Striking
    movement: Movement
    arm: Arm
    force_response: ForceResponse
    rating: Rating
    style: Style

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not isinstance(value, item.type):
                object.__setattr__(self, item.name, construct(item.type, value, item.type.key))

    @classmethod
    def default(cls, **changes: Any) -> "Population":
        """The population of `conf/users/default.yaml` with some parameters changed."""
        return _default().with_parameters(**changes)

    def parameters(self) -> dict[str, Any]:
        """All parameters by name, section by section. Their order is that of the random draws of a person."""
        sections = (getattr(self, item.name) for item in fields(self))
        return {item.name: getattr(section, item.name) for section in sections for item in fields(section)}

    def with_parameters(self, **changes: Any) -> "Population":
        """A copy with some parameters changed."""
        for name in changes:
            if name not in PARAMETER_TYPES:
                raise ValueError(f"users.population: {name} must be one of {', '.join(PARAMETER_TYPES)}")
        sections = {}
        for item in fields(self):
            own = {name: value for name, value in changes.items() if name in item.type.__dataclass_fields__}
            sections[item.name] = replace(getattr(self, item.name), **own)
        return Population(**sections)


@cache
def _default() -> Population:
    conf = OmegaConf.to_container(OmegaConf.load(CONF / "users" / "default.yaml").population)
    return Population(**conf)


PARAMETER_TYPES = {item.name: item.type for section in fields(Population) for item in fields(section.type)}
