"""The hand at the end of an arm: its mechanics, and the paddle that it steers."""

from math import cos, exp, hypot, sin, sqrt

import numpy as np
import pytest

from airhockey_marl.envs.hand_arm import HandArm, arm_from_config, move_hand
from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, VX, VY, TableSpec, X, Y
from airhockey_marl.envs.world import World

ARM, TICK, N = HandArm(), TableSpec().tick, 20


def step_response(arm: HandArm, target: float, seconds: float) -> float:
    """x(t) of m x'' = K (target - x) - b x' from rest at 0, underdamped."""
    decay = arm.damping / (2 * arm.mass)
    omega = sqrt(arm.stiffness / arm.mass - decay**2)
    return target * (1 - exp(-decay * seconds) * (cos(omega * seconds) + decay / omega * sin(omega * seconds)))


@pytest.mark.parametrize("action", [(0.5, 0.0), (0.0, -0.5), (-0.3, 0.4)])
def test_a_weak_step_is_answered_as_by_the_linear_oscillator(action):
    """The force stays below its limit. Half the time step halves the error: the equation is right, not only close."""
    errors = []
    for parts in (1, 2):
        hand, worst = np.zeros(4), 0.0
        for tick in range(1, 50):
            for _ in range(parts):
                move_hand(hand, np.array(action), TICK / parts, ARM)
            expected = [step_response(ARM, ARM.reach * u, tick * TICK) for u in action]
            worst = max(worst, *np.abs(hand[:2] - expected))
        errors.append(worst / (ARM.reach * hypot(*action)))
    assert errors[0] < 0.02 and errors[1] == pytest.approx(errors[0] / 2, rel=0.1)


def test_the_norm_of_the_force_is_limited():
    """Across the whole workspace, without damping: the acceleration is the limit's until the spring is weaker."""
    arm = ARM._replace(damping=0.0)
    hand = np.array([-arm.reach, -arm.reach, 0.0, 0.0])
    for tick in range(1, 5):
        move_hand(hand, np.ones(2), TICK, arm)
        assert arm.stiffness * hypot(arm.reach - hand[X], arm.reach - hand[Y]) > arm.max_force
        speed = arm.max_force / arm.mass * tick * TICK
        assert (hand[VX], hand[VY]) == pytest.approx((speed / sqrt(2), speed / sqrt(2)))


def test_the_workspace_ends_at_the_reach_and_actions_beyond_it_are_those_at_its_edge():
    far, edge = np.zeros(4), np.zeros(4)
    for _ in range(100):
        move_hand(far, np.array([7.0, -7.0]), TICK, ARM)
        move_hand(edge, np.array([1.0, -1.0]), TICK, ARM)
        assert np.abs(far[:2]).max() <= ARM.reach
        assert np.array_equal(far, edge)
    assert far == pytest.approx([ARM.reach, -ARM.reach, 0, 0], abs=1e-6)


def test_an_action_of_nan_exerts_no_force():
    hand, nothing = np.array([0.01, 0.0, 0.2, 0.0]), np.full(2, np.nan)
    move_hand(hand, nothing, TICK, ARM)
    assert hand[VX] == pytest.approx(0.2 * exp(-ARM.damping / ARM.mass * TICK), rel=0.01) and hand[Y] == 0.0


def play(world: World, ticks: int, seed: int = 0) -> list[np.ndarray]:
    """Random actions of both agents, each held for five ticks; also those that were played."""
    rng, played = np.random.default_rng(seed), []
    for tick in range(ticks):
        actions = rng.uniform(-1.2, 1.2, (world.n, 2, 2)) if tick % 5 == 0 else played[-1]
        world.step(actions)
        world.new_rounds(world.goals != 0)
        played.append(actions)
    return played


def test_the_paddle_follows_the_hand_as_without_an_arm_it_follows_the_action():
    behind, plain = World(N, arm=ARM), World(N)
    behind.new_rounds(), plain.new_rounds()
    rng, actions = np.random.default_rng(0), np.zeros((N, 2, 2))
    for tick in range(300):
        if tick % 5 == 0:
            actions = rng.uniform(-1, 1, (N, 2, 2))
        behind.step(actions)
        plain.step(behind.hands[..., :2] / ARM.reach)
        assert np.array_equal(behind.bodies, plain.bodies) and np.array_equal(behind.goals, plain.goals)
        behind.new_rounds(behind.goals != 0), plain.new_rounds(plain.goals != 0)
    assert not plain.hands.any()


def test_the_sides_are_equal():
    """A table after a half turn, with the actions of the agents exchanged, plays on as that."""
    one, other = World(N, arm=ARM), World(N, arm=ARM)
    one.new_rounds()
    other.bodies[:] = -one.bodies[:, [RIGHT, LEFT, PUCK]]
    rng = np.random.default_rng(0)
    for _ in range(40):  # 0.8 s: no puck is served again
        actions = rng.uniform(-1, 1, (N, 2, 2))
        one.step(actions), other.step(actions[:, ::-1].copy())
        assert np.allclose(other.bodies, -one.bodies[:, [RIGHT, LEFT, PUCK]], atol=1e-12)
        assert np.array_equal(other.hands, one.hands[:, ::-1])


def test_a_round_begins_with_the_hands_at_rest_in_the_middle():
    world = World(N, arm=ARM)
    world.new_rounds()
    play(world, 10)
    before, mask = world.hands.copy(), np.arange(N) % 2 == 0
    world.new_rounds(mask)
    assert not world.hands[mask].any() and np.array_equal(world.hands[~mask], before[~mask]) and before[mask].any()


def test_a_decision_held_for_two_ticks_is_one_of_two_steps():
    one, other = World(N, arm=ARM), World(N, arm=ARM)
    one.new_rounds(), other.new_rounds()
    actions = np.random.default_rng(0).uniform(-1, 1, (N, 2, 2))
    one.step(actions, 2)
    other.step(actions), other.step(actions)
    assert np.array_equal(one.bodies, other.bodies) and np.array_equal(one.hands, other.hands)


def test_no_arm_in_the_configuration_is_none_and_the_numbers_of_one_are_its_fields():
    assert arm_from_config(None) is None
    assert arm_from_config({}) == ARM and arm_from_config({"mass": 2.0}) == ARM._replace(mass=2.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mass": 0.0}, r"env\.arm\.mass = 0\.0 must be a finite number of at least 1e-06"),
        ({"damping": -1.0}, r"env\.arm\.damping = -1\.0 must be a finite number of at least 0"),
        ({"max_force": float("inf")}, r"env\.arm\.max_force = inf must be a finite number"),
        ({"reach": "far"}, r"env\.arm\.reach = 'far' must be a finite number"),
        ({"stiffness": 1e5}, r"env\.arm\.stiffness = 100000\.0 must be a finite number at most 78125"),
        ({"length": 1.0}, r"env\.arm\.length: no such setting, must be one of mass, damping"),
        (3, r"env\.arm = 3 must be a mapping"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        arm_from_config(settings)
