"""Checks of arguments at the project's boundary; the error names the argument, its value and what it must be.

They look at single numbers, shapes, dtypes and devices, never at the values of a tensor. torch and numpy are imported
by the checks that need them, so that commands which only read settings start fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import torch

CPU = "cpu"
KINDS = {"fiu": "numbers", "u": "unsigned whole numbers", "V": "records"}  # of arrays, by `numpy.dtype.kind`


def check_tensors(device: torch.device | str | None = None, /, **tensors: tuple[torch.Tensor, str]) -> None:
    """Raise unless the tensors are of floating point, of these shapes, and on one device.

    Args:
        device: that of the first tensor if None.
        tensors: by the argument's name the tensor and its shape. A word in a shape such as "n 12" is any size, the
            same in all shapes; a leading "..." is any number of dimensions, the same in all shapes.

    Raises:
        ValueError: names the first argument that fails.
    """
    import torch

    device, sizes = None if device is None else torch.device(device), {}
    for name, (tensor, shape) in tensors.items():
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
            raise ValueError(f"{name}: {kind_of(tensor)}, must be a floating point tensor")
        if tensor.device != (device := device or tensor.device):
            raise ValueError(f"{name}: on {tensor.device}, must be on {device}{_beside(name, tensors)}")
        if problem := _shape_error(tensor.shape, shape, sizes):
            raise ValueError(f"{name}: {problem}{_beside(name, tensors)}")


def check_arrays(kinds: str = "fiu", /, **arrays: tuple[np.ndarray, str]) -> None:
    """Raise unless the arrays are of numbers and of these shapes.

    Args:
        kinds: of dtypes that are allowed, one of `KINDS`.
        arrays: as for `check_tensors`.

    Raises:
        ValueError: names the first argument that fails.
    """
    import numpy as np

    sizes: dict[str, Any] = {}
    for name, (array, shape) in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            raise ValueError(f"{name}: {kind_of(array)}, must be an array of {KINDS[kinds]}")
        if problem := _shape_error(array.shape, shape, sizes):
            raise ValueError(f"{name}: {problem}{_beside(name, arrays)}")


def check_rows(name: str, rows: np.ndarray, n: int) -> None:
    """Raise unless these are row indices (k,) int64 from 0 to n - 1: compiled code does not check its bounds.

    Raises:
        ValueError: names the dtype and shape, or the range of the indices.
    """
    import numpy as np

    if not isinstance(rows, np.ndarray) or rows.ndim != 1 or rows.dtype != np.int64:
        raise ValueError(f"{name}: {kind_of(rows)}, must be int64 of shape (k,)")
    if rows.size and rows.view(np.uint64).max() >= n:  # as unsigned, a negative index is very large
        raise ValueError(f"{name}: from {rows.min()} to {rows.max()}, must be from 0 to {n - 1}")


def check_counts(least: int = 1, /, **values: int) -> None:
    """Raise if a value is not an integer >= `least`.

    Raises:
        ValueError: names the first that is not.
    """
    for name, value in values.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name} = {value!r} must be a whole number of at least {least}")


def check_numbers(least: float = -inf, /, *, above: float = -inf, at_most: float = inf, **values: float) -> None:
    """Raise if a value is not a finite number >= `least`, > `above` and <= `at_most`.

    Raises:
        ValueError: names the first that is not.
    """
    for name, value in values.items():
        number = isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
        if not number or not (least <= value <= at_most and value > above):
            bounds = [
                f"{words} {bound:g}"
                for words, bound in (("of at least", least), ("above", above), ("at most", at_most))
                if isfinite(bound)
            ]
            raise ValueError(f"{name} = {value!r} must be a finite number {' and '.join(bounds)}".rstrip())


def labeled(settings: Any, label: str, *names: str) -> dict[str, Any]:
    """Attributes of an object by their names in the configuration, `label.name`."""
    return {f"{label}.{name}": getattr(settings, name) for name in names}


def kind_of(value: Any) -> str:
    """Dtype and shape of a tensor or array, otherwise the name of the type."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return type(value).__name__


def _shape_error(shape: tuple[int, ...], pattern: str, sizes: dict[str, Any]) -> str | None:
    """Match a shape against its pattern and the sizes known so far.

    Returns:
        None if it matches, and adds its own sizes to `sizes`; otherwise the shape, and the one it must have.
    """
    words = pattern.split()
    leading = bool(words) and words[0] == "..."
    n_leading = len(shape) - len(words) + leading
    fits = n_leading == 0 or (leading and n_leading > 0)
    own: dict[str, Any] = {}
    if fits:
        if leading:
            own["..."] = tuple(shape[:n_leading])
        for word, size in zip(words[leading:], shape[n_leading:], strict=True):
            fits &= own.setdefault(word, size) == size and (not word.isdigit() or size == int(word))
        fits &= all(sizes.get(word, size) == size for word, size in own.items())
    if not fits:
        return f"shape {tuple(shape)}, must be {_pattern_text(words, sizes)}"
    sizes.update(own)
    return None


def _beside(name: str, arguments: Mapping[str, Any]) -> str:
    """The arguments before this one, whose sizes it must match."""
    earlier = list(arguments)[: list(arguments).index(name)]
    return f" beside {', '.join(earlier)}" if earlier else ""


def _pattern_text(words: list[str], known: Mapping[str, Any]) -> str:
    """A shape pattern as a tuple, with the sizes that are known."""
    shown = []
    for word in words:
        size = known.get(word, word)
        shown += size if isinstance(size, tuple) else [size]
    return f"({', '.join(map(str, shown))}{',' if len(shown) == 1 else ''})"
