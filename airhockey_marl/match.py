"""Matches between two policies: who wins how many rounds."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.checks import CPU, check_counts, check_tensors
from airhockey_marl.env import OBSERVATION_SIZE, steps_of
from airhockey_marl.table import LEFT, RIGHT, Table
from airhockey_marl.tables import Tables

DECISION_TICKS = 2  # a decision is held for so many ticks, in training (conf/env) and in matches
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


def answer(player: Player, seen: np.ndarray) -> np.ndarray:
    """A player's actions (n, 2) for observations (n, 12).

    Raises:
        ValueError: it answers with something else.
    """
    said = player(torch.from_numpy(seen))
    check_tensors(CPU, player=(said, f"{len(seen)} 2"))
    return said.numpy()


@torch.no_grad()
def play_rounds(
    left: Player,
    right: Player,
    tables: int,
    rounds: int,
    seed: int,
    round_seconds: float = 30.0,
    decision_ticks: int = DECISION_TICKS,
    table: Table | None = None,
) -> np.ndarray:
    """Play `rounds` rounds at each of `tables` tables, one after another, each until a goal or for `round_seconds`.

    Returns:
        (tables, 3) int: rounds won by the left player, lost, and undecided, as in `Result`.

    Raises:
        ValueError: a number is out of range, or a player answers with something else than actions.
    """
    check_counts(tables=tables, rounds=rounds)
    games = Tables(tables, table)
    games.seed(seed)
    games.new_rounds()
    longest = steps_of(round_seconds, games.table, decision_ticks)
    seen = np.empty((2, tables, OBSERVATION_SIZE), dtype=np.float32)
    actions = np.empty((tables, 2, 2), dtype=np.float32)
    score, steps = np.zeros((tables, 3), dtype=np.int64), np.zeros(tables, dtype=np.int64)
    while (score.sum(axis=1) < rounds).any():
        for seat, player in ((LEFT, left), (RIGHT, right)):
            actions[:, seat] = answer(player, games.observe(seat, seen[seat]))
        games.step(actions, decision_ticks)
        steps += 1
        over = (games.goals != 0) | (steps >= longest)
        counts = over & (score.sum(axis=1) < rounds)  # a table that has played its rounds plays on unheeded
        score[counts, 1 - games.goals[counts]] += 1
        games.new_rounds(over)
        steps[over] = 0
    return score[:, [0, 2, 1]]


def play_matches(
    left: Player, right: Player, matches: int, tables: int, rounds: int, seed: int, **options: Any
) -> list[Result]:
    """Play several matches side by side, each at `tables` tables of its own with `rounds` rounds at each of them.

    The players know by the table which match it is, as a line-up does; see `play_rounds` for the options.
    """
    check_counts(matches=matches, tables=tables)
    score = play_rounds(left, right, matches * tables, rounds, seed, **options)
    return [Result(*total) for total in score.reshape(matches, tables, 3).sum(axis=1).tolist()]


def play_match(left: Player, right: Player, rounds: int, seed: int, **options: Any) -> Result:
    """Play `rounds` rounds side by side, one per table; see `play_rounds` for the options."""
    check_counts(rounds=rounds)
    (result,) = play_matches(left, right, 1, rounds, 1, seed, **options)
    return result
