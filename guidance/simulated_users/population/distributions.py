"""How a parameter is distributed over people, and the checks of what a configuration gives for it."""

from math import inf, sqrt
from typing import Any, NamedTuple

import numpy as np


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


def require_distribution(name: str, value: Any, kind: type[LogNormal] | type[ScaledBeta]) -> LogNormal | ScaledBeta:
    """Convert the numbers of a configuration to a distribution; raises a ValueError that names them."""
    are_numbers = isinstance(value, list | tuple) and len(value) == len(kind._fields) and all(map(is_number, value))
    if not are_numbers or not kind(*value).is_valid():
        raise ValueError(f"{name} = {value} must be {ALLOWED[kind]}")
    return kind(*value)
