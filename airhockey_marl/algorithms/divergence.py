"""When learning has gone wrong for good: it is stopped, with the reason, before the last good state is written over."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path

import torch
from torch import nn
from torch.optim import Optimizer

LARGEST_KL = 10.0  # nats, of one update; TRPO allows .01, PPO seldom exceeds .1
DEAD, BLIND = 1e-4, 1 - 1e-4  # mean STD, in (0, 1) by its sigmoid, of which nothing is left to explore, or to learn


def require_sound_metrics(metrics: Mapping[str, float]) -> None:
    """Refuse what an update measured, if learning cannot go on from there.

    Args:
        metrics: by name, see `learner.Learner.update`; `kl` and `std` are looked at closer.

    Raises:
        FloatingPointError: a number is none, the policy leapt, or its STD is gone; says which.
    """
    for name, value in metrics.items():
        if not isfinite(value):
            raise FloatingPointError(f"update/{name} = {value}: learning has diverged")
    if (kl := metrics.get("kl", 0.0)) > LARGEST_KL:
        raise FloatingPointError(f"update/kl = {kl:.4g} nats in one update, must be at most {LARGEST_KL:g}")
    if not DEAD < (std := metrics.get("std", 0.5)) < BLIND:
        raise FloatingPointError(f"update/std = {std:.4g}: the policy is dead, must be between {DEAD:g} and {BLIND:g}")


def require_finite_modules(parts: Mapping[str, nn.Module | Optimizer]) -> None:
    """Refuse weights that are no numbers: a metric need not show them, as where an update was skipped.

    Raises:
        FloatingPointError: names the first tensor with a value that is not finite.
    """
    for part, owner in parts.items():
        tensors = owner.state_dict() if isinstance(owner, nn.Module) else _memories(owner)
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise FloatingPointError(f"{part}.{name} has values that are not finite: learning has diverged")


@contextmanager
def name_divergence(what: str, state: Path) -> Iterator[None]:
    """For a part of a training: a `FloatingPointError` in it says where it was, and what is left.

    Args:
        what: the part, in words.
        state: the file of the last good state, once it is written.
    """
    try:
        yield
    except FloatingPointError as error:
        left = f"{state} holds the last good state" if state.is_file() else "nothing was written yet"
        raise FloatingPointError(f"stopped in {what}: {error}; {left}") from error


def _memories(optimizer: Optimizer) -> dict[str, torch.Tensor]:
    memories = optimizer.state_dict()["state"]
    return {f"{index}.{name}": tensor for index, memory in memories.items() for name, tensor in memory.items()}
