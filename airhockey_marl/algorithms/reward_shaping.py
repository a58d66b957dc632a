"""Potential-based reward shaping (Ng, Harada & Russell 1999): it speeds learning up and cannot change the optimum."""

from dataclasses import dataclass

import torch
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.puck_path import goal_alignment
from airhockey_marl.experiment.validation import check_counts, check_numbers, check_tensors, kind_of, labeled
from airhockey_marl.players.networks import BODY_SCALE

TABLE = TableSpec()


@dataclass(frozen=True)
class RewardShaping:
    """The potential of a state: how promising it is for the player who observes it, in goals.

    Attributes:
        position: worth of a puck at the opponent's end rather than at the half-way line.
        velocity: worth of a puck that moves at the speed of a fast paddle toward the opponent.
        shot: worth of a fast puck that is on its way into the opponent's goal; one on its way into the own goal costs
            as much. So a shot is rewarded when it is struck, and a save when it is made.
        approach: worth of having the paddle behind the puck, or where the puck would enter one's own half, rather
            than half a table's length away.
    """

    position: float
    velocity: float
    shot: float
    approach: float

    BEHIND = 0.08  # m: paddle and puck touching

    def __post_init__(self) -> None:
        check_numbers(0.0, **labeled(self, "shaping", "position", "velocity", "shot", "approach"))

    def potential(self, observation: Tensor) -> Tensor:
        """Potential (..., 1) of observations (..., 12)."""
        check_tensors(observation=(observation, "... 12"))
        half, _, fast, _ = BODY_SCALE
        paddle, puck = observation[..., 0:2], observation[..., 8:10]
        behind = torch.stack([puck[..., 0].clamp(max=0.0) - self.BEHIND, puck[..., 1]], dim=-1)
        away = (paddle - behind).norm(dim=-1, keepdim=True) / half
        ahead, speed = observation[..., 8:9] / half, (observation[..., 10:11] / fast).tanh()
        worth = self.velocity + self.shot * goal_alignment(observation, TABLE)
        return self.position * ahead + worth * speed - self.approach * away

    def reward(self, observation: Tensor, following: Tensor, terminated: Tensor, gamma: float) -> Tensor:
        """What to add to the reward of a transition: gamma phi(s') - phi(s), with phi(s') = 0 after the end."""
        check_tensors(observation=(observation, "... 12"), following=(following, "... 12"))
        flags = isinstance(terminated, Tensor) and terminated.dtype == torch.bool
        if not flags or terminated.shape != (*observation.shape[:-1], 1) or terminated.device != observation.device:
            shape = (*observation.shape[:-1], 1)
            raise ValueError(f"terminated: {kind_of(terminated)}, must be bools {shape} on {observation.device}")
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        return gamma * self.potential(following) * ~terminated - self.potential(observation)


def shaping_strength(generation: int, generations: int) -> float:
    """The strength of shaping in a generation, counted from 1: from 1 to nothing over the first `generations`."""
    check_counts(generation=generation)
    check_counts(0, generations=generations)
    return max(0.0, 1.0 - (generation - 1) / generations) if generations else 0.0
