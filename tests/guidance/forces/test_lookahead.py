"""The readings of the look-ahead: where they agree, what they are for, and what reaches the hand."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from airhockey_marl.envs.physics import TableSpec, action_range, coast
from airhockey_marl.players.networks import GaussianPolicy
from guidance.forces.beyond import ProductGuidance
from guidance.forces.condition_specs import ConditionSpec
from guidance.forces.conditions import (
    OPTIMAL,
    CombinedGuidance,
    Condition,
    GuidanceOutput,
    GuidanceSettings,
    Spring,
    SpringGuidance,
    Thresholds,
)
from guidance.forces.equations import lookahead_state
from guidance.forces.lookahead import (
    CONSISTENT,
    PHYSICS,
    PRINTED,
    READINGS,
    Lookahead,
    moved_state,
    paddle_as_action,
    relative_target,
)
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.models import Models
from tests.airhockey_marl.envs.test_physics import legal_states

TABLE, SPRING = TableSpec(), Spring(50.0, 3.0, 0.075)
TOUCHING = TABLE.puck_radius + TABLE.paddle_radius
coordinate = st.floats(-1.0, 1.0, width=32)
vector = st.tuples(coordinate, coordinate)
speeds = st.tuples(st.floats(-8.0, 8.0, width=32), st.floats(-8.0, 8.0, width=32))  # in units of action per second


def state_with(own=(-0.5, 0.0, 0.0, 0.0), other=(0.5, 0.0, 0.0, 0.0), puck=(0.0, 0.3, 0.0, 0.0)) -> torch.Tensor:
    return torch.tensor((*own, *other, *puck))


# the state


@pytest.mark.parametrize("reading", READINGS)
def test_no_time_leaves_the_state_as_it_is(reading):
    states = torch.randn(3, 5, 12, generator=torch.Generator().manual_seed(0))
    assert torch.equal(moved_state(states, 0.0, reading), states)


@settings(max_examples=100)
@given(legal_states(), st.floats(0, 0.3))
def test_physics_is_the_tables_own_and_leaves_its_argument_alone(state, seconds):
    bodies, _ = state
    observation = torch.from_numpy(bodies.reshape(12)).expand(2, 12).clone()
    before = observation.clone()
    moved = moved_state(observation, seconds, PHYSICS)
    coast(bodies[None], seconds, TABLE)
    assert torch.equal(moved, torch.from_numpy(bodies.reshape(12)).expand(2, 12))
    assert torch.equal(observation, before) and torch.equal(moved_state(observation, seconds, CONSISTENT), moved)


def test_physics_takes_tensors_of_both_precisions_and_any_shape():
    states = torch.stack([state_with(puck=(x, 0.1, -2.0, 1.0)) for x in torch.linspace(-0.3, 0.8, 12).tolist()])
    moved = moved_state(states, 0.1, PHYSICS)
    assert moved.dtype == torch.float32 and moved.shape == (12, 12)
    assert torch.equal(moved_state(states.view(3, 2, 2, 12), 0.1, PHYSICS).view(12, 12), moved)
    assert torch.allclose(moved.double(), moved_state(states.double(), 0.1, PHYSICS), atol=1e-6)


def test_bodies_that_meet_nothing_move_alike_but_for_the_drag():
    state = state_with(own=(-0.5, 0.0, 0.4, -0.3), puck=(0.1, 0.2, -1.0, 0.5))
    printed, physics = (moved_state(state, 0.1, reading) for reading in (PRINTED, PHYSICS))
    assert torch.equal(printed, lookahead_state(state, 0.1))
    assert torch.allclose(printed[:8], physics[:8], atol=1e-6)
    lost = (1 - physics[8:12] / printed[8:12]) > 0
    assert lost[2:].all() and torch.allclose(printed[8:12], physics[8:12], atol=0.02)


def test_only_as_printed_the_puck_is_behind_the_paddle_a_moment_later():
    state = state_with(own=(-0.6, 0.0, 0.0, 0.0), puck=(-0.4, 0.0, -3.0, 0.0))
    printed, physics = (moved_state(state, 0.1, reading) for reading in (PRINTED, PHYSICS))
    assert printed[8] < -0.6 and physics[8] > -0.6 + TOUCHING and physics[10] > 0


@settings(max_examples=100)
@given(legal_states(fastest=8.0), st.floats(0, 0.2))
def test_under_physics_no_body_is_in_another_or_off_the_table(state, seconds):
    moved = moved_state(torch.from_numpy(state[0].reshape(12)).float(), seconds, PHYSICS).double()
    own, other, puck = moved[0:2], moved[4:6], moved[8:10]
    assert puck[1].abs() <= TABLE.width / 2 - TABLE.puck_radius + 1e-6
    if puck[0].abs() <= TABLE.length / 2:
        assert min((puck - own).norm(), (puck - other).norm()) >= TOUCHING - 1e-3
        assert puck[0].abs() <= TABLE.length / 2 - TABLE.puck_radius + 1e-6 or puck[1].abs() < TABLE.goal / 2
    position, _ = paddle_as_action(moved, TABLE)
    assert position.abs().max() <= 1 + 1e-6


# the target


@given(vector, speeds, st.floats(0, 1), st.booleans())
def test_a_model_that_only_extrapolates_the_hand_gives_no_force(hand, velocity, seconds, keeps_to_the_range):
    hand, velocity = torch.tensor(hand), torch.tensor(velocity)
    mean = hand + seconds * velocity
    mean = mean.clamp(-1.0, 1.0) if keeps_to_the_range else mean
    assert torch.equal(SPRING.force(hand, relative_target(hand, velocity, mean, seconds)), torch.zeros(2))


@given(vector, speeds, vector, st.floats(0, 0.2))
def test_a_target_apart_from_the_hand_is_that_of_a_damped_spring(hand, velocity, mean, seconds):
    """Where neither the clip nor the end of the hand's range cuts in: F = -K (u - y) - K T u'."""
    hand, velocity, mean = (0.3 * torch.tensor(value).double() for value in (hand, velocity, mean))
    spring = Spring(50.0, 1e6, 0.075)
    force = spring.force(hand, relative_target(hand, velocity, mean, seconds))
    expected = 50.0 * 0.075 * ((mean - hand) - seconds * velocity)
    assert torch.allclose(force, expected, atol=1e-9)


def test_the_hand_is_not_extrapolated_beyond_its_range():
    hand, velocity = torch.tensor([0.9, 0.0]), torch.tensor([5.0, 0.0])
    for mean, expected in ((0.5, 0.9 + (0.5 - 1.0)), (1.2, 0.9 + (1.2 - 1.2)), (1.6, 0.9 + (1.6 - 1.4))):
        target = relative_target(hand, velocity, torch.tensor([mean, 0.0]), 0.1)
        assert torch.allclose(target, torch.tensor([expected, 0.0]))


@pytest.mark.parametrize("reading", READINGS)
def test_readings_agree_without_a_lookahead(reading):
    hand, mean, state = torch.randn(7, 2), 2 * torch.randn(7, 2), torch.randn(7, 12)
    lookahead = Lookahead(0.0, reading)
    assert torch.equal(lookahead.target(hand, mean, state, 0.0), mean)
    assert torch.equal(moved_state(state, lookahead.seconds, reading), state)


def test_only_consistent_compares_with_the_hand_as_it_will_be():
    hand, mean = torch.zeros(2), torch.tensor([0.2, 0.0])
    state = state_with(own=(-0.5, 0.0, 1.0, 0.0))
    _, half = action_range(TABLE)
    for reading, expected in ((PRINTED, 0.2), (PHYSICS, 0.2), (CONSISTENT, 0.2 - 0.1 / half[0])):
        target = Lookahead(0.1, reading).target(hand, mean, state, 0.1)
        assert torch.allclose(target, torch.tensor([expected, 0.0], dtype=torch.float32))


# models and guidances


@pytest.fixture(scope="module")
def models() -> Models:
    torch.manual_seed(0)
    return Models(GaussianPolicy([16]), GaussianPolicy([16]), GaussianPolicy([16]), 0.1, {}, ahead=0.15)


@pytest.mark.parametrize("reading", READINGS)
def test_each_model_has_the_state_and_the_hand_of_its_own_moment(models, reading):
    """A user model for 0.15 s ahead, and T_lookahead below and above that."""
    state, hand, mean = state_with(own=(-0.5, 0.1, 0.8, 0.4))[None], torch.zeros(1, 2), torch.full((1, 2), 0.3)
    for seconds, user_state, user_hand in ((0.1, 0.0, 0.15), (0.2, 0.05, 0.2)):
        lookahead = Lookahead(seconds, reading)
        for name, state_seconds, hand_seconds in (("optimal", seconds, seconds), ("user", user_state, user_hand)):
            moved = models.lookahead_state(name, state, lookahead)
            assert torch.allclose(moved, moved_state(state, state_seconds, reading))
            target = models.target(name, hand, mean, state, lookahead)
            assert torch.equal(target, lookahead.target(hand, mean, state, hand_seconds))


class Half:
    """A guidance as a plug-in has it: half of OAHG's force."""

    def models(self):
        return frozenset({OPTIMAL})

    def __call__(self, state, hand, predictions):
        return GuidanceOutput(0.5 * SPRING.force(hand, predictions[OPTIMAL].mean))


