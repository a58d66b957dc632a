"""The physics: contacts, limits, symmetry, energy, and what a legal state can never become."""

import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from airhockey_marl.envs.physics import (
    LEFT,
    NO_CONTACT,
    PUCK,
    RIGHT,
    VX,
    VY,
    TableSpec,
    X,
    Y,
    _first_contact,
    _out_of_reach,
    action_range,
    check_table,
    coast,
    step_physics,
)

TABLE = TableSpec()
TOUCHING = TABLE.puck_radius + TABLE.paddle_radius
SIDE, END = TABLE.width / 2 - TABLE.puck_radius, TABLE.length / 2 - TABLE.puck_radius
NOWHERE = np.full((2, 2), np.nan)  # targets: stay


def table_with(puck, left=(-0.9, 0.4), right=(0.9, 0.4)) -> np.ndarray:
    bodies = np.zeros((3, 4))
    bodies[LEFT, :2], bodies[RIGHT, :2] = left, right
    bodies[PUCK] = puck
    return bodies


@st.composite
def legal_states(draw, fastest=20.0):
    """Paddles in their halves, the puck on the table and in no paddle."""
    unit = st.floats(0, 1)
    bodies = np.zeros((3, 4))
    middle, half = action_range(TABLE)
    for agent, turn in ((LEFT, 1), (RIGHT, -1)):
        place = middle + half * (2 * np.array([draw(unit), draw(unit)]) - 1)
        bodies[agent, :2] = turn * place
        angle, speed = 2 * np.pi * draw(unit), TABLE.paddle_speed * draw(unit)
        bodies[agent, 2:] = speed * np.cos(angle), speed * np.sin(angle)
    bodies[PUCK, :2] = (2 * draw(unit) - 1) * END, (2 * draw(unit) - 1) * SIDE
    for agent in (LEFT, RIGHT):
        gap = bodies[PUCK, :2] - bodies[agent, :2]
        if np.hypot(*gap) < TOUCHING:
            bodies[PUCK, :2] = bodies[agent, :2] - np.sign(bodies[agent, :2] + 1e-9) * TOUCHING
    bodies[PUCK, 0] = np.clip(bodies[PUCK, 0], -END, END)
    angle, speed = 2 * np.pi * draw(unit), fastest * draw(unit)
    bodies[PUCK, 2:] = speed * np.cos(angle), speed * np.sin(angle)
    targets = np.array([[draw(st.floats(-1.5, 1.5)) for _ in range(2)] for _ in range(2)])
    return bodies, targets


@settings(max_examples=300)
@given(legal_states())
def test_nothing_leaves_the_table_or_overlaps_or_becomes_nan(state):
    bodies, targets = state
    for _ in range(25):
        goal, _ = step_physics(bodies, targets, TABLE)
        assert np.isfinite(bodies).all()
        x, y = bodies[PUCK, :2]
        assert abs(y) <= SIDE + 1e-9
        if goal:
            assert abs(y) < TABLE.goal / 2
            break
        assert abs(x) <= (END if abs(y) >= TABLE.goal / 2 else TABLE.length / 2) + 1e-9
        for agent, turn in ((LEFT, 1), (RIGHT, -1)):
            paddle_x, paddle_y = turn * bodies[agent, X], bodies[agent, Y]
            assert -TABLE.length / 2 + TABLE.paddle_radius - 1e-9 <= paddle_x <= -TABLE.paddle_radius + 1e-9
            assert abs(paddle_y) <= TABLE.width / 2 - TABLE.paddle_radius + 1e-9
            assert np.hypot(*(bodies[PUCK, :2] - bodies[agent, :2])) >= TOUCHING - 1e-3


@settings(max_examples=200)
@given(legal_states())
def test_swapping_the_agents_mirrors_the_trajectory_exactly(state):
    bodies, targets = state
    mirrored, mirrored_targets = -bodies[[RIGHT, LEFT, PUCK]], -targets[::-1]
    for _ in range(10):
        goal, touched = step_physics(bodies, targets, TABLE)
        mirrored_goal, mirrored_touched = step_physics(mirrored, mirrored_targets, TABLE)
        assert np.array_equal(mirrored, -bodies[[RIGHT, LEFT, PUCK]])
        assert mirrored_goal == -goal
        assert mirrored_touched == (touched >> 1) | (touched & 1) << 1
        if goal:
            break


