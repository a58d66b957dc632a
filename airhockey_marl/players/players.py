"""Players, functions from observations to actions made from policies, and rollouts of two of them on n tables."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.envs.physics import LEFT, RIGHT
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, World

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


class Step(NamedTuple):
    """One decision of both players; the arrays are written again in the next step.

    Attributes:
        observation: (2, n, 12) before the decision, by agent.
        action: (n, 2, 2).
        done: (n,) bool, the round ended by a goal or by time.
    """

    observation: np.ndarray
    action: np.ndarray
    done: np.ndarray


def decide(world: World, players: tuple[Player, Player], observation: np.ndarray, action: np.ndarray) -> None:
    """Write what both agents observe into `observation` (2, n, 12) and their actions into `action` (n, 2, 2)."""
    for agent in (LEFT, RIGHT):
        action[:, agent] = players[agent](torch.from_numpy(world.observe(agent, observation[agent]))).numpy()


def rollout(world: World, players: tuple[Player, Player], frame_skip: int, max_steps: int) -> Iterator[Step]:
    """Play without end from the world's present state, and yield each step.

    Each action is held for `frame_skip` ticks, and a round has at most `max_steps`. When a step is yielded, `world` is
    in the state at its end; afterwards new rounds begin where `done`.
    """
    observation = np.empty((2, world.n, OBSERVATION_SIZE), dtype=np.float32)
    action = np.empty((world.n, 2, ACTION_SIZE), dtype=np.float32)
    steps = np.zeros(world.n, dtype=np.int64)
    while True:
        decide(world, players, observation, action)
        world.step(action, frame_skip)
        steps += 1
        done = (world.goals != 0) | (steps >= max_steps)
        yield Step(observation, action, done)
        world.new_rounds(done)
        steps[done] = 0
