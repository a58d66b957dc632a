"""The rating proxies: signals, bounds, and the order of the anchor forces that they must reproduce."""

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st

from airhockey_marl.envs.physics import LEFT, TableSpec
from airhockey_marl.envs.world import World
from guidance.forces.conditions import Spring
from guidance.simulated_users import SimulatedUsers, load_advisors, personal_streams, sample_people, training_people
from guidance.simulated_users.arm import ARM_STATE
from guidance.simulated_users.force_response import Variant
from guidance.simulated_users.ratings import (
    LEAST_POINTS,
    MOST_POINTS,
    RATING_SIGNALS,
    RATINGS,
    SIGNALS,
    SIGNED,
    WEIGHTS,
    add_rating_signals,
    expected_points,
    likert_points,
    meeting,
    signals,
)
from guidance.simulated_users.state import USER_STATE
from guidance.simulated_users.strokes import to_hand
from guidance.simulated_users.validation.rating_anchors import (
    ANCHORS,
    UNIT_ANCHORS,
    AnchorForces,
    anchor_results,
    anchor_signals,
    failures,
    oracle_force,
    signal_units,
)
from tests import ROOT

TABLE = TableSpec()
CONF = yaml.safe_load((ROOT / "conf/users/default.yaml").read_text())
SCALES = CONF["scales"]
with initialize_config_dir(str(ROOT / "conf"), version_base=None):
    GUIDANCE = Spring(**compose("validate_users").guidance.spring)
TOUCHING = TABLE.puck_radius + TABLE.paddle_radius
SIZES = st.lists(st.floats(0.0, 1e6), min_size=len(SIGNALS), max_size=len(SIGNALS))


