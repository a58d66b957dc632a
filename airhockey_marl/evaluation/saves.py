"""Save rate of a player: the share of the shots on its goal that it blocks.

A shot on goal begins when the attacker touches the puck and the puck would then score if nobody touched it again, which
is found by simulating a copy of the table without paddles. A shot ends
blocked  when the player touches the puck and it would no longer score, by another such simulation;
conceded when it scores;
uncounted when the puck is served anew, when the attacker's touch turns it away, or when the time is up. A goal without
a shot before it, such as an own goal, is not counted either.
"""

from typing import NamedTuple

import numpy as np
import torch
from numba import njit

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.physics import LEFT, RIGHT, TOUCHED_BY
from airhockey_marl.envs.puck_path import BLOCKED, CONCEDED, shot_outcome, without_paddles, would_score
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, World, round_steps
from airhockey_marl.evaluation.matches import FRAME_SKIP
from airhockey_marl.players.players import Player, decide


class Saves(NamedTuple):
    """Shots on a player's goal, by their outcome."""

    blocked: int
    conceded: int


@njit(cache=True)
def update_counts(shot, counts, bodies, goals, touched, served, no_paddles):
    """Update `shot` (n,) bool, whether a shot is on its way, and `counts` (2,), blocked and conceded, by one tick.

    `bodies`, `goals`, `touched` and `served` are of the `World` after the tick, `no_paddles` is for `would_score`.
    """
    for index in range(len(bodies)):
        done = goals[index] != 0 or served[index]
        if not done and touched[index] == 0:
            continue
        by_player, by_attacker = touched[index] & TOUCHED_BY[LEFT] != 0, touched[index] & TOUCHED_BY[RIGHT] != 0
        threat = not done and would_score(bodies[index], no_paddles)
        outcome = shot_outcome(shot[index], threat, by_player, served[index], goals[index])
        counts[0] += outcome == BLOCKED
        counts[1] += outcome == CONCEDED and shot[index]
        shot[index] = threat and (shot[index] or by_attacker)


@torch.no_grad()
def count_saves(
    player: Player,
    attacker: Player,
    tables: int,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    arm: HandArm | None = None,
) -> Saves:
    """Count the saves of `player`, on the left, against `attacker` at `tables` tables for `round_seconds` each.

    After a goal a table begins a new round. The tables are stepped tick by tick, each action held for `frame_skip`
    ticks, since two touches may be a tick apart.
    """
    world = World(tables, seed=seed, arm=arm)
    world.new_rounds()
    no_paddles = without_paddles(world.table)
    shot, counts = np.zeros(tables, dtype=bool), np.zeros(2, dtype=np.int64)
    observation = np.empty((2, tables, OBSERVATION_SIZE), dtype=np.float32)
    actions = np.empty((tables, 2, ACTION_SIZE), dtype=np.float32)
    for _ in range(round_steps(round_seconds, world.table, frame_skip)):
        decide(world, (player, attacker), observation, actions)
        for _ in range(frame_skip):
            world.step(actions)
            update_counts(shot, counts, world.bodies, world.goals, world.touched, world.served, no_paddles)
            scored = world.goals != 0
            world.new_rounds(scored)
            actions[scored] = np.nan  # NaN leaves the paddles where they are, until the next decision
    return Saves(*counts.tolist())
