"""Motor adaptation: the published two-rate model, the fields that people learn, and nothing else in today's people."""

from functools import cache

import numpy as np
import pytest

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users import Population, SimulatedUsers, personal_streams, sample_people
from guidance.simulated_users.adaptation import FAST, SLOW, expected_force, is_on, learn, recall
from guidance.simulated_users.force_response import Variant, respond_to_force
from guidance.simulated_users.state import USER_STATE
from guidance.simulated_users.validation.adaptation_tasks import (
    CURL,
    FIELDS,
    NO_FIELD,
    after_effects,
    channel,
    compensation,
    curl,
    random_field,
    reach_in_fields,
    spontaneous_recovery,
    viscous,
)

TABLE, VARIANTS = TableSpec(), tuple(Variant.__members__)
PEOPLE = sample_people(6, 3)
# Smith, Ghazizadeh & Shadmehr 2006
RETENTION, LEARNING_RATE = np.array([0.59, 0.992]), np.array([0.21, 0.02])


def two_rates(forces: np.ndarray) -> np.ndarray:
    """(movements, 2) what the fast and the slow memory of the published model expect after each movement."""
    x, out = np.zeros(2), []
    for force in forces:
        x = RETENTION * x + LEARNING_RATE * (force - x.sum())
        out.append(x)
    return np.array(out)


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.3, -0.2), (0.02, 0.05), (1.4, 0.0)])
def test_a_constant_surprise_is_learned_as_published(velocity):
    """Whatever the velocity: ten movements with the same surprise are ten steps of the discrete model."""
    person, state, tick = PEOPLE[0].copy(), np.zeros(1, USER_STATE)[0], 0.01
    person["movement_time"] = 0.5
    x, goal = np.zeros(2), 2.0
    for _ in range(10):
        x = RETENTION * x + LEARNING_RATE * goal
        for _ in range(50):
            expected = expected_force(person, state, *velocity)
            learn(person, state, *velocity, expected[0] + goal, expected[1] - goal, tick)
        for memory in (FAST, SLOW):
            own = recall(person, state, memory, *velocity)
            assert own == pytest.approx((x[memory], -x[memory]), rel=1e-9)


def test_what_is_learned_in_the_end_is_the_closed_form():
    """sum_i q_i / (1 + sum_i q_i) with q_i = b_i / (1 - a_i), of a field met at any velocities."""
    person, state, rng = PEOPLE[0], np.zeros(1, USER_STATE)[0], np.random.default_rng(0)
    field = np.array([[3.0, -8.0], [5.0, 1.0]])
    for _ in range(60_000):
        velocity = 0.3 * rng.standard_normal(2)
        learn(person, state, *velocity, *(field @ velocity), 0.02)
    q = (LEARNING_RATE / (1 - RETENTION)).sum()
    learned = state["learned"].sum(axis=0)
    assert learned[:, :2] == pytest.approx(field * q / (1 + q), rel=0.03)
    assert np.abs(learned[:, 2]).max() < 0.1


def test_what_is_not_met_is_not_forgotten():
    person, state = PEOPLE[0], np.zeros(1, USER_STATE)[0]
    state["learned"][:, 0, 0] = 4.0  # a force along x, by the velocity along x
    for _ in range(1000):
        learn(person, state, 0.0, 0.0, 0.0, 0.0, 0.02)
    assert (state["learned"][:, 0, 0] == 4.0).all()
    learn(person, state, 0.2, 0.0, 0.0, 0.0, 0.02)
    assert (state["learned"][:, 0, 0] < 4.0).all()


def play(variant: str, adaptation: bool, force, people=PEOPLE, ticks=600):
    """Actions (ticks, n, 2) and the people, who see a puck that moves about."""
    users = SimulatedUsers(people, personal_streams(len(people), 1), TABLE, variant, adaptation=adaptation)
    state, actions = np.zeros((len(people), 12)), []
    state[:, 0], state[:, 4] = -TABLE.length / 4, TABLE.length / 4
    for tick in range(ticks):
        state[:, 8], state[:, 9] = 0.6 * np.cos(0.03 * tick), 0.3 * np.sin(0.05 * tick)
        state[:, 10], state[:, 11] = -0.9 * np.sin(0.03 * tick), 0.75 * np.cos(0.05 * tick)
        actions.append(users.step(state, force(users)).copy())
    return np.array(actions), users


@pytest.mark.parametrize("variant", VARIANTS)
def test_without_a_force_adaptation_changes_no_bit(variant):
    none = np.zeros((len(PEOPLE), 2))
    (adapting, users), (fixed, _) = (play(variant, on, lambda _: none) for on in (True, False))
    assert np.array_equal(adapting, fixed)
    assert not users.learned.any()
    pushed = [play(variant, on, lambda _: none + 1.0)[0] for on in (True, False)]
    assert not np.array_equal(*pushed)


