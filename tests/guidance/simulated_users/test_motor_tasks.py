"""Simulated people in motor tasks: within human ranges, and for the right reasons."""

import numpy as np
import pytest

from guidance.simulated_users import Population, sample_people
from guidance.simulated_users.intention import Intention
from guidance.simulated_users.population import LogNormal
from guidance.simulated_users.validation.measures import MEASURES, as_table, in_the_laboratory
from guidance.simulated_users.validation.motor_tasks import (
    TARGET_TICK,
    jumping_targets,
    mechanics,
    onset,
    push_response,
    reaches,
    reaction_times,
    resting_targets,
    run_trials,
)


@pytest.fixture(scope="module")
def people() -> np.ndarray:
    return sample_people(24, 77)


def test_the_default_population_is_within_the_human_ranges(people):
    table = as_table(in_the_laboratory(people, "comply_or_resist", 0)[0]).set_index("measure")
    assert len(table) == 17
    for name, row in table.iterrows():
        low, high = MEASURES[name][1]
        assert low <= row["mean"] <= high, f"{name}: {row['mean']:.3g}"
    assert set(table["within"]) == {"yes"}


def test_a_reaction_time_is_the_sum_of_its_delays(people):
    slow = people.copy()
    slow["visual_delay"] += 0.06
    slow["response_delay"] += 0.04
    later = reaction_times(slow, trials=10) - reaction_times(people, trials=10)
    assert later.mean() == pytest.approx(0.10, abs=0.015)


def test_identified_stiffness_follows_the_parameter(people):
    """A third of the stiffness is identified as less; replanning adds to both."""
    soft = people.copy()
    soft["stiffness"] /= 3
    hard, yielding = (mechanics(group, trials=2, variant="passive")[:, 2] for group in (people, soft))
    assert np.all(yielding < hard)
    assert hard.mean() - yielding.mean() > 40


def test_without_noise_reaches_repeat(people):
    steady = people[:3].copy()
    for name in ("noise_along", "noise_across", "tremor", "timing_noise", "delay_noise"):
        steady[name] = 0.0
    targets = jumping_targets(np.full((3, 5, 1, 2), 0.03), np.full((3, 5, 1), TARGET_TICK), 100)
    hand = run_trials(steady, Intention.REACH, targets).hand
    assert np.ptp(hand[:, :, -1], axis=1) == pytest.approx(0.0, abs=2e-3)
    assert hand[:, :, -1] == pytest.approx(0.03, abs=2e-3)
    assert np.ptp(run_trials(people[:3], Intention.REACH, targets).hand[:, :, 40], axis=1).max() > 1e-4


def test_a_hand_without_a_push_holds_still(people):
    recording = run_trials(people, Intention.REACH, resting_targets((len(people), 2), 250))
    assert np.abs(recording.hand[:, :, 150:]).max() < 2e-3
    assert recording.speed[:, :, 150:].max() < 0.02


def test_resistance_reduces_the_displacement_by_a_push(people):
    seconds, passive = push_response(people, "passive")
    _, resisting = push_response(people, "comply_or_resist")
    early, late = (seconds > 0) & (seconds <= 0.1), (seconds > 0.6) & (seconds <= 1.0)
    assert np.array_equal(passive[:, early], resisting[:, early])  # before touch is felt nobody answers
    assert resisting[:, late].mean() < 0.8 * passive[:, late].mean()
    assert passive[:, seconds <= 0].max() == pytest.approx(0.0, abs=5e-3)  # it stood on the mark


def test_proprioception_delays_the_replanning_after_a_push(people):
    """The proprioceptive delay postpones new plans, not the arm's own stiffness."""
    people = people.copy()
    people["tremor"] = 0.0
    quick = people.copy()
    quick["proprioceptive_delay"] = 0.0
    seconds, usual = push_response(people, "passive")
    _, off = push_response(quick, "passive")
    later = usual - off
    assert np.abs(later[:, (seconds > -0.1) & (seconds <= 0.02)]).mean() < 1e-4
    assert later[:, (seconds > 0.1) & (seconds < 0.2)].mean() > 5e-4  # corrected later


def test_onset_is_interpolated_between_ticks():
    speed = np.array([[0.0, 0.0, 0.01, 0.03, 0.2], [0.0, 0.0, 0.0, 0.0, 0.0]])
    found = onset(speed, np.array([1, 1]))
    assert found[0] == pytest.approx(0.02 * (2 + 0.5))  # half way through the tick that ends at .03, the third
    assert np.isnan(found[1])


def test_reaches_that_miss_have_no_movement_time(people):
    data = reaches(people[:4], trials=6)
    assert np.isnan(data.movement_time(1e-13)).all()
    assert np.isfinite(data.movement_time(0.02)).all()
    assert (data.movement_time(0.02) <= data.movement_time(0.006) + 1e-9).all()


def test_identical_people_react_alike():
    parameters = Population.default().parameters
    same = {name: value._replace(log_sd=0.0) for name, value in parameters.items() if isinstance(value, LogNormal)}
    clones = sample_people(8, 5, Population.default(**same, skill_sd=0.0, delay_noise=0.0))
    others = sample_people(8, 5, Population.default(delay_noise=0.0))
    spread, usual = (reaction_times(people, trials=10).mean(axis=1).std() for people in (clones, others))
    assert spread < 0.3 * usual
