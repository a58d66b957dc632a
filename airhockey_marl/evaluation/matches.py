"""Matches between two policies: who wins how many rounds."""

from typing import Any, NamedTuple

import numpy as np
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.world import World, round_steps
from airhockey_marl.experiment.validation import check_counts
from airhockey_marl.league.league import OpponentBatch, PlayerId
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import Player, stochastic
from airhockey_marl.players.rollout import rollout

FRAME_SKIP = 2  # a decision is held for so many ticks, in training (conf/env) and in matches


class MatchResult(NamedTuple):
    """Rounds won by the left and the right player, and rounds that ran out of time."""

    won: int
    lost: int
    undecided: int

    @property
    def win_rate(self) -> float:
        """Share of the decided rounds that the left player won; not a number if none was decided."""
        return self.won / (self.won + self.lost) if self.won + self.lost else float("nan")


@torch.no_grad()
def play_rounds(
    left: Player,
    right: Player,
    tables: int,
    rounds: int,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    table: TableSpec | None = None,
) -> np.ndarray:
    """Play `rounds` rounds at each of `tables` tables, one after another, each until a goal or for `round_seconds`.

    Returns:
        (tables, 3) int: rounds won by the left player, lost, and undecided, as in `MatchResult`.

    Raises:
        ValueError: a number is out of range, or a player answers with something else than actions.
    """
    check_counts(tables=tables, rounds=rounds)
    world = World(tables, table)
    world.seed(seed)
    world.new_rounds()
    max_steps = round_steps(round_seconds, world.table, frame_skip)
    score = np.zeros((tables, 3), dtype=np.int64)
    for step in rollout(world, (left, right), frame_skip, max_steps):
        counted = step.done & (score.sum(axis=1) < rounds)  # a table that has played its rounds is not counted further
        score[counted, 1 - world.goals[counted]] += 1
        if (score.sum(axis=1) >= rounds).all():
            break
    return score[:, [0, 2, 1]]


def play_matches(
    left: Player, right: Player, matches: int, tables: int, rounds: int, seed: int, **options: Any
) -> list[MatchResult]:
    """Play several matches side by side, each at `tables` tables of its own with `rounds` rounds at each of them.

    The players know by the table which match it is, as a line-up does; see `play_rounds` for the options.
    """
    check_counts(matches=matches, tables=tables)
    score = play_rounds(left, right, matches * tables, rounds, seed, **options)
    return [MatchResult(*total) for total in score.reshape(matches, tables, 3).sum(axis=1).tolist()]


def play_match(left: Player, right: Player, rounds: int, seed: int, **options: Any) -> MatchResult:
    """Play `rounds` rounds side by side, one per table; see `play_rounds` for the options."""
    check_counts(rounds=rounds)
    (result,) = play_matches(left, right, 1, rounds, 1, seed, **options)
    return result


def play_each(
    player: GaussianPolicy, opponents: OpponentBatch, rounds: int, seed: int, frame_skip: int
) -> dict[PlayerId, MatchResult]:
    """A match of one policy against each of a line-up of different members, each side sampling as in training."""
    check_counts(rounds=rounds)
    check_counts(0, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    left, right = stochastic(player, generator), stochastic(opponents, generator)
    results = play_matches(left, right, len(opponents.members), rounds, 1, seed, frame_skip=frame_skip)
    return dict(zip(opponents.members, results, strict=True))
