"""How a parameter of people is distributed, and what a table of such distributions may hold."""

from math import inf, sqrt
from typing import NamedTuple, NewType

import numpy as np

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
