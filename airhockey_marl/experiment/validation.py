"""Arguments that a function cannot work with: it says which one, what it was, and what it must be.

Shapes, dtypes, devices and single numbers are looked at, never the values of a tensor: a check takes microseconds, and
what is called tens of thousands of times a second has its own, or none.
"""

from collections.abc import Mapping
from math import inf, isfinite
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

CPU = torch.device("cpu")
KINDS = {"fiu": "numbers", "u": "unsigned whole numbers", "V": "records"}  # of arrays, by `numpy.dtype.kind`


def check_tensors(on: torch.device | None = None, **named: tuple[Tensor, str]) -> None:
    """Refuse tensors that are not of floating point, of the shapes wanted, and on one device.

    Args:
        on: the device; that of the first tensor if None.
        named: by the argument's name the tensor and its shape: in "n 12", n may be any size but must be the same in
            all the shapes, and so may the dimensions that "..." stands for; these come first.

    Raises:
        ValueError: names the first argument that is none of this.
    """
    known: dict[str, Any] = {}
    for name, (tensor, wanted) in named.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            raise ValueError(f"{name}: {kind_of(tensor)}, must be a floating point tensor")
        if tensor.device != (on := on or tensor.device):
            raise ValueError(f"{name}: on {tensor.device}, must be on {on}{_beside(name, named)}")
        if trouble := _misfit(tensor.shape, wanted, known):
            raise ValueError(f"{name}: {trouble}{_beside(name, named)}")


def check_arrays(kinds: str = "fiu", **named: tuple[np.ndarray, str]) -> None:
    """Refuse arrays that are not of numbers, or not of the shapes wanted.

    Args:
        kinds: which dtypes will do, one of `KINDS`.
        named: as for `check_tensors`.

    Raises:
        ValueError: names the first argument that is none of this.
    """
    known: dict[str, Any] = {}
    for name, (array, wanted) in named.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            raise ValueError(f"{name}: {kind_of(array)}, must be an array of {KINDS[kinds]}")
        if trouble := _misfit(array.shape, wanted, known):
            raise ValueError(f"{name}: {trouble}{_beside(name, named)}")


def check_view(view: TensorDictBase, acted: bool = True) -> None:
    """Refuse what is no batch of play, see `learner.Learner.update`.

    Args:
        acted: whether it must have actions.

    Raises:
        ValueError: names what is absent, or of another shape or dtype.
    """
    if not isinstance(view, TensorDictBase):
        raise ValueError(f"view: {kind_of(view)}, must be a TensorDict")
    shapes = {"observation": "tables steps 12"} | ({"action": "tables steps 2"} if acted else {})
    shapes |= {"next.observation": "tables steps 12", "next.reward": "tables steps 1"}
    found = {name: view.get(tuple(name.split(".")), None) for name in (*shapes, "next.done", "next.terminated")}
    if absent := [name for name, tensor in found.items() if tensor is None]:
        raise ValueError(f"view: has no {', '.join(absent)}")
    check_tensors(**{f"view.{name}": (found[name], shape) for name, shape in shapes.items()})
    for name in ("next.done", "next.terminated"):
        if found[name].dtype != torch.bool or found[name].shape != found["next.reward"].shape:
            raise ValueError(f"view.{name}: {kind_of(found[name])}, must be bools, one for each reward")


def check_rows(name: str, rows: np.ndarray, n: int) -> None:
    """Refuse what are no places (k,) int64 in n rows: compiled code would read and write where nothing is.

    Raises:
        ValueError: of another dtype or shape, or one is below 0 or not below n.
    """
    if not isinstance(rows, np.ndarray) or rows.ndim != 1 or rows.dtype != np.int64:
        raise ValueError(f"{name}: {kind_of(rows)}, must be int64 of shape (k,)")
    if rows.size and rows.view(np.uint64).max() >= n:  # where what is below 0 is very large
        raise ValueError(f"{name}: from {rows.min()} to {rows.max()}, must be from 0 to {n - 1}")


def check_counts(least: int = 1, /, **named: int) -> None:
    """Refuse what are no whole numbers of at least `least`.

    Raises:
        ValueError: names the first.
    """
    for name, value in named.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name} = {value!r} must be a whole number of at least {least}")


def check_numbers(least: float = -inf, /, *, above: float = -inf, at_most: float = inf, **named: float) -> None:
    """Refuse what are no finite numbers from `least` on, above `above`, and of at most `at_most`.

    Raises:
        ValueError: names the first.
    """
    for name, value in named.items():
        number = isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
        if not number or not (least <= value <= at_most and value > above):
            bounds = [
                f"{words} {bound:g}"
                for words, bound in (("of at least", least), ("above", above), ("at most", at_most))
                if isfinite(bound)
            ]
            raise ValueError(f"{name} = {value!r} must be a finite number {' and '.join(bounds)}".rstrip())


def labeled(settings: Any, label: str, *names: str) -> dict[str, Any]:
    """Some of the attributes of an object, by the names that people have written them under: `label.name`."""
    return {f"{label}.{name}": getattr(settings, name) for name in names}


def kind_of(value: Any) -> str:
    """Of what type something is, and of what dtype and shape if it has them."""
    if isinstance(value, Tensor | np.ndarray):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return type(value).__name__


def _misfit(shape: tuple[int, ...], wanted: str, known: dict[str, Any]) -> str | None:
    """What is wrong with a shape, beside the sizes that are known from others; None if it fits, and adds its own."""
    words = wanted.split()
    leading = words[0] == "..." if words else False
    sizes = words[leading:]
    split = len(shape) - len(sizes)
    fits, own = split == 0 or (leading and split > 0), {}
    if fits:
        if leading:
            own["..."] = tuple(shape[:split])
        for word, size in zip(sizes, shape[split:], strict=True):
            fits &= own.setdefault(word, size) == size and (not word.isdigit() or size == int(word))
        fits &= all(known.get(word, size) == size for word, size in own.items())
    if not fits:
        return f"shape {tuple(shape)}, must be {_in_words(words, known)}"
    known.update(own)
    return None


def _beside(name: str, named: Mapping[str, Any]) -> str:
    """Which arguments came before, that this one must go with."""
    before = list(named)[: list(named).index(name)]
    return f" beside {', '.join(before)}" if before else ""


def _in_words(words: list[str], known: Mapping[str, Any]) -> str:
    """A shape wanted, with the sizes that are known."""
    shown = []
    for word in words:
        size = known.get(word, word)
        shown += size if isinstance(size, tuple) else [size]
    return f"({', '.join(map(str, shown))}{',' if len(shown) == 1 else ''})"
