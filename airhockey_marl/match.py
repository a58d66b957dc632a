"""Matches between two policies: who wins how many rounds."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.env import OBSERVATION_SIZE, steps_of
from airhockey_marl.table import LEFT, RIGHT, Table
from airhockey_marl.tables import Tables

Player = Callable[[Tensor], Tensor]  # observations (n, 12) -> actions (n, 2)


class Result(NamedTuple):
    """Rounds won by the left and the right player, and rounds that ran out of time."""

    won: int
    lost: int
    undecided: int

    @property
    def win_rate(self) -> float:
        """Share of the decided rounds that the left player won; not a number if none was decided."""
        return self.won / (self.won + self.lost) if self.won + self.lost else float("nan")


def confident(policy: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Player:
    """The player that always takes a policy's mean action."""
    return lambda observation: policy(observation)[0]


def sampled(policy: Callable[[Tensor], tuple[Tensor, Tensor]], generator: torch.Generator) -> Player:
    """The player that samples from a policy, as in training."""

    def play(observation: Tensor) -> Tensor:
        mean, std = policy(observation)
        return mean + std * torch.randn(mean.shape, generator=generator)

    return play


@torch.no_grad()
def play_match(
    left: Player, right: Player, rounds: int, seed: int, round_seconds: float = 30.0, table: Table | None = None
) -> Result:
    """Play `rounds` rounds side by side, one per table, each until a goal or for `round_seconds`."""
    tables = Tables(rounds, table)
    tables.seed(seed)
    tables.new_rounds()
    seen = np.empty((2, rounds, OBSERVATION_SIZE), dtype=np.float32)
    actions = np.empty((rounds, 2, 2), dtype=np.float32)
    outcome = np.zeros(rounds, dtype=np.int64)
    for _ in range(steps_of(round_seconds, tables.table)):
        for seat, player in ((LEFT, left), (RIGHT, right)):
            actions[:, seat] = player(torch.from_numpy(tables.observe(seat, seen[seat]))).numpy()
        tables.step(actions)
        outcome = np.where(outcome == 0, tables.goals, outcome)
        if outcome.all():
            break
        tables.new_rounds(tables.goals != 0)  # a finished table plays on unheeded
    return Result(int((outcome == 1).sum()), int((outcome == -1).sum()), int((outcome == 0).sum()))
