"""Players: what maps observations to actions, and how a policy becomes one."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.experiment.validation import CPU, check_tensors

Player = Callable[[Tensor], Tensor]  # observations (n, 12) -> actions (n, 2)


def greedy(policy: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Player:
    """The player that always takes a policy's mean action."""
    return lambda observation: policy(observation)[0]


def stochastic(policy: Callable[[Tensor], tuple[Tensor, Tensor]], generator: torch.Generator) -> Player:
    """The player that samples from a policy, as in training."""

    def play(observation: Tensor) -> Tensor:
        mean, std = policy(observation)
        return mean + std * torch.randn(mean.shape, generator=generator)

    return play


def answer(player: Player, seen: np.ndarray) -> np.ndarray:
    """A player's actions (n, 2) for observations (n, 12).

    Raises:
        ValueError: it answers with something else.
    """
    said = player(torch.from_numpy(seen))
    check_tensors(CPU, player=(said, f"{len(seen)} 2"))
    return said.numpy()