def arms_at(*places: tuple[float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Arms (n,) whose paddles are at these places of the table, in m."""
    arms = np.zeros(len(places), ARM_STATE)
    for arm, place in zip(arms, places, strict=True):
        arm["hand_x"], arm["hand_y"] = to_hand(*place, TABLE)
        arm["hand_v_x"], arm["hand_v_y"] = velocity
    return arms


def signals_of(arm, shadow, puck, force=(0.0, 0.0), last=(0.0, 0.0), goal=(0.0, 0.0), ticks: int = 1) -> dict:
    """The signals after `ticks` equal ticks."""
    sums, state = np.zeros(1, RATING_SIGNALS), np.zeros(1, USER_STATE)
    state["goal_x"], state["goal_y"] = goal
    observation = np.concatenate([np.zeros(8), puck])
    person, forces = sample_people(1, 0)[0], (np.array(force), np.array(last))
    for _ in range(ticks):
        add_rating_signals(sums[0], person, state[0], arm, shadow, *forces, observation, TABLE)
    return dict(zip(SIGNALS, signals(sums)[0], strict=True)) | {"encounters": sums["encounters"][0]}


def coming(gap: float, y: float = 0.0) -> np.ndarray:
    """A puck that comes straight at 1 m/s, `gap` meters before it touches a paddle at (-0.7, 0)."""
    return np.array([-0.7 + TOUCHING + gap, y, -1.0, 0.0])


def test_no_force_is_no_signal_and_a_neutral_rating():
    users = SimulatedUsers(sample_people(6, 1), personal_streams(6, 1))
    tables = World(6)
    tables.new_rounds()
    actions, seen, force = np.zeros((6, 2, 2)), np.zeros((6, 12)), np.zeros((6, 2))
    for _ in range(1000):
        actions[:, LEFT] = users.step(tables.observe(LEFT, seen), force)
        tables.step(actions)
        tables.new_rounds(tables.goals != 0)
        users.new_round(tables.goals != 0)
    assert users._arrays.sums["encounters"].min() > 0
    assert np.all(users.signals == 0)
    neutral = dict(zip(RATINGS, expected_points(users.signals, SCALES)[0], strict=True))
    assert neutral == pytest.approx(
        {"helpfulness": 4.0, "naturalness": 6.0, "controllability": 2 + 4 * 1.5 / 1.75, "comfort": 5.0}
    )


@given(SIZES, st.sampled_from([-1.0, 1.0]))
def test_points_are_within_bounds_for_every_force(sizes, sign):
    values = np.array(sizes)
    values[SIGNALS.index(SIGNED)] *= sign
    points = expected_points(values, SCALES)
    assert np.all((points >= LEAST_POINTS - 1e-9) & (points <= MOST_POINTS + 1e-9))


@pytest.mark.parametrize("extreme", [LEAST_POINTS, MOST_POINTS])
def test_no_mean_rating_is_within_half_a_point_of_an_end(extreme):
    people = sample_people(2000, 5)
    for points in likert_points(people, np.full((2000, 4), extreme), personal_streams(2000, 5)).values():
        assert 1.5 < points.mean() < 6.5


@given(SIZES, st.sampled_from(SIGNALS), st.floats(0.01, 3.0))
def test_a_rating_follows_the_sign_of_each_weight(sizes, name, share):
    values = np.minimum(np.array(sizes), 3.0) * np.array([SCALES[signal] for signal in SIGNALS])
    more = values.copy()
    more[SIGNALS.index(name)] += share * SCALES[name]
    change = expected_points(more, SCALES) - expected_points(values, SCALES)
    for rating, difference in zip(RATINGS, change, strict=True):
        assert np.sign(difference) == np.sign(WEIGHTS[rating].get(name, 0.0))


def test_a_force_into_the_way_of_the_puck_helps_and_one_out_of_it_does_not():
    there, off = arms_at((-0.7, 0.0), (-0.7, 0.06))
    beside = arms_at((-0.7, 0.2))[0]
    puck = coming(0.01)
    assert signals_of(there, off, puck)["outcome"] > 0.2  # a blow in the middle instead of a graze
    assert signals_of(there, beside, puck)["outcome"] > 0.9
    assert signals_of(off, there, puck)["outcome"] == -signals_of(there, off, puck)["outcome"]
    assert signals_of(there, there, puck)["outcome"] == 0
    for arm, shadow, other in ((there, off, coming(0.2)), (beside, beside, puck), (there, off, -puck)):
        assert signals_of(arm, shadow, other)["encounters"] == 0


def test_an_encounter_counts_once():
    there, off = arms_at((-0.7, 0.0), (-0.7, 0.06))
    period = sample_people(1, 0)[0]["plan_period"]
    assert signals_of(there, off, coming(0.01), ticks=int(period / TABLE.tick))["encounters"] == 1
    assert signals_of(there, off, coming(0.01), ticks=int(period / TABLE.tick) + 2)["encounters"] == 2


@given(st.floats(-0.07, 0.07), st.floats(-0.3, 0.3), st.floats(0.005, 0.05))
def test_a_meeting_is_when_the_physics_has_the_contact(y, hand_speed, gap):
    arm = arms_at((-0.7, 0.0), velocity=(hand_speed, 0.0))[0]
    gain = to_hand(1.0 - TABLE.length / 4, 0.0, TABLE)[0]
    paddle_speed = hand_speed / gain
    x = -0.7 - paddle_speed * abs(paddle_speed) / (2 * TABLE.paddle_acceleration)
    puck = np.array([x + np.sqrt(TOUCHING**2 - y**2) + gap, y, -2.5, 0.0])
    seconds, chance = meeting(arm, puck, TOUCHING, 10.0, TABLE)
    assert seconds == pytest.approx(gap / (2.5 + paddle_speed), rel=1e-6)
    assert chance == pytest.approx(np.exp(-((y / TOUCHING) ** 2)))


def test_the_force_is_split_by_the_own_goal():
    arm = arms_at((-TABLE.length / 4, 0.0))[0]
    far = np.array([0.5, 0.0, 0.0, 0.0])
    toward = signals_of(arm, arm, far, force=(2.0, 0.0), last=(2.0, 0.0), goal=(0.05, 0.0))
    against = signals_of(arm, arm, far, force=(-2.0, 0.0), last=(2.0, 0.0), goal=(0.05, 0.0))
    assert toward["force"] == against["force"] == 2.0 and toward["jerk"] == 0
    assert toward["support"] > 1.8 and toward["support"] + toward["unsupported"] == pytest.approx(2.0)
    assert against["support"] == 0 and against["unsupported"] == 2.0 and against["jerk"] == 4.0 / TABLE.tick


def test_anchor_forces_differ_in_one_thing_each():
    people = np.tile(training_people(0), 2 * len(ANCHORS))
    users = SimulatedUsers(people, np.tile(personal_streams(9, 2), 2 * len(ANCHORS)))
    forces, seen = AnchorForces(GUIDANCE, (0.5, 1.0), 9, seed=0), np.zeros((72, 12))
    seen[:, 8:] = 0.5, 0.1, -1.0, 0.0
    for _ in range(40):
        before = oracle_force(users, GUIDANCE).reshape(2, 4, 9, 2)
        force = forces(users).reshape(2, 4, 9, 2)
        oracle, replayed, random, anti = (force[:, anchor] for anchor in range(4))
        assert np.array_equal(oracle, np.array([0.5, 1.0])[:, None, None] * before[:, 0])
        assert np.array_equal(anti, -np.array([0.5, 1.0])[:, None, None] * before[:, 3])
        assert np.array_equal(replayed, np.roll(oracle, 1, axis=1))
        assert np.linalg.norm(random, axis=-1) == pytest.approx(np.linalg.norm(replayed, axis=-1))
        assert np.linalg.norm(force, axis=-1).max() <= GUIDANCE.limit + 1e-9
        users.step(seen, force.reshape(-1, 2))
    assert np.linalg.norm(force, axis=-1).max() > 0
    with pytest.raises(ValueError, match="people = 1 must be at least 2"):
        AnchorForces(GUIDANCE, (1.0,), 1, seed=0)


def test_failures_name_each_violation():
    rng = np.random.default_rng(0)
    noise = 0.1 * rng.standard_normal((4, 4, 30))
    falling = 5.0 - np.arange(4.0)[:, None, None] * np.linspace(0.1, 0.4, 4)[None, :, None] + noise
    falling[0] -= 0.1 * np.arange(4)[:, None]
    assert failures(falling) == []
    assert failures(falling[:, [0, 2, 1, 3]])[0] == "random above replayed at grade 1"
    assert failures(falling[:, ::-1])[-1] == "oracle not above anti"
    assert "anti better at grade 3 than at 2" in failures(falling[[0, 2, 1, 3]])
    assert failures(falling[::-1])[-1] == "weakest anti not above the strongest"
    alike = 4.0 + noise[:, :1].repeat(4, axis=1)
    assert "oracle not above anti" in failures(alike)  # a proxy that says nothing


@pytest.fixture(scope="module")
def anchored() -> dict[str, np.ndarray]:
    """Signals under weak and strong anchor forces, short games."""
    people, spring = np.concatenate([training_people(seed) for seed in (0, 1)]), Spring(100.0, 6.0, 0.075)
    game = {"grades": (0.25, 1.0), "seconds": 20.0, "seed": 5}
    return {variant: anchor_signals(people, spring, variant=variant, **game) for variant in Variant.__members__}


def test_known_order(anchored):
    """Each proxy falls from oracle over replayed and random to anti, and with the strength of anti."""
    found = anchor_results(anchored, "comply_or_resist", (0.25, 1.0))
    for variant, ratings in found.failures.items():
        assert not any(ratings.values()), (variant, ratings)
    points = found.table[[*RATINGS]]
    assert points.min().min() > LEAST_POINTS + 0.1 and points.max().max() < MOST_POINTS - 0.1
    assert yaml.safe_load(found.as_yaml("passive")) == {"scales": found.units, "withdrawn": []}
    assert list(found.full_strength()["anchor"]) == 3 * list(ANCHORS) and len(found.table) == 24


def test_units_are_the_sizes_at_the_end_of_the_range(anchored):
    values = anchored["comply_or_resist"]
    units = signal_units(values)
    for column, name in enumerate(SIGNALS):
        mean = values[-1, ANCHORS.index(UNIT_ANCHORS[name]), :, column].mean()
        assert units[name] == pytest.approx(abs(mean)) and units[name] > 0
    with pytest.raises(ValueError, match=r"unit of outcome = -.* must be above 0, under the force anti"):
        signal_units(np.abs(values))


def test_ratings_are_likert_points_and_repeatable():
    users = SimulatedUsers(sample_people(40, 21), personal_streams(40, 21))
    seen = np.zeros((40, 12))
    seen[:, 8:] = 0.5, 0.1, -1.0, 0.0
    for _ in range(100):
        users.step(seen, -oracle_force(users, GUIDANCE))
    first, again = users.ratings(SCALES), users.ratings(SCALES)
    assert tuple(first) == RATINGS
    for name, points in first.items():
        assert points.shape == (40,) and points.dtype == np.float64
        assert np.all((points >= 1) & (points <= 7) & (points == np.round(points)))
        assert np.array_equal(points, again[name])
        assert len(set(points)) > 1


@pytest.mark.slow
def test_the_configuration_is_what_the_anchor_forces_say():
    """All proxies but the withdrawn ones pass under the primary response to force; scales are as recomputed."""
    advisors = load_advisors(ROOT / "guidance/pretrained/advisors.safetensors")
    people = np.concatenate([training_people(seed) for seed in range(4)])
    game = {"seconds": 120.0, "advisors": advisors}
    values = {variant: anchor_signals(people, GUIDANCE, variant=variant, **game) for variant in Variant.__members__}
    found = anchor_results(values, CONF["variant"])
    assert found.units == pytest.approx(SCALES, rel=0.25)
    assert found.withdrawn(CONF["variant"]) == CONF["withdrawn"]
    for signals_of_all in values.values():  # unlike support, which has this order by definition
        assert failures(signals_of_all[..., SIGNALS.index("outcome")]) == []
