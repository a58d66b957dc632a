"""What public functions say to input that is none: the argument, what it was, and what it must be."""

import numpy as np
import pytest
import torch

from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import LEFT, TableSpec, check_table
from airhockey_marl.envs.torchrl_env import make_env
from airhockey_marl.envs.world import World
from airhockey_marl.league.league import League
from airhockey_marl.league.opponent_sampling import DeltaUniform
from airhockey_marl.players.inference import PerRowInference
from airhockey_marl.players.networks import Critic, GaussianPolicy
from guidance.simulated_users import SimulatedUsers, personal_streams, sample_people

GAME = AirHockey()
GAME.reset(seed=0)
TWO, POLICY = World(2), GaussianPolicy([4])
ACTIONS, ROWS = np.zeros((2, 2, 2)), np.array([0, 1])
PEOPLE = SimulatedUsers(sample_people(2, 0), personal_streams(2, 0))


TABLE = [
    # tables: compiled code asks nothing, and wrote over other memory until the process was no more
    (lambda: World(0), r"tables = 0 must be a whole number of at least 1"),
    (
        lambda: TWO.step(ACTIONS[:1]),
        r"actions: float64 of shape \(1, 2, 2\), must be numpy float32 or float64",
    ),
    (lambda: TWO.step(ACTIONS[0]), r"actions: float64 of shape \(2, 2\)"),
    (lambda: TWO.step(ACTIONS.astype(int)), r"actions: int64 of shape"),
    (lambda: TWO.step(torch.zeros(2, 2, 2)), r"actions: torch\.float32 of shape \(2, 2, 2\), must be numpy"),
    (lambda: TWO.step(ACTIONS, indices=np.array([2])), r"indices: from 2 to 2, must be from 0 to 1"),
    (lambda: TWO.step(ACTIONS, indices=np.array([-1, 0])), r"indices: from -1 to 0"),
    (lambda: TWO.step(ACTIONS, indices=np.array([0.0])), r"indices: float64 of shape \(1,\), must be int64"),
    (lambda: TWO.step(ACTIONS, indices=[0]), r"indices: list"),
    (lambda: TWO.step(ACTIONS, ticks=-1), r"ticks = -1 must be a whole number of at least 0"),
    (lambda: TWO.new_rounds(np.ones(3, bool)), r"mask: bool of shape \(3,\), must be bools of shape \(2,\)"),
    (lambda: TWO.new_rounds(np.ones(2)), r"mask: float64 of shape \(2,\)"),
    (lambda: TWO.observe(2, np.zeros((2, 12))), r"agent = 2 must be 0 or 1"),
    (
        lambda: TWO.observe(LEFT, np.zeros((2, 11))),
        r"out: float64 of shape \(2, 11\), must be numpy float32 or float64 of shape \(2, 12\)",
    ),
    (lambda: TWO.observe(LEFT, np.zeros((1, 12))), r"out: float64 of shape \(1, 12\)"),
    (lambda: check_table(TableSpec(goal="wide")), r"table\.goal = 'wide' must be a finite number"),
    (lambda: GAME.step({"left": ROWS, "right": [0.0]}), r"actions\['right'\]: list, must be numbers of shape \(2,\)"),
    (lambda: GAME.step({"left": ROWS}), r"actions\['right'\]: NoneType, must be numbers"),
    (lambda: AirHockey(render_mode="gif"), r"render_mode = 'gif' must be None, 'human' or 'rgb_array'"),
    (lambda: make_env("batched", 2, -1.0, 1, 0), r"round_seconds = -1\.0 must be at least"),
    (lambda: make_env("batched", 2, 1.0, 0, 0), r"frame_skip = 0 must be a whole number of at least 1"),
    (lambda: make_env("gym", 2, 1.0, 1, 0), r"env\.backend = 'gym' must be 'batched' or 'pettingzoo'"),
    # models
    (lambda: GaussianPolicy([]), r"hidden = \(\) must name at least one layer"),
    (lambda: GaussianPolicy("64"), r"hidden = '64' must name"),
    (lambda: GaussianPolicy([4], "puck"), r"inputs = 'puck' must be 'table' or 'paddle'"),
    (lambda: Critic([0]), r"hidden = \(0,\) must name"),
    (lambda: League(POLICY).generation(0), r"generation = 0 must be below 0"),
    (lambda: League(POLICY).opponent_batch(["goalie"]), r"scripted player = 'goalie' must be one of"),
    (lambda: DeltaUniform(1.0), r"delta = 1\.0 must be a finite number of at least 0 and below 1"),
    (
        lambda: PerRowInference(POLICY)(np.zeros((5, 12)), np.arange(5)),
        r"model_index: from 0 to 4, must be from 0 to 0",
    ),
    # people
    (lambda: PEOPLE.step(np.zeros((2, 12)), np.zeros((2, 2)), ROWS + 1), r"rows: from 1 to 2, must be from 0 to 1"),
]


@pytest.mark.parametrize(("call", "message"), TABLE, ids=[message[:40] for _, message in TABLE])
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message) as refused:
        call()
    assert "\n" not in str(refused.value)


def test_what_was_refused_has_changed_nothing():
    bodies, rng = TWO.bodies.copy(), TWO.rng.copy()
    for call, _ in TABLE:
        with pytest.raises(ValueError):
            call()
    assert np.array_equal(TWO.bodies, bodies) and np.array_equal(TWO.rng, rng)
