"""Matches between two players: how many rounds each wins."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from airhockey_marl.envs.hand_arm import HandArm, arm_from_config
from airhockey_marl.envs.world import World, round_steps
from airhockey_marl.league.league import OpponentBatch, PlayerId
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import Player, rollout, stochastic

FRAME_SKIP = 2  # ticks for which an action is held, in training (conf/env) and in matches
RESULT_COLUMNS = ("won", "lost", "undecided")  # of a `MatchResult` in matches.csv, payoff.csv and comparison.csv


class MatchResult(NamedTuple):
    """Rounds won by the left player, by the right player, and by neither within the time."""

    wins: int
    losses: int
    draws: int

    @property
    def win_rate(self) -> float:
        """The left player's share of the decided rounds; NaN without any."""
        return self.wins / (self.wins + self.losses) if self.wins + self.losses else float("nan")

    def as_row(self) -> dict[str, int]:
        """By `RESULT_COLUMNS`."""
        return dict(zip(RESULT_COLUMNS, self, strict=True))


def match_options(env: Mapping[str, Any]) -> dict[str, Any]:
    """The options with which matches are played as the environment `env` of a training's configuration."""
    return {"frame_skip": env.get("frame_skip", FRAME_SKIP), "arm": arm_from_config(env.get("arm"))}


@torch.no_grad()
def play_rounds(
    left: Player,
    right: Player,
    tables: int,
    rounds: int,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    arm: HandArm | None = None,
) -> np.ndarray:
    """Play `rounds` successive rounds at each of `tables` tables, each until a goal or for `round_seconds`.

    Returns:
        (tables, 3) int: wins of the left player, losses, and draws, as in `MatchResult`.
    """
    world = World(tables, seed=seed, arm=arm)
    world.new_rounds()
    max_steps = round_steps(round_seconds, world.table, frame_skip)
    # columns by the goal: 0 a goal of the left player (+1), 1 none (0), 2 a goal of the right player (-1)
    score = np.zeros((tables, 3), dtype=np.int64)
    for step in rollout(world, (left, right), frame_skip, max_steps):
        counted = step.done & (score.sum(axis=1) < rounds)  # tables that have finished go on, without being counted
        score[counted, 1 - world.goals[counted]] += 1
        if (score.sum(axis=1) >= rounds).all():
            break
    return score[:, [0, 2, 1]]


def play_matches(
    left: Player, right: Player, matches: int, tables: int, rounds: int, seed: int, **options: Any
) -> list[MatchResult]:
    """Play several matches side by side, each at `tables` tables of its own with `rounds` rounds at each table.

    Players may act differently in each match, as an `OpponentBatch` does; see `play_rounds` for the options.
    """
    score = play_rounds(left, right, matches * tables, rounds, seed, **options)
    return [MatchResult(*counts) for counts in score.reshape(matches, tables, 3).sum(axis=1).tolist()]


def play_match(left: Player, right: Player, rounds: int, seed: int, **options: Any) -> MatchResult:
    """Play `rounds` rounds side by side, one per table; see `play_rounds` for the options."""
    (result,) = play_matches(left, right, 1, rounds, 1, seed, **options)
    return result


def play_opponents(
    policy: GaussianPolicy, opponents: OpponentBatch, rounds: int, seed: int, **options: Any
) -> dict[PlayerId, MatchResult]:
    """A match of one policy against each of several different opponents; both sample their actions, as in training.

    See `play_rounds` for the options.
    """
    generator = torch.Generator().manual_seed(seed)
    left, right = stochastic(policy, generator), stochastic(opponents, generator)
    results = play_matches(left, right, len(opponents.player_ids), rounds, 1, seed, **options)
    return dict(zip(opponents.player_ids, results, strict=True))
