"""Detect diverged training and stop before the last checkpoint is overwritten."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path

from torch import nn
from torch.optim import Optimizer

from airhockey_marl.experiment.checkpoint import state_tensors

MAX_KL = 10.0  # nats in one update; TRPO allows .01, PPO seldom exceeds .1
MIN_STD, MAX_STD = 1e-4, 1 - 1e-4  # mean STD, a sigmoid in (0, 1): beyond, exploration or the gradient has vanished


def require_sound_metrics(metrics: Mapping[str, float]) -> None:
    """Raise a FloatingPointError if an update's metric is not finite, or `kl` or `std` is out of bounds."""
    for name, value in metrics.items():
        if not isfinite(value):
            raise FloatingPointError(f"update/{name} = {value}: training has diverged")
    if (kl := metrics.get("kl", 0.0)) > MAX_KL:
        raise FloatingPointError(f"update/kl = {kl:.4g} nats in one update, must be at most {MAX_KL:g}")
    if not MIN_STD < (std := metrics.get("std", 0.5)) < MAX_STD:
        raise FloatingPointError(f"update/std = {std:.4g}: must be between {MIN_STD:g} and {MAX_STD:g}")


def require_finite_modules(modules: Mapping[str, nn.Module | Optimizer]) -> None:
    """Raise a FloatingPointError if weights or an optimizer's state are not finite, which metrics need not show."""
    for module_name, module in modules.items():
        for name, tensor in state_tensors(module).items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise FloatingPointError(f"{module_name}.{name} has values that are not finite: training has diverged")


@contextmanager
def name_divergence(phase: str, checkpoint: Path) -> Iterator[None]:
    """Add to a `FloatingPointError` the phase of training in which it was raised, and the last checkpoint, if any."""
    try:
        yield
    except FloatingPointError as error:
        remedy = f"{checkpoint} holds the last good state" if checkpoint.is_file() else "nothing was written yet"
        raise FloatingPointError(f"stopped in {phase}: {error}; {remedy}") from error
