"""Saves: what counts as a shot on goal and as a block, and reproducible counts."""

import math

import numpy as np
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.puck_path import without_paddles
from airhockey_marl.envs.world import World
from airhockey_marl.evaluation.saves import count_saves, update_counts
from airhockey_marl.players.players import stochastic
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS

TABLE = TableSpec()
NO_PADDLES = without_paddles(TABLE)
HOME, ASIDE = (-0.6, 0.0, 0.0, 0.0), (-0.2, 0.45, 0.0, 0.0)  # a paddle in front of the goal, and out of the way
ATTACKER = (0.3, 0.0, 0.0, 0.0)


def bodies(puck, player=ASIDE, attacker=ATTACKER):
    return np.array([player, attacker, puck], dtype=float)


def played(puck, player=ASIDE, attacker=ATTACKER, seconds=2.0):
    """(blocked, conceded) at one table with resting paddles, until a goal or for `seconds`."""
    tables = World(1)
    tables.new_rounds()
    tables.bodies[0] = bodies(puck, player, attacker)
    shot, counts = np.array([False]), np.zeros(2, dtype=np.int64)
    for _ in range(round(seconds / TABLE.tick)):
        tables.step(np.full((1, 2, 2), np.nan))
        update_counts(shot, counts, tables.bodies, tables.goals, tables.touched, tables.served, NO_PADDLES)
        if tables.goals[0]:
            break
    return tuple(counts.tolist())


def from_attacker(y, vx, vy):
    """A puck that is reflected to the left by the attacker's resting paddle in the first tick."""
    reach = TABLE.puck_radius + TABLE.paddle_radius
    return (ATTACKER[0] - reach - 0.01, y, -vx / TABLE.paddle_restitution, vy)


def test_a_shot_at_an_undefended_goal_is_conceded():
    assert played(from_attacker(0.0, -3.0, 0.0)) == (0, 1)


def test_touch_that_stops_a_shot_is_a_block():
    assert played(from_attacker(0.0, -3.0, 0.0), HOME, seconds=0.4) == (1, 0)


def test_grazed_shot_is_conceded():
    reach = TABLE.puck_radius + TABLE.paddle_radius
    graze = (-0.5, 0.9999 * reach, 0.0, 0.0)
    assert played(from_attacker(0.0, -3.0, 0.0), graze) == (0, 1)


def test_puck_toward_the_wall_is_no_shot():
    assert played(from_attacker(0.03, -3.0, 2.0)) == (0, 0)
    assert played(from_attacker(0.03, -3.0, 2.0), HOME) == (0, 0)


def test_puck_without_the_attackers_touch_is_no_shot():
    assert played((0.1, 0.0, -3.0, 0.0)) == (0, 0)  # it scores
    assert played((0.1, 0.0, -3.0, 0.0), HOME, seconds=0.4) == (0, 0)


def test_a_new_serve_ends_a_shot():
    shot, counts = np.array([True]), np.zeros(2, dtype=np.int64)
    one, none = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    state = bodies((0.0, 0.0, -1.0, 0.0))[None]
    update_counts(shot, counts, state, none, none, np.array([True]), NO_PADDLES)
    assert not shot[0]
    update_counts(shot, counts, state, -one, none, np.array([False]), NO_PADDLES)
    assert counts.tolist() == [0, 0]


def stay(observation):
    return torch.full((len(observation), 2), math.nan)


def test_saves_are_of_the_left_goal_and_reproducible():
    def striker(seed):
        return stochastic(SCRIPTED_PLAYERS["striker"], torch.Generator().manual_seed(seed))

    saves = count_saves(stay, striker(0), 20, 3, round_seconds=10.0)
    assert saves.conceded > 5
    assert count_saves(stay, striker(0), 20, 3, round_seconds=10.0) == saves
    assert count_saves(stay, striker(0), 20, 4, round_seconds=10.0) != saves
    assert count_saves(striker(0), stay, 20, 3, round_seconds=10.0).conceded == 0
