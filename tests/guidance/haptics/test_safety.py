"""The safety layer: what holds in every step whatever is asked for, and each rule by itself."""

import math
import random
from dataclasses import asdict, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.registry import construct
from guidance.haptics.safety import Safety, SafetyLimits, clip_norm
from guidance.haptics.servo import TICK

STEP = 0.001
CENTER, STILL = (0.0, 0.0), (0.0, 0.0)
AT_ONCE = SafetyLimits(soft_start=0.0)  # no soft start
ROUNDING = 1e-12

odd = st.floats(allow_nan=True, allow_infinity=True)
anything = st.tuples(odd, odd)
usual = st.tuples(st.floats(-8, 8), st.floats(-8, 8))
within_reach = st.tuples(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08))


def ask(safety, force, age=0.0, position=CENTER, velocity=STILL, held=True, seconds=STEP):
    return safety.filter(force, age, position, velocity, held, seconds)


def run(safety, force, steps, **step):
    """The force after so many steps."""
    for _ in range(steps):
        out = ask(safety, force, **step)
    return out


def check(safety, before, after, seconds=STEP):
    """What holds in every step."""
    limits = safety.limits
    assert math.isfinite(after[0]) and math.isfinite(after[1])
    assert math.hypot(*after) <= limits.force
    if safety.fault is not None:
        assert after == (0.0, 0.0)
    else:
        change = math.hypot(after[0] - before[0], after[1] - before[1])
        assert change <= limits.slew * seconds * (1 + ROUNDING) + ROUNDING


# in every step

steps = st.tuples(
    anything | usual,
    st.one_of(odd, st.floats(0, 0.05)),
    anything | within_reach,
    anything | usual | st.just(STILL),
    st.booleans(),
    st.sampled_from(["", "", "", "release", "fail"]),
)
limits = st.builds(
    SafetyLimits,
    force=st.floats(1e-3, 50),
    slew=st.floats(0.1, 1e4),
    soft_start=st.floats(0, 1),
    stale_after=st.floats(1e-3, 1),
    workspace=st.floats(1e-3, 1),
    speed=st.floats(1e-2, 10),
)


@given(limits, st.lists(steps, max_size=40))
def test_the_force_is_bounded_for_any_request(limits, steps):
    safety, before = Safety(limits), (0.0, 0.0)
    for force, age, position, velocity, held, event in steps:
        if event == "release":
            safety.release()
        elif event == "fail":
            safety.fail("the cable is out")
        after = ask(safety, force, age, position, velocity, held)
        check(safety, before, after)
        before = after


def test_a_hundred_and_fifty_thousand_random_steps():
    rng, limits = random.Random(1), SafetyLimits()
    odd = (math.nan, math.inf, -math.inf, 1.8e308, -1.8e308, 1e300, 5e-324, -0.0)
    safety, before, force, is_held = Safety(limits), (0.0, 0.0), (0.0, 0.0), True
    counts = dict.fromkeys(("full", "fault", "released", "refused", "loose", "stale"), 0)
    for step in range(150_000):
        if step % 20 == 0:
            force = tuple(rng.choice(odd) if rng.random() < 0.1 else rng.uniform(-5, 5) for _ in range(2))
            is_held = rng.random() < 0.97
        age = rng.choice((math.nan, math.inf, 1.0)) if rng.random() < 0.02 else rng.uniform(0, 0.03)
        position, velocity = (rng.uniform(-0.07, 0.07), 0.07), (rng.uniform(-1, 1), rng.uniform(-1, 1))
        strange = rng.random()
        if strange < 0.0003:
            position = (rng.choice((*odd, 0.2)), 0.0)
        elif strange < 0.0006:
            velocity = (0.0, rng.choice((*odd, 3.0)))
        elif strange < 0.0008:
            safety.fail("the cable is out")
        if safety.fault is not None and rng.random() < 0.1:
            counts["released" if safety.release() else "refused"] += 1
        after = ask(safety, force, age, position, velocity, is_held)
        check(safety, before, after)
        counts["full"] += math.hypot(*after) > 0.999 * limits.force
        counts["fault"] += safety.fault is not None
        counts["loose"] += not is_held
        counts["stale"] += not age <= limits.stale_after
        before = after
    assert all(count > 10 for count in counts.values()), counts  # each was really tried


@given(anything, st.floats(0, 1e308))
def test_clip_norm_never_exceeds_by_a_rounding(vector, most):
    x, y = clip_norm(*vector, most)
    assert math.hypot(x, y) <= most
    if math.isfinite(vector[0]) and math.isfinite(vector[1]) and math.hypot(*vector) <= most:
        assert (x, y) == vector


@given(st.tuples(st.floats(-1.7e308, 1.7e308), st.floats(-1.7e308, 1.7e308)), st.floats(1e-3, 50))
def test_clip_norm_keeps_the_direction(vector, most):
    x, y = clip_norm(*vector, most)
    size = max(map(abs, vector)) or 1.0
    towards = vector[0] / size, vector[1] / size
    assert abs(towards[0] * y - towards[1] * x) <= 1e-12 * most and towards[0] * x + towards[1] * y >= 0
    assert math.hypot(x, y) == pytest.approx(min(math.hypot(*vector), most))


