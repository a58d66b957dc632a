"""Potential-based reward shaping (Ng, Harada & Russell 1999): faster learning, the same optimal policy.

Beside it, what an action-rate cost is counted on: that is no potential, and changes what is optimal.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.puck_path import goal_alignment
from airhockey_marl.experiment.validation import check_numbers, labeled
from airhockey_marl.players.networks import BODY_SCALE

TABLE = TableSpec()
HALF_LENGTH, _, FAST_PADDLE, _ = BODY_SCALE  # m, m/s
CONTACT_DISTANCE = 0.08  # m between the centers of a paddle and a puck that touch


@dataclass(frozen=True)
class RewardShaping:
    """The potential of a state for the player who observes it, in goals.

    Attributes:
        position: of a puck at the opponent's end, relative to the half-way line.
        velocity: of a puck that moves at the speed of a fast paddle toward the opponent.
        shot: of a fast puck on its way into the opponent's goal; one on its way into the own goal costs as much. So a
            shot is rewarded when it is struck, and a save when it is made.
        approach: of a paddle behind the puck, or behind the point where the puck will enter the own half, relative to
            half a table's length away.
    """

    position: float
    velocity: float
    shot: float
    approach: float

    def __post_init__(self) -> None:
        check_numbers(0.0, **labeled(self, "shaping", "position", "velocity", "shot", "approach"))

    def potential(self, observation: Tensor) -> Tensor:
        """Potential (..., 1) of observations (..., 12)."""
        paddle, puck = observation[..., 0:2], observation[..., 8:10]
        behind_puck = torch.stack([puck[..., 0].clamp(max=0.0) - CONTACT_DISTANCE, puck[..., 1]], dim=-1)
        distance = (paddle - behind_puck).norm(dim=-1, keepdim=True) / HALF_LENGTH
        ahead, speed = observation[..., 8:9] / HALF_LENGTH, (observation[..., 10:11] / FAST_PADDLE).tanh()
        speed_value = self.velocity + self.shot * goal_alignment(observation, TABLE)
        return self.position * ahead + speed_value * speed - self.approach * distance

    def reward(self, observation: Tensor, next_observation: Tensor, terminated: Tensor, gamma: float) -> Tensor:
        """What to add to the reward of a transition: gamma phi(s') - phi(s), with phi(s') = 0 if s' is terminal."""
        return gamma * self.potential(next_observation) * ~terminated - self.potential(observation)


def action_change(action: Tensor, done: Tensor) -> Tensor:
    """Squared change of each action (tables, steps, 2) from the decision before: (tables, steps, 1).

    As in the rewards of Rudin et al. (2021); squared, so that the noise of exploration costs little beside a change of
    mind. Actions are not clipped: beyond the edge noise would be free, and aiming there the cheapest. 0 for the first
    decision of a round, by `done` (tables, steps, 1), and of a batch, which does not contain the one before.
    """
    change = action.diff(dim=1).square().sum(dim=-1, keepdim=True) * ~done[:, :-1]
    return torch.cat([torch.zeros_like(change[:, :1]), change], dim=1)


def shaping_strength(generation: int, generations: int) -> float:
    """The factor of the shaping in a generation, counted from 1: falls from 1 to 0 over the first `generations`."""
    return max(0.0, 1.0 - (generation - 1) / generations) if generations else 0.0
