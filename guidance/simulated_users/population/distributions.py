"""How a parameter is distributed over people, and the checks of what a configuration gives for it."""

from math import inf, sqrt
from typing import NamedTuple, NewType

import numpy as np

# Parameters that everybody has in common, by their range. A plain float may be anything from 0.
Positive = NewType("Positive", float)
Proportion = NewType("Proportion", float)  # 0 to 1
Signed = NewType("Signed", float)


class LogNormal(NamedTuple):
    """A log-normal parameter, clipped to [low, high]; `on_skill` is the correlation of its logarithm with skill."""

    median: float
    log_sd: float
    low: float
    high: float
    on_skill: float

    def is_valid(self) -> bool:
        """Whether the numbers are as `ALLOWED` says."""
        in_order = 0 < self.low <= self.median <= self.high < inf
        return in_order and 0 <= self.log_sd < inf and abs(self.on_skill) <= 1

    def quantile(self, skill: float, residual: float) -> float:
        """The parameter of a person of this skill; `residual` ~ N(0, 1) is the part that skill does not explain."""
        z = self.on_skill * skill + sqrt(1 - self.on_skill**2) * residual
        return float(np.clip(self.median * np.exp(self.log_sd * z), self.low, self.high))


class ScaledBeta(NamedTuple):
    """A proportion: `scale` times Beta(alpha, beta)."""

    scale: float
    alpha: float
    beta: float

    def is_valid(self) -> bool:
        """Whether the numbers are as `ALLOWED` says."""
        return 0 <= self.scale <= 1 and self.alpha > 0 and self.beta > 0


ALLOWED = {
    LogNormal: "[median, log-sd, low, high, on skill] with 0 < low <= median <= high, log-sd >= 0 and on skill in "
    "-1..1",
    ScaledBeta: "[scale in 0..1, alpha > 0, beta > 0]",
}


def is_number(value: object) -> bool:
    """Whether `value` is a number other than NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value


def parse_parameter(kind: type, name: str, value: object) -> object:
    """Convert the value of a configuration to `kind`: one of this module's types, or float.

    Args:
        name: the full key of the configuration, for the message.

    Raises:
        ValueError: the value does not fit; names the key, the value and what is allowed.
    """
    if kind in (LogNormal, ScaledBeta):
        numbers = isinstance(value, list | tuple) and len(value) == len(kind._fields) and all(map(is_number, value))
        if numbers and kind(*value).is_valid():
            return kind(*value)
        raise ValueError(f"{name} = {value} must be {ALLOWED[kind]}")
    for scalar, fits, allowed in (
        (Positive, is_number(value) and value > 0, "above 0"),
        (Proportion, is_number(value) and 0 <= value <= 1, "in 0..1"),
        (Signed, is_number(value), ""),
        (float, is_number(value) and value >= 0, "of at least 0"),
    ):
        if kind is scalar and not fits:
            raise ValueError(f"{name} = {value} must be a number {allowed}".rstrip())
    return value