@settings(max_examples=1000)
@given(legal_states())
def test_no_contact_is_out_of_reach(state):
    bodies, _ = state
    time, contact, _ = _first_contact(bodies, TABLE)
    assert contact == NO_CONTACT or not _out_of_reach(bodies, np.nextafter(time, np.inf), TABLE)


@settings(max_examples=200)
@given(st.floats(-0.9, 0.9), st.floats(-0.4, 0.4), st.floats(0, 2 * np.pi), st.floats(0.01, 20))
def test_energy_never_grows_without_a_paddle(x, y, angle, speed):
    empty = TableSpec(paddle_radius=1e-6)  # paddles too small to matter, in opposite corners
    bodies = table_with((x, y, speed * np.cos(angle), speed * np.sin(angle)), (-0.97, -0.51), (0.97, 0.51))
    energy = (bodies[PUCK, 2:] ** 2).sum()
    for _ in range(50):
        goal, touched = step_physics(bodies, NOWHERE, empty)
        assume(not touched)
        after = (bodies[PUCK, 2:] ** 2).sum()
        assert after <= energy
        energy = after
        if goal:
            break


@pytest.mark.parametrize("speed", [1.0, 5.0, 20.0, 200.0])
def test_a_fast_puck_bounces_off_a_paddle_at_the_exact_moment(speed):
    bodies = table_with((-0.2, 0.0, -speed, 0.0), left=(-0.5, 0.0))
    ideal = TableSpec(drag=0.0, friction=0.0)
    for _ in range(40):
        _, touched = step_physics(bodies, NOWHERE, ideal)
        if touched:
            break
    assert touched == 1
    assert bodies[PUCK, VX] == pytest.approx(ideal.paddle_restitution * speed, rel=1e-12)
    assert bodies[PUCK, X] > -0.5 + TOUCHING - 1e-12


def test_a_moving_paddle_hits_harder():
    """v' = v + (1 + e)(V - v) along the contact normal, for a paddle of unlimited mass."""
    ideal = TableSpec(drag=0.0, friction=0.0)
    bodies = table_with((-0.3, 0.0, -1.0, 0.0), left=(-0.5, 0.0))
    bodies[LEFT, VX] = 2.0
    targets = np.array([[10.0, 0.0], [np.nan, np.nan]])  # far ahead: it keeps accelerating
    for _ in range(10):
        before = bodies.copy()
        _, touched = step_physics(bodies, targets, ideal)
        if touched:
            break
    paddle = (bodies[PUCK, VX] - ideal.paddle_restitution * 1.0) / (1 + ideal.paddle_restitution)
    assert before[LEFT, VX] <= paddle <= bodies[LEFT, VX]


def test_a_wall_takes_its_share_of_the_normal_velocity_alone():
    ideal = TableSpec(drag=0.0, friction=0.0)
    bodies = table_with((0.0, SIDE - 0.01, 1.0, 2.0))
    step_physics(bodies, NOWHERE, ideal)
    assert bodies[PUCK, VX] == 1.0
    assert bodies[PUCK, VY] == pytest.approx(-2.0 * ideal.wall_restitution)


@pytest.mark.parametrize(("y", "scores"), [(0.0, True), (0.09, True), (0.14, False), (0.3, False)])
def test_the_goal_is_its_mouth(y, scores):
    bodies = table_with((0.7, y, 3.0, 0.0))
    goals = [step_physics(bodies, NOWHERE, TABLE)[0] for _ in range(10)]
    assert (1 in goals) is scores


def test_a_post_turns_the_puck_away():
    """Head on to the post's tip: back where it came from, at the wall's restitution."""
    ideal = TableSpec(drag=0.0, friction=0.0)
    bodies = table_with((0.7, TABLE.goal / 2 - 1e-9, 3.0, 0.0))
    for _ in range(10):
        step_physics(bodies, NOWHERE, ideal)
    assert bodies[PUCK, VX] == pytest.approx(-3.0 * ideal.wall_restitution, rel=1e-3)


def test_friction_stops_the_puck():
    bodies = table_with((0.0, 0.0, 0.03, 0.0))
    for _ in range(250):
        step_physics(bodies, NOWHERE, TABLE)
    assert (bodies[PUCK, 2:] == 0).all()


