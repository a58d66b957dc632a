"""Simulated people: delays, blindness, the arm's mechanics, determinism, and the population."""

import inspect
import re

import numpy as np
import pytest
import yaml

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.puck_path import shot_direction
from airhockey_marl.envs.world import World
from guidance.simulated_users import Population, SimulatedUsers, personal_streams, sample_people, training_people
from guidance.simulated_users.arm import (
    ARM_STATE,
    HAND_REACH,
    NO_NOISE,
    SUBSTEPS,
    begin_plan,
    move_arm,
    peak_acceleration,
    reset_arm,
)
from guidance.simulated_users.intention import Intention, sample_softmax
from guidance.simulated_users.perception import LOOK_AHEAD, LOOK_AHEAD_STEP, predict_puck, standard_normal
from guidance.simulated_users.population import TRAITS, LogNormal
from guidance.simulated_users.population.parameters import POSITIVE, PROPORTIONS, SIGNED
from guidance.simulated_users.state import USER_STATE
from guidance.simulated_users.strokes import to_hand, to_table
from tests import ROOT

TABLE = TableSpec()
CONF = yaml.safe_load((ROOT / "conf/users/default.yaml").read_text())


def still(n: int, puck: tuple[float, ...] = (0.5, 0.1, 0.0, 0.0)) -> np.ndarray:
    """(n, 12) both paddles at home, and the puck."""
    state = np.zeros((n, 12))
    state[:, 0], state[:, 4], state[:, 8:] = -TABLE.length / 4, TABLE.length / 4, puck
    return state


def mirror_match(n: int, ticks: int, variant: str = "comply_or_resist", force: float = 0.0, seed: int = 3):
    """Two batches play each other; a constant force in newtons along y acts on the left one."""
    tables = World(n)
    tables.seed(seed)
    tables.new_rounds()
    seats = [
        SimulatedUsers(sample_people(n, seed + seat), personal_streams(n, seed + seat), TABLE, variant)
        for seat in (0, 1)
    ]
    seen, actions, pushes = np.zeros((n, 12)), np.zeros((n, 2, 2)), [np.zeros((n, 2)), np.zeros((n, 2))]
    pushes[LEFT][:, 1] = force
    record = {name: [] for name in ("action", "speed", "goals", "touched", "served")}
    for _ in range(ticks):
        for seat in (LEFT, RIGHT):
            actions[:, seat] = seats[seat].step(tables.observe(seat, seen), pushes[seat])
        tables.step(actions)
        over = tables.goals != 0
        record["action"].append(actions.copy())
        record["speed"].append(np.hypot(*seats[LEFT].hand_velocity.T))
        record["goals"].append(tables.goals.copy())
        record["touched"].append(tables.touched.copy())
        record["served"].append(tables.served.copy())
        tables.new_rounds(over)
        for users in seats:
            users.new_round(over)
    return seats[LEFT], {name: np.array(values) for name, values in record.items()}


def test_without_a_force_every_variant_is_no_guidance_bit_for_bit():
    users, passive = mirror_match(6, 1500, "passive")
    for variant in ("comply_or_resist", "goal_sharing"):
        again, record = mirror_match(6, 1500, variant)
        assert np.array_equal(record["action"], passive["action"])
        assert np.all(again.signals == 0)
    assert np.all(users.signals == 0)
    _, pushed = mirror_match(6, 1500, "comply_or_resist", force=1.0)
    assert not np.array_equal(pushed["action"], passive["action"])


def test_two_runs_are_the_same_and_another_seed_is_not():
    first, second, other = (mirror_match(4, 500, force=0.5, seed=seed)[1]["action"] for seed in (3, 3, 4))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_a_person_does_not_depend_on_the_batch():
    people, streams = sample_people(5, 8), personal_streams(5, 8)
    rng = np.random.default_rng(0)
    everyone, alone = (
        SimulatedUsers(people, streams, TABLE, "goal_sharing"),
        SimulatedUsers(people[3:4], streams[3:4], TABLE, "goal_sharing"),
    )
    for _ in range(300):
        state, force = still(5) + 0.02 * rng.standard_normal((5, 12)), rng.standard_normal((5, 2))
        together = everyone.step(state, force)[3].copy()
        assert np.array_equal(together, alone.step(state[3:4], force[3:4])[0])


