"""`Population`: the distribution of every parameter of a simulated person.

`conf/users/default.yaml` is the list of the parameters, in sections, with their units and sources. The form that a
parameter has there, it has in every configuration: log-normal (five numbers), scaled Beta (three), or a plain number,
which is the same for everybody and at least 0 unless it is named here.
"""

from collections.abc import Collection, Mapping, Sequence
from enum import IntEnum
from math import inf, nan
from typing import Any

from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.registry import as_mapping, did_you_mean
from guidance.simulated_users.population.distributions import (
    LogNormal,
    ScaledBeta,
    is_number,
    require_distribution,
)

PLACE = "users.population"
SECTIONS = OmegaConf.to_container(OmegaConf.load(CONF / "users" / "default.yaml").population)
_POSITIVE = (
    "degrees_per_meter weber_min_speed velocity_jump position_jump min_guard_distance press_distance min_smash_speed "
    "control_speed max_strike_speed swing_time direct_strike_horizon min_strike_time min_correction_time "
    "start_effort_limit continue_effort_limit min_move_time max_move_time noise_hold_time deceleration_time "
    "max_stiffness_ratio goal_radius saturating_conflict stiffening_gain_shape co_contraction_time sharing_range "
    "partner_stiffness partner_lead_time trust_time movement_time reference_speed slacking_time trait_concentration"
)
POSITIVE = frozenset(_POSITIVE.split())
_PROPORTIONS = (
    "noise_autocorrelation lateral_tracking_gain max_aim noise_correlation initial_trust fast_retention "
    "fast_learning_rate slow_retention slow_learning_rate"
)
PROPORTIONS = frozenset(_PROPORTIONS.split())
SIGNED = {"bounce_anticipation", "skill_mean"}

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


class Population:
    """The distribution of people: `population` in `conf/users/*.yaml`, where each parameter is explained.

    Names of parameters are unique over all sections: `population["stiffness"]` is that of the section `arm`.

    Args:
        sections: of each section the parameters by name.

    Attributes:
        parameters: all parameters by name, section by section. Their order is that of the random draws of a person.

    Raises:
        ValueError: a parameter is missing, unknown or out of range; names its key, the value and what is allowed.
    """

    def __init__(self, **sections: Mapping[str, Any]) -> None:
        _require_names(sections, SECTIONS, PLACE)
        self.parameters: dict[str, Any] = {}
        for section, shipped in SECTIONS.items():
            place = f"{PLACE}.{section}"
            values = as_mapping(sections[section], place)
            _require_names(values, shipped, place)
            for name, form in shipped.items():
                self.parameters[name] = _parse(name, f"{place}.{name}", values[name], form)
        if not self["min_move_time"] <= self["max_move_time"]:
            raise ValueError(f"{PLACE}.movement.min_move_time = {self['min_move_time']} must be at most max_move_time")

    def __getitem__(self, name: str) -> Any:
        return self.parameters[name]

    @classmethod
    def default(cls, **changes: Any) -> "Population":
        """The population of `conf/users/default.yaml` with some parameters changed."""
        return cls(**SECTIONS).with_parameters(**changes)

    def with_parameters(self, **changes: Any) -> "Population":
        """A copy with some parameters changed."""
        for name in changes:
            if name not in self.parameters:
                raise ValueError(f"{PLACE}: {name} must be one of {', '.join(self.parameters)}")
        values = self.parameters | changes
        return Population(**{section: {name: values[name] for name in names} for section, names in SECTIONS.items()})


def _require_names(given: Collection[str], allowed: Collection[str], place: str) -> None:
    for name in sorted({*given} ^ {*allowed}):
        unknown = f"no such setting, must be one of {', '.join(allowed)}{did_you_mean(name, allowed)}"
        raise ValueError(f"{place}.{name} {'is missing' if name in allowed else unknown}")


def _parse(name: str, place: str, value: Any, form: Any) -> Any:
    """Check and convert a parameter; `form` is its value in `conf/users/default.yaml`."""
    if name == "utility_weights":
        _require_names(value, UtilityRow.__members__, place)
        return {row: _numbers(f"{place}.{row}", terms, UTILITY_TERMS, "numbers") for row, terms in value.items()}
    if name == "archetypes":
        if not value:
            raise ValueError(f"{place} = {{}} must hold at least one archetype")
        between = "means between 0 and 1"
        return {key: _numbers(f"{place}.{key}", means, len(TRAITS), between, 0, 1) for key, means in value.items()}
    if isinstance(form, list):
        return require_distribution(place, value, LogNormal if len(form) == len(LogNormal._fields) else ScaledBeta)
    number = value if is_number(value) else nan
    if name in POSITIVE:
        fits, allowed = number > 0, "above 0"
    elif name in PROPORTIONS:
        fits, allowed = 0 <= number <= 1, "in 0..1"
    else:
        fits, allowed = (number == number, "") if name in SIGNED else (number >= 0, "of at least 0")
    if not fits:
        raise ValueError(f"{place} = {value} must be a number {allowed}".rstrip())
    return value


def _numbers(place: str, values: Sequence[float], count: int, kind: str, low: float = -inf, high: float = inf) -> Any:
    """Require `count` numbers between `low` and `high`."""
    if len(values) != count or not all(is_number(value) and low < value < high for value in values):
        raise ValueError(f"{place} = {values} must be {count} {kind}")
    return values
