"""Rollouts: who observes what, and when rounds end and begin."""

from itertools import islice

import numpy as np
import pytest
import torch

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from airhockey_marl.players.players import rollout

TABLE = TableSpec()


def midpoint(observation):
    return torch.zeros(len(observation), 2)


def forward(observation):
    return torch.tensor([[1.0, 0.0]]).expand(len(observation), 2)


def test_each_player_observes_and_moves_its_own_side():
    world = World(3)
    world.new_rounds()
    *_, step = islice(rollout(world, (forward, midpoint), 2, 100), 3)
    assert np.array_equal(step.observation[LEFT, :, 8:], -step.observation[RIGHT, :, 8:])
    assert (step.action[:, LEFT] == (1.0, 0.0)).all() and (step.action[:, RIGHT] == 0.0).all()
    assert (world.bodies[:, LEFT, 0] > -TABLE.length / 4 + 0.01).all()
    assert world.bodies[:, RIGHT, 0] == pytest.approx(TABLE.length / 4)


def test_rounds_end_by_goals_and_by_time():
    world = World(2)
    world.new_rounds()
    world.bodies[0, RIGHT, 1], world.bodies[0, PUCK] = 0.4, (0.9, 0.0, 10.0, 0.0)
    steps = rollout(world, (midpoint, midpoint), 1, 3)
    assert next(steps).done.tolist() == [True, False] and world.goals.tolist() == [1, 0]
    assert next(steps).done.tolist() == [False, False] and abs(world.bodies[0, PUCK, 0]) < 0.1  # a new serve
    assert next(steps).done.tolist() == [False, True]
    assert next(steps).done.tolist() == [True, False]