def test_people_are_blind_to_all_but_state_and_force():
    assert list(inspect.signature(SimulatedUsers.step).parameters) == ["self", "state", "force", "rows"]
    users = SimulatedUsers(sample_people(2, 0), personal_streams(2, 0))
    with pytest.raises(ValueError, match="read-only"):
        users.action[0] = 0
    for name in ("hand", "hand_velocity", "goal", "intention", "time_to_contact"):
        getattr(users, name)[0] = 1  # a copy
        assert not (getattr(users, name)[0] == 1).any()


def test_the_hand_reacts_only_after_the_visual_delay():
    n, change = 40, 60
    people, streams = sample_people(n, 1), personal_streams(n, 1)
    same, other = SimulatedUsers(people, streams), SimulatedUsers(people, streams)
    zero = np.zeros((n, 2))
    first = np.full(n, -1)
    for tick in range(change + 60):
        shot = (-0.3 + 0.02 * (tick - change) * -0.5, 0.2, -0.5, 0.0) if tick >= change else (0.5, 0.1, 0.0, 0.0)
        differs = np.any(same.step(still(n), zero) != other.step(still(n, shot), zero), axis=1)
        first[(first < 0) & differs] = tick - change
    delay = np.floor(people["visual_delay"] / TABLE.tick + 0.5)
    assert np.all(first >= delay)
    reaction = (first + 1) * TABLE.tick  # the hand has moved by the end of that tick
    assert 0.15 < np.median(reaction) < 0.40


def test_the_arm_yields_to_a_force_by_its_stiffness():
    person, arm = sample_people(1, 2)[0], np.zeros(1, ARM_STATE)[0]
    for stiffness in (person["stiffness"], 2 * person["stiffness"]):
        reset_arm(arm, person)
        for _ in range(2000):
            move_arm(arm, person, NO_NOISE, stiffness, 0.0, 0.0, 1.0, -2.0, 0.004)
        assert arm["hand_x"] == pytest.approx(1.0 / stiffness, rel=1e-3)
        assert arm["hand_y"] == pytest.approx(-2.0 / stiffness, rel=1e-3)


def test_the_arm_follows_a_reach_with_one_peak_of_speed():
    person, arm = sample_people(1, 2)[0], np.zeros(1, ARM_STATE)[0]
    reset_arm(arm, person)
    begin_plan(arm, person, 0.06, -0.03, 0.0, 0.0, 0.4)
    speed = []
    for _ in range(250):
        move_arm(arm, person, NO_NOISE, person["stiffness"], 0.0, 0.0, 0.0, 0.0, 0.004)
        speed.append(np.hypot(arm["hand_v_x"], arm["hand_v_y"]))
    assert (arm["hand_x"], arm["hand_y"]) == pytest.approx((0.06, -0.03), abs=1e-3)
    assert max(speed) == pytest.approx(1.5 * np.hypot(0.06, 0.03) / (0.4 - person["muscle_lag"]), rel=0.2)
    reach = np.array(speed)[: int(0.4 / 0.004)]
    peaks = (reach[1:-1] > reach[:-2]) & (reach[1:-1] >= reach[2:]) & (reach[1:-1] > 0.1 * reach.max())
    assert peaks.sum() == 1


def test_displacement_by_a_force_is_about_force_over_stiffness():
    n = 30
    people, streams = sample_people(n, 4), personal_streams(n, 4)
    passive, free = (SimulatedUsers(people, streams, TABLE, "passive", adaptation=False) for _ in range(2))
    force = np.tile([0.0, 1.5], (n, 1))
    off = []
    for tick in range(500):
        passive.step(still(n), force)
        free.step(still(n), 0 * force)
        if tick >= 250:
            off.append((passive.hand - free.hand)[:, 1])
    yielding = np.mean(off, axis=0) / (1.5 / people["stiffness"])
    # Plans begin where the hand is and end at the goal, so a person differs from the arm alone either way.
    assert np.all((yielding > 0.1) & (yielding < 2.5))
    assert 0.6 < np.median(yielding) < 1.6


