"""Eq. 4 to 7 by hand, at their limits, and their properties for any force."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from guidance.forces.equations import combine, lookahead_state, similarity_weight, spring_force, uncertainty_weight

coordinate = st.floats(-1e3, 1e3, allow_subnormal=False)
vector = st.tuples(coordinate, coordinate)
positive = st.floats(1e-3, 1e3)
angle = st.floats(-math.pi, math.pi)
exponent = st.floats(-30, 30)


def tensor(*values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype)


def rotated(force, by):
    matrix = tensor((math.cos(by), -math.sin(by)), (math.sin(by), math.cos(by)))
    return force @ matrix.T


def pointing(phi, dtype=torch.float64):
    return torch.tensor((math.cos(phi), math.sin(phi)), dtype=torch.float64).to(dtype)


# lookahead, section 3.3


def test_lookahead_moves_each_body_with_its_own_velocity():
    state = tensor(1.0, 2.0, 0.5, -1.0, -3.0, 0.0, 0.0, 4.0)
    assert_close(lookahead_state(state, 0.2), tensor(1.1, 1.8, 0.5, -1.0, -3.0, 0.8, 0.0, 4.0))


def test_lookahead_of_no_time_is_the_state_and_its_argument_is_left_alone():
    state = torch.randn(3, 5, 12)
    before = state.clone()
    lookahead_state(state, 1.0)
    assert torch.equal(state, before) and torch.equal(lookahead_state(state, 0.0), state)


@given(st.floats(0, 10), st.floats(0, 10))
def test_lookahead_twice_is_lookahead_once(first, second):
    state = torch.linspace(-2, 2, 24, dtype=torch.float64).view(2, 12)
    assert_close(lookahead_state(lookahead_state(state, first), second), lookahead_state(state, first + second))


# Eq. 4


def test_spring_force_by_hand():
    # 0.03 m right and 0.04 m below the target at 50 N/m: 1.5 N to the left, 2 N up, 2.5 N in all.
    force = spring_force(tensor(0.03, -0.04), tensor(0.0, 0.0), stiffness=50, limit=10)
    assert_close(force, tensor(-1.5, 2.0))


def test_spring_force_is_clipped_by_its_norm_not_by_its_axes():
    # (-1.5, 2) N to the norm of 1 N; clipping each axis would give (-1, 1), another direction.
    force = spring_force(tensor(0.03, -0.04), tensor(0.0, 0.0), stiffness=50, limit=1)
    assert_close(force, tensor(-0.6, 0.8))


def test_spring_force_on_the_target_is_zero():
    assert torch.equal(spring_force(tensor(0.1, 0.2), tensor(0.1, 0.2), 50, 5), tensor(0.0, 0.0))


@given(vector, vector, positive, positive)
def test_spring_force_never_exceeds_its_limit_and_points_at_the_target(position, target, stiffness, limit):
    position, target = tensor(*position), tensor(*target)
    force = spring_force(position, target, stiffness, limit)
    wanted = stiffness * (target - position)
    assert force.norm() <= limit * (1 + 1e-12)
    assert_close(force.norm(), wanted.norm().clamp(max=limit))
    assert_close(force * wanted.norm(), wanted * force.norm())  # the same direction, without a division by zero


@given(vector, vector, angle)
def test_spring_force_turns_with_the_world(position, target, by):
    position, target = tensor(*position), tensor(*target)
    force = spring_force(rotated(position, by), rotated(target, by), 100.0, 4.0)
    # Near the target a rounding of the positions is a rounding of the force, times the stiffness.
    assert_close(force, rotated(spring_force(position, target, 100.0, 4.0), by), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [1e-30, 1e30, 3e38])
def test_spring_force_of_extreme_stretches_in_float32(size):
    target = tensor(size, 0.0, dtype=torch.float32)
    force = spring_force(torch.zeros(2), target, stiffness=100, limit=5)
    assert_close(force, tensor(min(100 * size, 5.0), 0.0, dtype=torch.float32), atol=0, rtol=1e-6)


def test_spring_force_in_batches_equals_one_by_one():
    position, target = torch.randn(3, 1, 2), torch.randn(4, 2)
    force = spring_force(position, target, 10, 5)
    assert force.shape == (3, 4, 2)
    assert_close(force[2, 3], spring_force(position[2, 0], target[3], 10, 5))


# Eq. 5


@pytest.mark.parametrize(
    ("squared_norm", "weight"),
    [(0.0, 1.0), (0.05, 1.0), (0.1, 1.0), (0.15, 0.75), (0.2, 0.5), (0.3, 0.0), (0.31, 0.0), (2.0, 0.0)],
)
def test_uncertainty_weight_by_hand(squared_norm, weight):
    # T_low = 0.1, T_high = 0.3; the STD shared 9 : 16 by the axes, as in (0.6, 0.8) of its norm.
    std = math.sqrt(squared_norm) * tensor(0.6, 0.8)
    assert_close(uncertainty_weight(std, low=0.1, high=0.3), torch.tensor(weight, dtype=torch.float64))


def test_uncertainty_weight_takes_the_squared_norm():
    # sigma = (0.5, 0.5): squared norm 0.5, a quarter of the way from 0.25 to 1.25; its norm of 0.707 would give 0.54.
    assert uncertainty_weight(tensor(0.5, 0.5), 0.25, 1.25).item() == 0.75


@given(vector, vector, positive, positive)
def test_uncertainty_weight_is_within_0_and_1_and_never_rises(first, second, low, width):
    smaller, larger = sorted((tensor(*first), tensor(*second)), key=lambda std: std.square().sum())
    confident, doubtful = uncertainty_weight(torch.stack((smaller, larger)), low, low + width)
    assert 0 <= doubtful <= confident <= 1


# Eq. 6


def test_combine_by_hand():
    assert_close(combine(tensor(2.0, -1.0), tensor(0.0, 4.0)), tensor(1.0, 1.5))


@given(vector, vector)
def test_combine_is_symmetric_and_between(first, second):
    first, second = tensor(*first), tensor(*second)
    assert torch.equal(combine(first, second), combine(second, first))
    assert torch.equal(combine(first, first), first)
    assert_close(combine(first, second) - first, second - combine(first, second))


# Eq. 7


@pytest.mark.parametrize(("degrees", "weight"), [(0, 1.0), (60, 0.75), (90, 0.5), (120, 0.25), (180, 0.0)])
def test_similarity_weight_by_hand(degrees, weight):
    first, second = 3.0 * pointing(0.3), 0.2 * pointing(0.3 + math.radians(degrees))
    assert_close(similarity_weight(first, second), torch.tensor(weight, dtype=torch.float64))


def test_similarity_weight_of_a_zero_force_is_a_half():
    zero, force = tensor(0.0, 0.0), tensor(1.0, 2.0)
    assert similarity_weight(zero, force) == similarity_weight(force, zero) == similarity_weight(zero, zero) == 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(angle, angle, exponent, exponent)
def test_similarity_weight_sees_angles_only(dtype, first, second, first_exponent, second_exponent):
    weight = similarity_weight(
        pointing(first, dtype) * 10**first_exponent, pointing(second, dtype) * 10**second_exponent
    )
    assert weight.dtype == dtype and 0 <= weight <= 1
    assert weight.item() == pytest.approx(math.cos((first - second) / 2) ** 2, abs=10 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [5e-324, 1e-45, 1e-30, 1.0, 1e30, 3e38])
def test_similarity_weight_is_exact_along_a_line_at_any_size(dtype, size):
    force = torch.tensor((size, 0.0), dtype=dtype)
    same = 1.0 if force.any() else 0.5  # the smallest of these is zero in float32
    assert similarity_weight(force, force) == same
    assert similarity_weight(force, -force) == 1 - same


def test_similarity_weight_never_leaves_0_to_1_by_rounding():
    force = torch.randn(100_000, 2, generator=torch.Generator().manual_seed(0))
    for second in (force, -force, 3 * force):
        weight = similarity_weight(force, second)
        assert weight.min() >= 0 and weight.max() <= 1


@given(vector, vector, angle)
def test_similarity_weight_is_symmetric_and_turns_with_the_world(first, second, by):
    first, second = tensor(*first), tensor(*second)
    weight = similarity_weight(first, second)
    assert torch.equal(weight, similarity_weight(second, first))
    assert_close(weight, similarity_weight(rotated(first, by), rotated(second, by)))


@given(st.lists(st.floats(0, math.pi), min_size=2, max_size=2, unique=True))
def test_similarity_weight_falls_with_the_angle(angles):
    narrow, wide = (similarity_weight(pointing(0), pointing(phi)) for phi in sorted(angles))
    assert narrow >= wide - 1e-15


@given(vector, vector)
def test_similarity_weight_shrinks_the_combination(first, second):
    first, second = tensor(*first), tensor(*second)
    combined = combine(first, second)
    assert (similarity_weight(first, second)[..., None] * combined).norm() <= combined.norm()


def test_weights_have_the_shape_of_the_batch():
    force = torch.randn(7, 3, 2)
    assert similarity_weight(force, force[0]).shape == uncertainty_weight(force, 0.1, 1).shape == (7, 3)


def test_nan_is_passed_on():
    bad, good = tensor(math.nan, 1.0), tensor(1.0, 1.0)
    assert spring_force(bad, good, 1, 1).isnan().any()
    assert similarity_weight(bad, good).isnan() and uncertainty_weight(bad, 0.1, 1).isnan()


# what is refused

pair, integers, triple = torch.ones(2), torch.ones(2, dtype=torch.int64), torch.ones(3)


@pytest.mark.parametrize(
    ("field", "call"),
    [
        ("state", lambda: lookahead_state(torch.ones(10), 0.1)),
        ("state", lambda: lookahead_state(torch.ones(0), 0.1)),
        ("state", lambda: lookahead_state(torch.tensor(1.0), 0.1)),
        ("state", lambda: lookahead_state(torch.ones(12, dtype=torch.int64), 0.1)),
        ("seconds", lambda: lookahead_state(torch.ones(12), -0.1)),
        ("seconds", lambda: lookahead_state(torch.ones(12), math.nan)),
        ("position", lambda: spring_force(triple, pair, 1, 1)),
        ("target", lambda: spring_force(pair, integers, 1, 1)),
        ("stiffness", lambda: spring_force(pair, pair, -1, 1)),
        ("stiffness", lambda: spring_force(pair, pair, math.inf, 1)),
        ("limit", lambda: spring_force(pair, pair, 1, -1)),
        ("limit", lambda: spring_force(pair, pair, 1, math.nan)),
        ("std", lambda: uncertainty_weight(triple, 0.1, 0.2)),
        ("low, high", lambda: uncertainty_weight(pair, 0.0, 0.2)),
        ("low, high", lambda: uncertainty_weight(pair, 0.2, 0.2)),
        ("low, high", lambda: uncertainty_weight(pair, 0.1, math.inf)),
        ("optimal", lambda: combine(triple, pair)),
        ("user", lambda: combine(pair, integers)),
        ("first", lambda: similarity_weight(torch.tensor(1.0), pair)),
        ("second", lambda: similarity_weight(pair, triple)),
    ],
)
def test_bad_input_is_refused_by_name(field, call):
    with pytest.raises(ValueError, match=f"^{field}: .*must"):
        call()