@pytest.mark.parametrize("variant", VARIANTS)
def test_strong_springs_leave_people_sound(variant):
    """9 N, and K = 200 N/m toward and away from the hand's own motion."""
    directions = np.random.default_rng(0).standard_normal((600, len(PEOPLE), 2))
    draws = iter(9.0 * directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    springs = (
        lambda users: next(draws),
        lambda users: np.clip(200.0 * (users.goal - users.hand), -9.0, 9.0),
        lambda users: np.clip(200.0 * (0.1 * users.hand_velocity), -9.0, 9.0),
        lambda users: np.clip(-200.0 * (users.hand - 0.04), -9.0, 9.0),
    )
    for spring in springs:
        actions, users = play(variant, True, spring)
        assert np.isfinite(actions).all() and np.isfinite(users.learned).all()
        assert np.abs(users.learned).max() < 9.0 / 0.1 and users.learned.any()


@cache
def compensated(variant: str) -> dict[str, np.ndarray]:
    return compensation(PEOPLE, variant)


@pytest.mark.parametrize("variant", VARIANTS)
def test_fields_are_compensated_as_by_people(variant):
    for field in FIELDS:
        early, late = (compensated(variant)[f"{field}, compensated after {time}"] for time in ("30 s", "2 min"))
        assert np.all((early > 0.5) & (early < 0.85)) and np.all((late > early) & (late < 0.87))


def test_a_reach_is_one_step_of_the_published_model():
    data = reach_in_fields(PEOPLE, [viscous(-5.0)] * 40, "passive")
    shares = [data.compensated(slice(reach - 2, reach)).mean() for reach in (10, 20, 40)]
    assert shares == pytest.approx(two_rates(np.ones(40)).sum(1)[[9, 19, 39]], abs=0.06)


@pytest.mark.parametrize("variant", VARIANTS)
def test_after_effects_are_opposite(variant):
    for field, share in after_effects(PEOPLE, variant).items():
        assert 0.1 < share.mean() < 1.2, field
    without = PEOPLE.copy()
    without["fast_learning_rate"] = without["slow_learning_rate"] = 0.0
    sideways = after_effects(without, variant)["curl field of 10 N s/m, after-effect"]
    assert abs(sideways.mean()) < 0.3


def test_the_first_field_recovers_by_itself_in_a_channel():
    """By the slow memory, which the short time in the opposite field has not erased."""
    fast_only = PEOPLE.copy()
    fast_only["slow_learning_rate"] = 0.0
    both, fast = (spontaneous_recovery(people, "comply_or_resist").mean() for people in (PEOPLE, fast_only))
    assert both > 0.08 and fast < 0.03


def test_a_channel_measures_what_is_expected():
    data = reach_in_fields(PEOPLE, [curl(CURL)] * 40 + [channel] * 6, "passive")
    along, expected = data.velocity[-6:, ..., 1], data.expected[-6:, ..., 0]
    share = (expected * along).sum((0, 1)) / (CURL * along * along).sum((0, 1))
    assert data.against_walls(CURL)[-6:].mean(0) == pytest.approx(share, abs=0.08)
    assert np.abs(data.hand[-5:, ..., 0]).mean() < 0.001


def test_of_a_random_field_only_the_mean_is_learned():
    assert np.abs(random_field(PEOPLE, "comply_or_resist")).max() < 0.05


def test_stiffness_rises_with_surprise_and_relaxes_as_the_field_is_learned():
    person, state = PEOPLE[0], np.zeros(1, USER_STATE)[0]

    def respond(surprise: float, ticks: int) -> float:
        for _ in range(ticks):
            both = (1.0, 0.0), (surprise, 0.0)
            respond_to_force(person, state, (0.0, 0.0), *both, (0.0, 0.0), True, Variant.comply_or_resist, 0.02)
        return state["co_contraction"]

    at_first = respond(1.0, 50)
    assert at_first == pytest.approx(1.0 / person["saturating_conflict"], abs=0.02)
    assert respond(-0.2, 100) == pytest.approx(0.2 / person["saturating_conflict"], abs=0.01)


def test_own_effort_gives_way_to_support_only_gradually():
    person, state = PEOPLE[0].copy(), np.zeros(1, USER_STATE)[0]
    person["resistance"], state["goal_x"] = 0.0, 0.05
    pushes = []
    for force in [1.0] * 1000 + [-1.0] * 1000:
        both = (force, 0.0), (force, 0.0)
        respond_to_force(person, state, (0.0, 0.0), *both, (0.0, 0.0), True, Variant.comply_or_resist, 0.02)
        pushes.append(state["push_x"])
    full = -person["slacking"] * 0.05 / (0.05 + person["goal_radius"])
    assert 0.3 * full < pushes[50] < 0.0  # after 1 s of 5
    assert pushes[999] == pytest.approx(full, rel=0.15)
    assert abs(pushes[-1]) < 0.05 * abs(full)


def test_what_is_learned_outlasts_rounds_and_games_and_can_be_carried_over():
    _, users = play("comply_or_resist", True, lambda users: 3.0 * users.hand_velocity + 1.0)
    learned, everyone = users.learned, np.ones(len(PEOPLE), dtype=bool)
    users.new_round(everyone)
    users.new_game(everyone)
    assert learned.any() and np.array_equal(users.learned, learned)
    fresh = SimulatedUsers(PEOPLE, personal_streams(len(PEOPLE), 1))
    assert not fresh.learned.any()
    fresh.carry_over(np.array([0, 4]), users, np.array([3, 1]))
    assert np.array_equal(fresh.learned[[0, 4]], learned[[3, 1]]) and not fresh.learned[[1, 2, 3, 5]].any()


def test_people_are_those_of_before_with_the_same_numbers_of_adaptation():
    same = sample_people(4, 9, Population.default(slow_retention=0.5, movement_time=2.0))
    usual = sample_people(4, 9)
    for name in usual.dtype.names:
        assert np.array_equal(usual[name], same[name]) != (name in ("slow_retention", "movement_time")), name


def test_the_switch_is_on_or_off():
    assert [is_on(value) for value in ("on", True, "true", "off", False, "false")] == [True] * 3 + [False] * 3
    for value in ("maybe", None, 1, ""):
        with pytest.raises(ValueError, match=r"users\.adaptation = .* must be on or off"):
            is_on(value)


def test_no_field_is_no_force():
    assert not NO_FIELD(np.ones((2, 2)), np.ones((2, 2))).any()