def test_a_paddle_keeps_to_its_limits_and_arrives():
    bodies = table_with((0.5, 0.3, 0.0, 0.0), left=(-0.8, -0.4))
    target = np.array([[-0.2, 0.4], [np.nan, np.nan]])
    velocity = bodies[LEFT, 2:].copy()
    for _ in range(60):
        step_physics(bodies, target, TABLE)
        assert np.hypot(*bodies[LEFT, 2:]) <= TABLE.paddle_speed * (1 + 1e-12)
        assert np.hypot(*(bodies[LEFT, 2:] - velocity)) <= TABLE.paddle_acceleration * TABLE.tick * (1 + 1e-9)
        velocity = bodies[LEFT, 2:].copy()
    assert bodies[LEFT, :2] == pytest.approx(target[LEFT], abs=1e-3)


def test_a_wedged_puck_is_not_shot_out_faster_than_strokes_can_make_it():
    """Paddle and wall alternately, at their best: v = (1 + e) V / (1 - e e_wall), whatever the angle of the wedge."""
    rng = np.random.default_rng(0)
    fastest = (
        (1 + TABLE.paddle_restitution) * TABLE.paddle_speed / (1 - TABLE.paddle_restitution * TABLE.wall_restitution)
    )
    for _ in range(300):
        bodies = table_with((rng.uniform(-0.9, -0.05), SIDE, 0.0, 0.0), left=(rng.uniform(-0.9, -0.05), 0.2))
        for _ in range(100):
            target = bodies[PUCK, :2] + rng.normal(0, 0.05, 2)
            goal, _ = step_physics(bodies, np.array([target, [np.nan, np.nan]]), TABLE)
            assert np.hypot(*bodies[PUCK, 2:]) < 1.2 * fastest  # sideways it keeps what it had
            if goal:
                break


def test_a_puck_squeezed_into_the_wall_stays_on_the_table():
    bodies = table_with((-0.4, SIDE - 0.01, 0.0, 0.0), left=(-0.4, 0.3))
    target = np.array([[-0.4, 0.6], [np.nan, np.nan]])
    for _ in range(100):
        step_physics(bodies, target, TABLE)
        assert abs(bodies[PUCK, Y]) <= SIDE + 1e-9
        assert np.hypot(*(bodies[PUCK, :2] - bodies[LEFT, :2])) >= TOUCHING - 1e-3


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("length", -1.0),
        ("goal", 2.0),
        ("wall_restitution", 1.2),
        ("drag", float("nan")),
        ("tick", 0.0),
        ("tick", 1e300),
        ("paddle_speed", float("inf")),
        ("paddle_acceleration", 1e200),
        ("puck_radius", 1e-300),
        ("substeps", 0),
        ("substeps", 2.0),  # of a loop that is compiled for whole numbers
        ("substeps", 10**12),
        ("width", "wide"),
        ("goal", None),
        ("friction", True),
    ],
)
def test_a_table_that_cannot_be_played_on_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=re.escape(f"table.{field} = {value!r}")):
        check_table(TABLE._replace(**{field: value}))


def test_a_paddle_that_has_no_room_in_its_half_is_refused():
    """Its bounds would be the wrong way round, and it would live on the other side."""
    wide = TableSpec(length=1.5, width=2.0, paddle_radius=0.4)
    with pytest.raises(ValueError, match=r"table\.paddle_radius = 0\.4 must be below a quarter of the table's length"):
        check_table(wide)
    assert check_table(wide._replace(length=1.7))


# coasting: nobody steers


def coasted(bodies, seconds, table=TABLE):
    moved = np.array(bodies)[None]
    coast(moved, seconds, table)
    return moved[0]


def at_rest(bodies):
    still = bodies.copy()
    still[[LEFT, RIGHT], 2:] = 0.0
    return still


@settings(max_examples=300)
@given(legal_states(), st.integers(0, 25))
def test_a_puck_coasts_as_it_moves_between_paddles_at_rest(state, ticks):
    """In free flight, off walls, posts and paddles: the table's ticks to the bit, until it scores."""
    bodies = at_rest(state[0])
    moved = coasted(bodies, ticks * TABLE.tick)
    for _ in range(ticks):
        goal, _ = step_physics(bodies, NOWHERE, TABLE)
        if goal:
            assert np.array_equal(moved[PUCK], [*bodies[PUCK, :2], 0.0, 0.0])
            return
    assert np.array_equal(moved, bodies)