def condition(name: str, guidance) -> Condition:
    return Condition(ConditionSpec(name, "a", name), guidance)


@pytest.mark.parametrize("reading", READINGS)
def test_every_guidance_gets_the_targets_of_the_reading(models, reading):
    """Springs in one batch, combinations, and guidances of others that know nothing of a look-ahead."""
    oahg, uphg = SpringGuidance("optimal", SPRING), SpringGuidance("adapted", SPRING)
    thresholds = {"optimal": Thresholds(0.1, 0.9), "user": Thresholds(0.1, 0.9)}
    product = ProductGuidance(GuidanceSettings(SPRING, thresholds))
    guidances = {"oahg": oahg, "uphg": uphg, "comb": CombinedGuidance(oahg, uphg, True), "half": Half()}
    conditions = [condition(name, guidance) for name, guidance in (guidances | {"product": product}).items()]
    generator = torch.Generator().manual_seed(1)
    users, lookahead = 6, Lookahead(0.2, reading)
    adapted = models.adapted_to([(torch.randn(9, 12, generator=generator), torch.randn(9, 2, generator=generator))] * 6)
    middle, half = action_range(TABLE)
    state = torch.zeros(users, 12)
    state[:, 0:2], state[:, 2:4] = torch.from_numpy(middle), torch.randn(users, 2, generator=generator)
    state[:, 4], state[:, 8:10], state[:, 10:] = 0.6, 0.2, torch.randn(users, 2, generator=generator)
    hand = 0.5 * torch.randn(users, 2, generator=generator)
    guidance = BatchedGuidance([c.guidance for c in conditions], users, models, adapted, lookahead)
    repeated = (np.tile(part.double().numpy(), (len(conditions), 1)) for part in (state, hand))
    force = guidance(*repeated).force.unflatten(0, (len(conditions), users)).float()
    with torch.no_grad():
        mean, _ = models.optimal(moved_state(state, 0.2, reading))
    if reading == CONSISTENT:
        mean = relative_target(hand, state[:, 2:4] / torch.from_numpy(half).float(), mean, 0.2)
    assert torch.allclose(force[0], SPRING.force(hand, mean), atol=1e-5)
    assert torch.allclose(force[3], force[0] / 2, atol=1e-6)
    for index, alone in enumerate(conditions):
        single = BatchedGuidance([alone.guidance], users, models, adapted, lookahead)
        assert torch.equal(single(state.double().numpy(), hand.double().numpy()).force.float(), force[index])