# the force


def test_a_force_within_the_limits_passes_to_the_last_bit():
    safety = Safety(AT_ONCE)
    assert run(safety, (1.1, -0.7), 50) == (1.1, -0.7)
    assert safety.fault is None


def test_the_norm_is_clipped_not_each_axis():
    # (3, 4) N to a norm of 3 N; clipping each axis would let (3, 3) through, 4.2 N in another direction
    assert run(Safety(AT_ONCE), (3.0, 4.0), 100) == pytest.approx((1.8, 2.4))
    # and (2.9, 2.9) N is within 3 N on each axis, but not by its norm
    assert math.hypot(*run(Safety(AT_ONCE), (2.9, 2.9), 100)) == pytest.approx(3.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_force_that_is_not_a_number_is_none(bad, axis):
    safety = Safety(AT_ONCE)
    assert math.hypot(*run(safety, (1.0, 1.0), 50)) > 1
    force = [1.0, 1.0]
    force[axis] = bad
    assert run(safety, tuple(force), 50) == (0.0, 0.0)
    assert run(safety, (1.0, 1.0), 50) == (1.0, 1.0)  # and it is forgotten


def test_a_huge_force_keeps_its_direction():
    assert run(Safety(AT_ONCE), (-1.7e308, 1.7e308), 50) == pytest.approx((-3 / math.sqrt(2), 3 / math.sqrt(2)))


def test_the_force_changes_no_faster_than_the_slew_and_straight():
    safety = Safety(SafetyLimits(soft_start=0.0, slew=100.0))
    run(safety, (3.0, 0.0), 100)
    trail = [ask(safety, (-1.8, 2.4)) for _ in range(100)]
    # 100 N/s: .1 N a step along the straight line from (3, 0) to (-1.8, 2.4), 5.367 N long: there at the 54th
    away = math.hypot(-4.8, 2.4)
    for step, force in enumerate(trail, 1):
        share = min(0.1 * step / away, 1.0)
        assert force == pytest.approx((3.0 - 4.8 * share, 2.4 * share))
    assert trail[52] != (-1.8, 2.4) and trail[53] == (-1.8, 2.4)


def test_the_slew_is_of_the_norm_not_of_each_axis():
    force = ask(Safety(SafetyLimits(soft_start=0.0, slew=100.0)), (2.0, 2.0))
    assert math.hypot(*force) == pytest.approx(0.1)


def test_a_force_that_creeps_along_the_limit_does_not_exceed_it_by_a_rounding():
    rng, safety = random.Random(0), Safety(SafetyLimits(soft_start=0.0, slew=1.0))
    for _ in range(1000):
        angle = rng.uniform(-math.pi, math.pi)
        ask(safety, (5 * math.cos(angle), 5 * math.sin(angle)), seconds=10.0)
        angle += rng.uniform(-1e-7, 1e-7)
        assert math.hypot(*ask(safety, (5 * math.cos(angle), 5 * math.sin(angle)), seconds=1e-9)) <= 3.0


def test_longer_steps_may_change_more():
    assert ask(Safety(SafetyLimits(soft_start=0.0, slew=100.0)), (2.0, 0.0), seconds=0.005) == pytest.approx((0.5, 0.0))


# starting softly


def test_the_force_rises_over_the_soft_start():
    safety = Safety(SafetyLimits(soft_start=0.5))
    trail = [ask(safety, (2.0, 0.0))[0] for _ in range(600)]
    for at in (0, 99, 249, 400):
        assert trail[at] == pytest.approx(2.0 * (at + 1) / 500)
    assert trail[498] < 2.0 and trail[500:] == [2.0] * 100


def test_waiting_for_the_first_force_is_no_soft_start():
    safety = Safety(SafetyLimits(soft_start=0.5))
    run(safety, (2.0, 0.0), 2000, age=math.inf)
    assert run(safety, (2.0, 0.0), 50) == pytest.approx((0.2, 0.0))


# stale


@pytest.mark.parametrize("age", [0.0401, 1.0, math.inf, math.nan])
def test_a_stale_force_ramps_down_at_the_slew(age):
    safety = Safety(AT_ONCE)
    assert run(safety, (3.0, 0.0), 50, age=0.04) == (3.0, 0.0)
    trail = [ask(safety, (3.0, 0.0), age=age)[0] for _ in range(25)]
    assert trail[:19] == pytest.approx([3.0 - 0.15 * step for step in range(1, 20)])
    assert trail[20:] == [0.0] * 5
    assert safety.fault is None


def test_a_fresh_force_returns_at_the_slew_without_a_soft_start():
    safety = Safety(SafetyLimits(soft_start=0.5))
    run(safety, (3.0, 0.0), 600)
    run(safety, (3.0, 0.0), 100, age=1.0)
    assert run(safety, (3.0, 0.0), 20) == pytest.approx((3.0, 0.0))


# held


def test_letting_go_ramps_down_and_a_new_grip_starts_softly():
    safety = Safety(SafetyLimits(soft_start=0.5))
    run(safety, (3.0, 0.0), 600)
    trail = [ask(safety, (3.0, 0.0), held=False)[0] for _ in range(25)]
    assert trail[:19] == pytest.approx([3.0 - 0.15 * step for step in range(1, 20)])
    assert trail[20:] == [0.0] * 5 and safety.fault is None
    assert run(safety, (3.0, 0.0), 50) == pytest.approx((0.3, 0.0))


def test_a_moment_without_a_grip_starts_softly_too():
    safety = Safety(SafetyLimits(soft_start=0.5))
    run(safety, (3.0, 0.0), 600)
    ask(safety, (3.0, 0.0), held=False)
    assert run(safety, (3.0, 0.0), 100)[0] == pytest.approx(0.6)


# faults

BAD_HANDS = {
    "further than 0.12 m": {"position": (0.09, 0.09)},
    "faster than 2.5 m/s": {"velocity": (2.0, -2.0)},
    "reports a hand at": {"position": (math.nan, 0.0)},
    "with a velocity of": {"velocity": (0.0, math.inf)},
    "a step took": {"seconds": math.nan},
}


@pytest.mark.parametrize(("words", "hand"), BAD_HANDS.items())
def test_a_bad_hand_is_a_fault_at_once_and_until_it_is_released(words, hand):
    safety = Safety(SafetyLimits(soft_start=0.5))
    assert run(safety, (3.0, 0.0), 600) == (3.0, 0.0)
    assert ask(safety, (3.0, 0.0), **hand) == (0.0, 0.0)
    assert words in safety.fault
    assert not safety.release() and words in safety.fault  # it is still so
    assert run(safety, (3.0, 0.0), 100) == (0.0, 0.0) and words in safety.fault  # it is not so, but nobody released it
    assert safety.release() and safety.fault is None
    assert run(safety, (3.0, 0.0), 100) == pytest.approx((0.6, 0.0))  # softly


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("name", ["position", "velocity"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_hand_that_is_not_a_number_is_a_fault(axis, name, bad):
    safety, hand = Safety(AT_ONCE), [0.0, 0.0]
    hand[axis] = bad
    assert ask(safety, (1.0, 0.0), **{name: tuple(hand)}) == (0.0, 0.0)
    assert safety.fault


def test_the_corner_of_the_reach_is_inside_and_quick_hands_are_slow_enough():
    safety = Safety(SafetyLimits())
    ask(safety, (1.0, 0.0), position=(0.075, -0.075), velocity=(1.2, 1.2))
    assert safety.fault is None


def test_a_device_that_fails_is_a_fault_until_a_step_in_which_it_does_not():
    safety = Safety(AT_ONCE)
    run(safety, (3.0, 0.0), 50)
    safety.fail("the device failed: no answer")
    assert safety.fault == "the device failed: no answer"
    assert not safety.release()
    assert ask(safety, (3.0, 0.0)) == (0.0, 0.0)
    assert safety.release()
    assert ask(safety, (3.0, 0.0)) == pytest.approx((0.15, 0.0))  # from nothing


def test_the_first_fault_is_reported():
    safety = Safety(AT_ONCE)
    ask(safety, (1.0, 0.0), position=(1.0, 0.0))
    ask(safety, (1.0, 0.0), velocity=(9.0, 0.0))
    assert "further" in safety.fault


def test_a_release_without_a_fault_changes_nothing():
    safety = Safety(SafetyLimits(soft_start=0.5))
    run(safety, (3.0, 0.0), 600)
    assert safety.release()
    assert ask(safety, (3.0, 0.0)) == (3.0, 0.0)


# the limits


@pytest.mark.parametrize("name", asdict(SafetyLimits()))
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, True, "3", None])
def test_bad_limits_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^safety\.{name} = .* must be a finite number"):
        SafetyLimits(**{name: value})


@pytest.mark.parametrize("name", sorted(set(asdict(SafetyLimits())) - {"soft_start"}))
def test_only_the_soft_start_may_be_nothing(name):
    assert SafetyLimits(soft_start=0).soft_start == 0
    with pytest.raises(ValueError, match=rf"^safety\.{name} = 0 must be a finite number above 0$"):
        SafetyLimits(**{name: 0})


def test_the_configuration_lets_the_force_of_the_study_through_and_every_key_is_explained():
    path, guidance = CONF / "safety" / "default.yaml", OmegaConf.load(CONF / "guidance" / "default.yaml")
    limits = construct(SafetyLimits, OmegaConf.load(path), "safety")
    assert limits.force == guidance.spring.limit and limits.slew * TICK == limits.force
    assert replace(limits, force=3.0, slew=150.0) == SafetyLimits()  # which are more cautious
    lines = path.read_text(encoding="utf-8").splitlines()
    keys = [index for index, line in enumerate(lines) if not line.startswith("#")]
    assert len(keys) == len(asdict(SafetyLimits())) and all(lines[index - 1].startswith("#") for index in keys)