@pytest.mark.parametrize("variant", ["passive", "comply_or_resist", "goal_sharing"])
def test_a_spring_does_not_shake_the_hand(variant):
    n = 60
    people, streams = sample_people(n, 5), personal_streams(n, 5)
    held, free = SimulatedUsers(people, streams, TABLE, variant), SimulatedUsers(people, streams, TABLE, variant)
    place, zero = np.tile([0.02, 0.03], (n, 1)), np.zeros((n, 2))
    speeds = []
    for tick in range(750):
        held.step(still(n), 50.0 * (place - held.hand))
        free.step(still(n), zero)
        if tick >= 500:
            speeds.append([np.hypot(*users.hand_velocity.T) for users in (held, free)])
    # People move between their intentions without a spring, too; a limit cycle would add to that.
    with_spring, without = np.sqrt(np.mean(np.square(speeds), axis=0))
    assert np.percentile(with_spring - without, 95) < 0.05


def test_only_comply_or_resist_stiffens_and_resists_conflict():
    n = 20
    people, streams = sample_people(n, 6), personal_streams(n, 6)
    off = {}
    for variant in ("passive", "comply_or_resist"):
        users, free = SimulatedUsers(people, streams, TABLE, variant), SimulatedUsers(people, streams, TABLE, variant)
        for _ in range(400):
            users.step(still(n), np.tile([0.0, 2.0], (n, 1)))
            free.step(still(n), np.zeros((n, 2)))
        off[variant] = (users.hand - free.hand)[:, 1]
    assert np.mean(off["comply_or_resist"]) < 0.9 * np.mean(off["passive"])


def test_two_people_play_air_hockey():
    _, record = mirror_match(24, 6000)
    minutes = 24 * 6000 * TABLE.tick / 60
    goals = np.count_nonzero(record["goals"]) / minutes
    assert 1.5 < goals < 6.0  # rounds of 10 to 40 s
    assert np.count_nonzero(record["touched"]) / minutes > 30
    assert np.count_nonzero(record["served"]) / minutes < 0.5
    assert np.percentile(record["speed"], 99.9) < 1.5
    assert np.percentile(record["speed"], 50) > 0.02


def test_more_skill_wins():
    wins = np.zeros(2)
    good = sample_people(24, 1, Population.default(skill_mean=1.5, skill_sd=0.1))
    poor = sample_people(24, 2, Population.default(skill_mean=-1.5, skill_sd=0.1))
    for left, right, good_scores in ((good, poor, 1), (poor, good, -1)):
        opponent = SimulatedUsers(right, personal_streams(24, 10))
        tables, left_users = World(24), SimulatedUsers(left, personal_streams(24, 9))
        tables.new_rounds()
        seen, actions, zero = np.zeros((24, 12)), np.zeros((24, 2, 2)), np.zeros((24, 2))
        for _ in range(6000):
            actions[:, LEFT] = left_users.step(tables.observe(LEFT, seen), zero)
            actions[:, RIGHT] = opponent.step(tables.observe(RIGHT, seen), zero)
            tables.step(actions)
            over = tables.goals != 0
            wins += np.sum(tables.goals == good_scores), np.sum(tables.goals == -good_scores)
            tables.new_rounds(over)
            left_users.new_round(over)
            opponent.new_round(over)
    assert wins[0] > 1.3 * wins[1]


def test_a_new_round_centers_the_hand_and_keeps_the_ratings():
    n = 4
    users = SimulatedUsers(sample_people(n, 7), personal_streams(n, 7), TABLE, "goal_sharing")
    for _ in range(150):
        users.step(still(n), np.ones((n, 2)))
    which = np.array([True, False, True, False])
    before, signals = users.hand.copy(), users.signals.copy()
    users.new_round(which)
    assert np.all(users.hand[which] == 0) and np.all(users.action[which] == 0)
    assert np.array_equal(users.hand[~which], before[~which])
    assert np.array_equal(users.signals, signals)
    users.new_game(which)
    assert np.all(users.signals[which] == 0) and np.all(users.signals[~which] == signals[~which])


