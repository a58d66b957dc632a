"""How well a player defends: of the shots on its goal, how many it saves.

A shot on goal begins when the attacker touches the puck and the puck would then score if nobody were in its way,
which the physics itself is asked: the table is copied, its paddles are taken away, and it is played on. The shot ends
blocked  when the player touches the puck and, asked again, it would no longer score;
conceded when the goal falls;
or as none, with a new serve, with a touch of the attacker's that turns it away, or when the time is up. A goal that no
shot came before, such as a player's own, is none either.
"""

from typing import NamedTuple

import numpy as np
import torch
from numba import njit

from airhockey_marl.envs.physics import LEFT, RIGHT, TOUCHED_BY, TableSpec
from airhockey_marl.envs.puck_path import BLOCKED, CONCEDED, shot_outcome, without_paddles, would_score
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, World, round_steps
from airhockey_marl.evaluation.matches import FRAME_SKIP
from airhockey_marl.experiment.validation import check_counts
from airhockey_marl.players.players import Player
from airhockey_marl.players.rollout import decide


class Saves(NamedTuple):
    """Shots on a player's goal: those it blocked and those that went in."""

    blocked: int
    conceded: int

    @property
    def rate(self) -> float:
        """Share of the shots that were blocked; not a number without a shot."""
        return self.blocked / (self.blocked + self.conceded) if self.blocked + self.conceded else float("nan")


@njit(cache=True)
def record(under_fire, counts, bodies, goals, touched, served, empty):
    """Enter what one tick brought to n tables.

    Args:
        under_fire: (n,) bool, a shot is on its way; updated.
        counts: (2,) shots blocked and conceded, of all tables; updated.
        bodies, goals, touched, served: the `World` after the tick.
        empty: the table without paddles, see `would_score`.
    """
    for index in range(len(bodies)):
        over = goals[index] != 0 or served[index]
        if not over and touched[index] == 0:
            continue
        by_player, by_attacker = touched[index] & TOUCHED_BY[LEFT] != 0, touched[index] & TOUCHED_BY[RIGHT] != 0
        threat = not over and would_score(bodies[index], empty)
        outcome = shot_outcome(under_fire[index], threat, by_player, served[index], goals[index])
        counts[0] += outcome == BLOCKED
        counts[1] += outcome == CONCEDED and under_fire[index]
        under_fire[index] = threat and (under_fire[index] or by_attacker)


@torch.no_grad()
def count_saves(
    player: Player,
    attacker: Player,
    rounds: int,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    table: TableSpec | None = None,
) -> Saves:
    """Let `player`, on the left, defend against `attacker`, and count.

    They play at `rounds` tables for `round_seconds` each; after a goal a table begins a new round. Who is to blame is
    a matter of single ticks, so the tables are stepped tick by tick, each action held for `frame_skip`.
    """
    check_counts(rounds=rounds)
    tables = World(rounds, table)
    tables.seed(seed)
    tables.new_rounds()
    empty = without_paddles(tables.table)
    under_fire, counts = np.zeros(rounds, dtype=bool), np.zeros(2, dtype=np.int64)
    observation = np.empty((2, rounds, OBSERVATION_SIZE), dtype=np.float32)
    actions = np.empty((rounds, 2, ACTION_SIZE), dtype=np.float32)
    for _ in range(round_steps(round_seconds, tables.table, frame_skip)):
        decide(tables, (player, attacker), observation, actions)
        for _ in range(frame_skip):
            tables.step(actions)
            record(under_fire, counts, tables.bodies, tables.goals, tables.touched, tables.served, empty)
            over = tables.goals != 0
            tables.new_rounds(over)
            actions[over] = np.nan  # stay until asked again
    return Saves(*counts.tolist())
