"""Checks of arguments at the project's boundary; the error names the argument, its value and what it must be.

numpy is imported by the check that needs it, so that commands which only read settings start fast.
"""

from __future__ import annotations

from math import inf, isfinite
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import torch


def as_tensor(
    name: str, values: Any, size: int, dtype: torch.dtype | None = None, finite: bool = False
) -> torch.Tensor:
    """Numbers (..., size) of a tensor, an array, a table of pandas or lists as a tensor of `dtype`.

    `dtype` None keeps a floating point one and makes integers the default one. Gradients and vmap pass through.

    Raises:
        ValueError: they are not numbers of this shape, or with `finite` one is not finite; it names the argument.
    """
    import torch

    if not isinstance(values, torch.Tensor):
        import numpy as np

        try:
            array = np.asarray(values)
        except ValueError:  # lists of different lengths
            array = np.empty(0, dtype=str)
        if array.dtype == object and all(isinstance(value, Real) for value in array.flat):  # pandas' nullable numbers
            array = array.astype(np.float64)
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{name}: {kind_of(values)}, must be numbers of shape (..., {size})")
        wide = np.float32 if array.dtype == np.float32 else np.float64  # torch has neither long doubles nor byte orders
        values = torch.from_numpy(array.astype(wide))
    if values.shape[-1:] != (size,):
        raise ValueError(f"{name}: {kind_of(values)}, must be numbers of shape (..., {size})")
    if finite and not values.isfinite().all():
        raise ValueError(f"{name}: {int((~values.isfinite()).sum())} values are not finite, all must be")
    return values.to(dtype or (values.dtype if values.is_floating_point() else torch.get_default_dtype()))


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