def test_an_anticipated_bounce_follows_the_physics():
    person, state, path = sample_people(1, 0)[0], np.zeros(1, USER_STATE)[0], np.empty((LOOK_AHEAD, 4))
    person["speed_noise"] = person["heading_noise"] = 0.0
    state["anticipates_bounces"] = 1
    start = np.array([0.6, 0.1, -0.9, 0.9])
    assert predict_puck(person, state, still(1, tuple(start))[0], 0.0, TABLE, path) == -1
    tables = World(1)
    tables.bodies[0, LEFT], tables.bodies[0, RIGHT] = (-0.9, -0.4, 0, 0), (0.9, -0.4, 0, 0)
    tables.bodies[0, 2] = start
    actions = np.array([[[-1.0, -0.9], [-1.0, 0.9]]])
    for _ in range(40):
        tables.step(actions)
    row = round(40 * TABLE.tick / LOOK_AHEAD_STEP)
    assert path[row] == pytest.approx(tables.bodies[0, 2], abs=0.02)
    state["anticipates_bounces"] = 0
    predict_puck(person, state, still(1, tuple(start))[0], 0.0, TABLE, path)
    assert path[-1, 1] == pytest.approx(TABLE.width / 2 - TABLE.puck_radius)


@pytest.mark.parametrize("wall", [0, 1, -1])
def test_a_shot_off_the_wall_ends_in_the_goal(wall):
    x, y, aim = -0.3, 0.12, 0.05
    tables = World(1)
    tables.bodies[0, LEFT], tables.bodies[0, RIGHT] = (-0.9, 0.0, 0, 0), (0.2, -0.4 if wall >= 0 else 0.4, 0, 0)
    tables.bodies[0, 2] = (x, y, *(2.0 * np.array(shot_direction(x, y, wall, aim, TABLE))))
    home = np.array([[[-1.0, 0.0], [0.5, 0.85 if wall >= 0 else -0.85]]])
    for _ in range(100):
        tables.step(home)
        if tables.goals[0]:
            break
    assert tables.goals[0] == 1
    assert tables.bodies[0, 2, 1] == pytest.approx(aim, abs=0.03)


def test_hand_and_table_coordinates_are_inverse():
    assert to_hand(-TABLE.length / 4, 0.0, TABLE) == (0.0, 0.0)
    corner = to_hand(-TABLE.paddle_radius, TABLE.width / 2 - TABLE.paddle_radius, TABLE)
    assert corner == pytest.approx((HAND_REACH, HAND_REACH))
    assert to_table(*to_hand(-0.2, 0.3, TABLE), TABLE) == pytest.approx((-0.2, 0.3))


def test_the_peak_acceleration_of_a_reach_is_at_its_ends():
    assert peak_acceleration(0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3) == pytest.approx(6 * 0.1 / 0.3**2)


def test_choices_follow_the_softmax():
    worth, rng = np.array([0.0, 0.2, -1e9]), personal_streams(1, 5)
    drawn = np.bincount([sample_softmax(worth, 0.2, rng, 0) for _ in range(20000)], minlength=3)
    assert drawn[2] == 0
    assert drawn[1] / drawn[0] == pytest.approx(np.e, rel=0.06)


def test_normals_are_normal():
    rng = personal_streams(1, 6)
    draws = np.array([standard_normal(rng, 0) for _ in range(40000)])
    assert (draws.mean(), draws.std()) == pytest.approx((0.0, 1.0), abs=0.015)
    assert np.mean(draws**4) == pytest.approx(3.0, abs=0.15)


