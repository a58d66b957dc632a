"""Players: functions from observations to actions, made from policies."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.experiment.validation import CPU, check_tensors

Player = Callable[[Tensor], Tensor]  # observations (n, 12) -> actions (n, 2)
Policy = Callable[[Tensor], tuple[Tensor, Tensor]]  # observations (n, 12) -> mean and STD (n, 2) of the action


def greedy(policy: Policy) -> Player:
    """The player that takes a policy's mean action."""
    return lambda observation: policy(observation)[0]


def stochastic(policy: Policy, generator: torch.Generator) -> Player:
    """The player that samples from a policy's Gaussian, as in training."""

    def play(observation: Tensor) -> Tensor:
        mean, std = policy(observation)
        return mean + std * torch.randn(mean.shape, generator=generator)

    return play


def act(player: Player, observation: np.ndarray) -> np.ndarray:
    """A player's actions (n, 2) at observations (n, 12).

    Raises:
        ValueError: the player returns something else.
    """
    actions = player(torch.from_numpy(observation))
    check_tensors(CPU, player=(actions, f"{len(observation)} 2"))
    return actions.numpy()
