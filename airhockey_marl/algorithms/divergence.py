"""Detect diverged training and stop before the last checkpoint is overwritten."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path

import torch
from torch import nn
from torch.optim import Optimizer

MAX_KL = 10.0  # nats in one update; TRPO allows .01, PPO seldom exceeds .1
MIN_STD, MAX_STD = 1e-4, 1 - 1e-4  # mean STD, a sigmoid in (0, 1): beyond, exploration or the gradient has vanished


def require_sound_metrics(metrics: Mapping[str, float]) -> None:
    """Raise if the metrics of an update show that training cannot recover.

    Args:
        metrics: by name, see `base.Learner.update`; `kl` and `std` have bounds.

    Raises:
        FloatingPointError: a metric is not finite or out of bounds; names it.
    """
    for name, value in metrics.items():
        if not isfinite(value):
            raise FloatingPointError(f"update/{name} = {value}: training has diverged")
    if (kl := metrics.get("kl", 0.0)) > MAX_KL:
        raise FloatingPointError(f"update/kl = {kl:.4g} nats in one update, must be at most {MAX_KL:g}")
    if not MIN_STD < (std := metrics.get("std", 0.5)) < MAX_STD:
        raise FloatingPointError(f"update/std = {std:.4g}: must be between {MIN_STD:g} and {MAX_STD:g}")


def require_finite_modules(modules: Mapping[str, nn.Module | Optimizer]) -> None:
    """Raise if weights or the state of an optimizer are not finite, which metrics need not show.

    Raises:
        FloatingPointError: names the first tensor with a value that is not finite.
    """
    for module_name, module in modules.items():
        tensors = module.state_dict() if isinstance(module, nn.Module) else _optimizer_state(module)
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise FloatingPointError(f"{module_name}.{name} has values that are not finite: training has diverged")


@contextmanager
def name_divergence(phase: str, checkpoint: Path) -> Iterator[None]:
    """Add to a `FloatingPointError` the phase of training in which it was raised, and the last checkpoint.

    Args:
        phase: in words.
        checkpoint: the file, which need not exist yet.
    """
    try:
        yield
    except FloatingPointError as error:
        remedy = f"{checkpoint} holds the last good state" if checkpoint.is_file() else "nothing was written yet"
        raise FloatingPointError(f"stopped in {phase}: {error}; {remedy}") from error


def _optimizer_state(optimizer: Optimizer) -> dict[str, torch.Tensor]:
    states = optimizer.state_dict()["state"]
    return {f"{index}.{name}": tensor for index, state in states.items() for name, tensor in state.items()}
