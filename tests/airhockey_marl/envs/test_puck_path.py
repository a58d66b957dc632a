"""The free puck's path: each forecast against the physics or by hand."""

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from airhockey_marl.envs.physics import PUCK, TableSpec, step_physics
from airhockey_marl.envs.puck_path import goal_alignment, heads_for_goal, seconds_to_goal, without_paddles, would_score
from airhockey_marl.envs.world import World

TABLE = TableSpec()
EMPTY = without_paddles(TABLE)
SIDE = TABLE.width / 2 - TABLE.puck_radius  # m, where the puck's center turns back
HOME, ASIDE = (-0.6, 0.0, 0.0, 0.0), (-0.2, 0.45, 0.0, 0.0)  # a paddle before the goal, and out of the way


def bodies(puck, player=ASIDE):
    return np.array([player, (0.3, 0.0, 0.0, 0.0), puck], dtype=float)


def test_seconds_to_goal_agrees_with_the_physics():
    """Without drag, and with paddles of no size; what happens at a post is another matter."""
    table = TableSpec(drag=0.0, friction=0.0, paddle_radius=1e-6)
    rng, entered, compared = np.random.default_rng(0), 0, 0
    for _ in range(400):
        puck = rng.uniform((-0.8, -0.45, -3.0, -3.0), (0.9, 0.45, -0.8, 3.0))
        bodies = np.zeros((3, 4))
        bodies[:PUCK, 0], bodies[:PUCK, 1], bodies[PUCK] = (-0.97, 0.97), 0.519, puck
        predicted = float(seconds_to_goal(np.concatenate([np.zeros(8), puck]), table))
        simulated, before = np.inf, bodies[PUCK].copy()
        for step in range(1, 121):
            if bodies[PUCK, 0] > table.puck_radius - table.length / 2:
                before = bodies[PUCK].copy()
            goal, _ = step_physics(bodies, bodies[:PUCK, :2].copy(), table)
            if goal or bodies[PUCK, 2] > 0:  # in, or back from the end
                simulated = step * table.tick if goal else np.inf
                break
        aside = abs(before[3]) * (table.tick + table.puck_radius / -before[2])  # how far it gets on its way through
        if abs(abs(before[1]) - table.goal / 2) < table.puck_radius + aside:
            continue
        compared, entered = compared + 1, entered + np.isfinite(predicted)
        assert np.isfinite(predicted) == np.isfinite(simulated)
        assert np.isinf(predicted) or predicted - 1e-6 <= simulated <= predicted + table.tick + 1e-6
    assert compared > 150 and entered > 15


def test_seconds_to_goal_is_inf_for_a_puck_that_misses():
    observation = np.zeros((4, 12), dtype=np.float32)  # straight, aside, away, and over the side wall
    observation[:, 8:] = (0.0, 0.0, -2.0, 0.0), (0.0, 0.3, -2.0, 0.0), (0.0, 0.0, 2.0, 0.0), (0.0, 0.3, -2.0, 1.0)
    times = seconds_to_goal(observation, TABLE)
    assert times[0] == pytest.approx(TABLE.length / 4) and np.isinf(times[1:3]).all()
    reach = TABLE.width / 2 - TABLE.puck_radius
    y = reach - TABLE.wall_restitution * (TABLE.length / 4 - (reach - 0.3))
    assert np.isfinite(times[3]) == (abs(y) < TABLE.goal / 2)


def test_would_score_agrees_with_the_physics():
    for paddle in (ASIDE, HOME):  # paddles in the way are ignored
        assert would_score(bodies((0.2, 0.0, -3.0, 0.0), paddle), EMPTY)
    assert not would_score(bodies((0.2, 0.3, -3.0, 0.0)), EMPTY)
    assert not would_score(bodies((0.2, 0.0, 3.0, 0.3)), EMPTY)
    assert not would_score(bodies((0.2, 0.0, -0.05, 0.0)), EMPTY)  # not within SHOT_HORIZON
    rise = SIDE * (1 + 1 / TABLE.wall_restitution)  # over the side wall, from the middle to the middle
    slope = rise / (0.2 + TABLE.length / 2)
    assert would_score(bodies((0.2, 0.0, -3.0, 3.0 * slope)), EMPTY)


def test_would_score_leaves_the_bodies_unchanged():
    state = bodies((0.2, 0.1, -3.0, 0.5), HOME)
    before = state.copy()
    would_score(state, EMPTY)
    assert np.array_equal(state, before)


def test_absent_paddles_are_out_of_reach():
    """A puck sent into a corner comes back as it does from bare walls."""
    end = TABLE.length / 2 - TABLE.puck_radius
    for sign in (-1, 1):
        corner = bodies((-end + 0.05, sign * (SIDE - 0.05), -2.0, sign * 2.0))
        world = World(1)
        world.new_rounds()
        world.bodies[0] = corner
        world.step(np.full((1, 2, 2), np.nan), 5)
        assert world.touched[0] == 0
        assert would_score(corner, EMPTY) == would_score(world.bodies[0], EMPTY)


@pytest.mark.parametrize(
    ("puck", "aim"),
    [
        ((0.0, 0.0, 3.0, 0.0), 1.0),  # straight at the opponent's goal
        ((0.0, 0.0, -3.0, 0.0), 1.0),  # and at one's own
        ((0.0, 0.125, 2.0, 0.0), 0.368),  # at a post
        ((0.0, 0.4, 2.0, 0.0), 0.0),
        ((0.5, 0.2, 2.0, -0.2 / 0.474 * 2), 1.0),  # across
        ((0.0, 0.0, 1.0, 4 * SIDE / 0.974), 1.0),  # over both side walls
        ((0.0, 0.0, 1.0, 2 * SIDE / 0.974), 1.0),  # over one, as in a mirror
        ((0.0, SIDE / 2, 1.0, 2 * SIDE / 0.974), 0.0224),
    ],
)
def test_goal_alignment_follows_the_path_over_mirrors(puck, aim):
    state = torch.zeros(3, 12)
    state[:, 8:] = torch.tensor(puck)
    assert goal_alignment(state, TABLE).squeeze(-1).tolist() == pytest.approx([aim] * 3, abs=1e-3)


@given(st.floats(-0.9, 0.9), st.floats(-0.45, 0.45), st.floats(-8, -0.5), st.floats(-8, 8))
@example(0.5703125, -0.1484375, -8.0, -5.875)  # off a post in the middle of an ordinary tick
@example(-0.5, 0.0, -0.5, 7.75)  # steeply at the wall beside the goal
def test_heads_for_goal_agrees_with_an_empty_table(x, y, vx, vy):
    """Contacts with a post, at which the puck arrives at some angle, are neglected."""
    empty = TableSpec(drag=0.0, friction=0.0, paddle_radius=1e-6, tick=0.001)
    bodies = np.array([[-0.97, -0.51, 0, 0], [0.97, 0.51, 0, 0], [x, y, vx, vy]], dtype=float)
    predicted, target = heads_for_goal(x, y, vx, vy, empty), bodies[:2, :2].copy()
    goal, before = 0, bodies[PUCK].copy()
    while goal == 0 and bodies[PUCK, 2] < 0:
        if bodies[PUCK, 0] > empty.puck_radius - empty.length / 2:
            before = bodies[PUCK].copy()
        goal, _ = step_physics(bodies, target, empty)
    aside = abs(before[3]) * (empty.tick + empty.puck_radius / -before[2])  # how far it gets on its way through
    if abs(abs(before[1]) - empty.goal / 2) > empty.puck_radius + aside:
        assert predicted == (goal == -1)