@settings(max_examples=300)
@given(legal_states(), st.floats(0, 0.5))
def test_paddles_coast_to_the_bounds_of_their_halves(state, seconds):
    bodies, _ = state
    bodies[PUCK] = 0.0, 0.0, 0.0, 0.0
    middle, half = action_range(TABLE)
    expected = bodies[[LEFT, RIGHT], :2] + seconds * bodies[[LEFT, RIGHT], 2:]
    for agent, turn in ((LEFT, 1), (RIGHT, -1)):
        expected[agent] = np.clip(expected[agent], turn * middle - half, turn * middle + half)
    moved = coasted(bodies, seconds, TABLE._replace(puck_radius=1e-6))
    assume(np.hypot(*moved[PUCK, 2:]) == 0)  # nobody met the puck
    assert np.abs(moved[[LEFT, RIGHT], :2] - expected).max() < 1e-9


@settings(max_examples=100)
@given(legal_states())
def test_a_coasting_puck_passes_no_wall_and_no_paddle(state):
    """Sampled so densely that the puck could not be beyond a paddle without having been seen in it."""
    bodies, _ = state
    for seconds in np.linspace(0, 0.2, 101):
        moved = coasted(bodies, seconds)
        x, y = moved[PUCK, :2]
        assert abs(y) <= SIDE + 1e-9
        assert abs(x) <= END + 1e-9 or abs(y) < TABLE.goal / 2
        if abs(x) > TABLE.length / 2:
            assert not moved[PUCK, 2:].any()
            break
        for agent in (LEFT, RIGHT):
            assert np.hypot(*(moved[PUCK, :2] - moved[agent, :2])) >= TOUCHING - 1e-3


@settings(max_examples=200)
@given(legal_states(), st.floats(0, 0.3))
def test_coasting_is_the_same_for_either_agent(state, seconds):
    bodies, swapped = state[0], [RIGHT, LEFT, PUCK]
    assert np.array_equal(coasted(-bodies[swapped], seconds), -coasted(bodies, seconds)[swapped])


@settings(max_examples=200)
@given(legal_states(), st.integers(0, 10), st.integers(0, 10), st.floats(1e-6, 0.019))
def test_coasting_is_one_tick_after_the_other_and_a_shorter_last_one(state, first, then, rest):
    bodies, _ = state
    whole = coasted(bodies, (first + then) * TABLE.tick)
    assert np.array_equal(coasted(coasted(bodies, first * TABLE.tick), then * TABLE.tick), whole)
    shorter = coasted(bodies, first * TABLE.tick + rest)
    expected = coasted(coasted(bodies, first * TABLE.tick), rest, TABLE._replace(tick=rest))
    assert np.abs(shorter - expected).max() < 1e-9
    assert np.array_equal(coasted(bodies, 0.0), bodies)


def test_a_puck_that_coasts_into_a_goal_stays_and_the_paddles_go_on():
    bodies = table_with((0.9, 0.0, 5.0, 0.0), left=(-0.5, 0.0))
    bodies[LEFT, 2:] = 1.0, -0.5
    soon, later = coasted(bodies, 0.1), coasted(bodies, 0.2)
    substep = TABLE.tick / TABLE.substeps
    assert 0 < soon[PUCK, X] - TABLE.length / 2 < 5.0 * substep and not soon[PUCK, 2:].any()
    assert np.array_equal(later[PUCK], soon[PUCK])
    assert np.allclose(soon[LEFT], (-0.4, -0.05, 1.0, -0.5)) and np.allclose(later[LEFT], (-0.3, -0.1, 1.0, -0.5))


def test_many_tables_coast_as_each_alone():
    bodies = np.stack([table_with((x, 0.1, -4.0, 3.0)) for x in np.linspace(-0.5, 0.5, 9)])
    together = bodies.copy()
    coast(together, 0.15, TABLE)
    assert all(np.array_equal(one, coasted(alone, 0.15)) for one, alone in zip(together, bodies, strict=True))