def test_the_readings_pull_differently(models):
    state = state_with(own=(-0.5, 0.0, 1.0, 0.5), puck=(-0.4, 0.02, -3.0, 0.0)).double().numpy()[None]
    forces = [
        BatchedGuidance([SpringGuidance("optimal", SPRING)], 1, models, None, Lookahead(0.1, reading))(
            state, np.zeros((1, 2))
        ).force
        for reading in READINGS
    ]
    assert all((forces[i] - forces[j]).norm() > 1e-4 for i, j in ((0, 1), (0, 2), (1, 2)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lookahead(-0.1), r"guidance\.lookahead\.seconds = -0\.1 must be a finite number of at least 0"),
        (lambda: Lookahead(1.5), r"guidance\.lookahead\.seconds = 1\.5"),
        (lambda: Lookahead(0.1, "both"), r"reading = both must be one of printed, physics, consistent"),
        (lambda: moved_state(torch.ones(12), float("inf"), PHYSICS), "seconds: inf, must be finite"),
        (lambda: moved_state(torch.ones(12), -0.1, PHYSICS), "seconds: -0.1, must be finite"),
        (lambda: moved_state(torch.ones(8), 0.1, PHYSICS), r"state: torch.float32 \(8,\), must be floating point"),
        (lambda: moved_state(torch.ones(12, dtype=torch.int64), 0.1, PHYSICS), "must be floating point"),
    ],
)
def test_wrong_values_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
