"""Checks of arguments at the project's boundary; the error names the argument, its value and what it must be.

numpy is imported by the check that needs it, so that commands which only read settings start fast.
"""

from __future__ import annotations

from math import inf, isfinite
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


def check_rows(name: str, rows: np.ndarray, n: int) -> None:
    """Raise a ValueError unless `rows` are indices (k,) int64 from 0 to n - 1: compiled code checks no bounds."""
    import numpy as np

    if not isinstance(rows, np.ndarray) or rows.ndim != 1 or rows.dtype != np.int64:
        raise ValueError(f"{name}: {kind_of(rows)}, must be int64 of shape (k,)")
    if rows.size and rows.view(np.uint64).max() >= n:  # as unsigned, a negative index is very large
        raise ValueError(f"{name}: from {rows.min()} to {rows.max()}, must be from 0 to {n - 1}")


def check_counts(least: int = 1, /, **values: int) -> None:
    """Raise a ValueError if a value is not an integer >= `least`."""
    for name, value in values.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name} = {value!r} must be a whole number of at least {least}")


def check_numbers(
    least: float = -inf, *, above: float = -inf, at_most: float = inf, below: float = inf, **values: float
) -> None:
    """Raise a ValueError if a value is not a finite number >= `least`, > `above`, <= `at_most` and < `below`."""
    for name, value in values.items():
        number = isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
        if not number or not (least <= value <= at_most and above < value < below):
            bounds = {"of at least": least, "above": above, "at most": at_most, "below": below}
            allowed = " and ".join(f"{words} {bound:g}" for words, bound in bounds.items() if isfinite(bound))
            raise ValueError(f"{name} = {value!r} must be a finite number {allowed}".rstrip())


def labeled(settings: Any, label: str, *names: str) -> dict[str, Any]:
    """Attributes of an object by their names in the configuration, `label.name`."""
    return {f"{label}.{name}": getattr(settings, name) for name in names}


def kind_of(value: Any) -> str:
    """Dtype and shape of a tensor or array, otherwise the name of the type."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return type(value).__name__