def test_the_population_has_the_specified_distributions():
    people, population = sample_people(2000, 11), Population.default()
    degrees = ("heading_noise", "bounce_noise")
    for name, distribution in population.parameters.items():
        if not isinstance(distribution, LogNormal):
            continue
        values = np.degrees(people[name]) if name in degrees else people[name].copy()
        if name == "decision_delay":
            values -= population["response_delay"]
        assert np.median(values) == pytest.approx(distribution.median, rel=0.08), name
        assert distribution.low - 1e-12 <= values.min() and values.max() <= distribution.high + 1e-12, name
        correlation = np.corrcoef(np.log(values), people["skill"])[0, 1]
        assert correlation == pytest.approx(distribution.on_skill, abs=0.1), name
    both = np.corrcoef(np.log(people["noise_along"]), np.log(people["noise_across"]))[0, 1]
    assert both == pytest.approx(0.5, abs=0.07)
    assert np.mean(people["resistance"]) == pytest.approx(0.4, abs=0.02)
    assert np.mean(people["slacking"]) == pytest.approx(0.5 / 3, abs=0.02)
    assert np.mean(people["stiffening_gain"]) == pytest.approx(1.0, abs=0.06) and people["stiffening_gain"].max() <= 3.0
    for name in TRAITS:
        assert abs(np.corrcoef(people[name], people["skill"])[0, 1]) < 0.07


def test_nine_training_people_are_in_no_study():
    trainers, studied = training_people(0), sample_people(200, 0)
    assert len(trainers) == 9
    assert list(trainers["archetype"][:6]) == list(range(6))
    assert not np.intersect1d(trainers["stiffness"], studied["stiffness"]).size
    assert np.array_equal(sample_people(5, 0), studied[:5])
    assert not np.array_equal(training_people(1), trainers)
    flat = sample_people(50, 0, Population.default(trait_concentration=np.inf), archetype="wall")
    assert np.all(flat["aggression"] == Population.default()["archetypes"]["wall"][0])


def test_every_parameter_has_a_comment_and_a_source():
    text = (ROOT / "conf/users/default.yaml").read_text()
    for line in text[text.index("population:") : text.index("assumed:")].splitlines():
        match = re.match(r" {4}(\w+): *[^#\s]", line)
        if match:
            sourced = any(tag in line for tag in ("[R]", "[M]", "[D]", "[A]", "assumed")) or "skill" in match[1]
            assert "#" in line and sourced, line
    names = [name for section in CONF["population"].values() for name in section]
    assert len(set(names)) == len(names)  # over all sections
    assert set(names) >= POSITIVE | PROPORTIONS | SIGNED


def test_intentions_are_named_and_used():
    users, _ = mirror_match(20, 50)
    assert set(users.intention) <= set(map(int, Intention))
    assert SUBSTEPS == 5


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: sample_people(1, 0, archetype="goalie"), "archetype = 'goalie' must be one of striker"),
        (
            lambda: Population.default(visual_delay=(0.5, 0.1, 0.1, 0.2, 0.0)),
            "users.population.perception.visual_delay",
        ),
        (lambda: Population.default(resistance=(2.0, 1.0, 1.0)), "users.population.force_response.resistance"),
        (lambda: Population.default(device_mass=-1.0), "arm.device_mass = -1.0"),
        (lambda: Population.default(noise_correlation=1.5), "movement.noise_correlation = 1.5"),
        (lambda: Population.default(fast_retention=1.1), "adaptation.fast_retention = 1.1"),
        (lambda: Population.default(reference_speed=0.0), "adaptation.reference_speed = 0.0"),
        (lambda: Population.default(archetypes={"odd": (0.5, 0.5)}), "style.archetypes.odd"),
        (lambda: SimulatedUsers(np.zeros(3), personal_streams(3, 0)), "people of shape"),
        (lambda: SimulatedUsers(sample_people(3, 0), personal_streams(2, 0)), "streams uint64"),
        (
            lambda: SimulatedUsers(sample_people(1, 0), personal_streams(1, 0), variant="V9"),
            "variant = 'V9' must be one of passive",
        ),
        (lambda: _one().step(np.zeros((1, 11)), np.zeros((1, 2))), "state of shape"),
        (lambda: _one().step(np.zeros((1, 12)), np.full((1, 2), np.nan)), "force = nan must be finite"),
        (lambda: _one().new_round(np.ones(1)), "mask float64"),
        (lambda: _one().ratings({"conflict": 1.0}), "scales = "),
        (lambda: _one().ratings({**CONF["scales"], "jerk": 0.0}), "scales.jerk = 0.0"),
    ],
)
def test_bad_input_is_named(build, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        build()


def _one() -> SimulatedUsers:
    return SimulatedUsers(sample_people(1, 0), personal_streams(1, 0))
