"""The four objective metrics of section 4.3 on hand-built trajectories."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from airhockey_marl.envs.physics import TableSpec
from guidance.study.metrics import (
    COUNTS,
    METRIC_COUNTERS,
    RunningMoments,
    count_values,
    disagreement,
    metric_values,
    record,
)

TABLE = TableSpec()
MINE, THEIRS = 1, 2


def play(*ticks: dict) -> dict[str, float]:
    """Enter a game of ticks, each: puck before and after (x, y, vx, vy), who touched, goal, served, disagreement."""
    counters = np.zeros(1, METRIC_COUNTERS)
    for entry in ticks:
        record(
            counters,
            np.flatnonzero([entry.get("scored", True)]),
            np.array([entry["before"]], dtype=float),
            np.array([entry["after"]], dtype=float),
            np.array([entry.get("touched", 0)]),
            np.array([entry.get("served", False)]),
            np.array([entry.get("goal", 0)]),
            np.array([entry.get("disagreed", 0.0)]),
            TABLE,
        )
    return {name: values[0] for name, values in metric_values(counters).items()}


COMING, SAVED = (-0.3, 0.0, -2.0, 0.0), (-0.5, 0.0, 2.0, 0.5)
REST = (0.5, 0.0, 0.0, 0.0)


def test_win_rate_counts_decided_rounds():
    rounds = [{"before": REST, "after": REST, "goal": goal} for goal in (1, 1, -1, 1)]
    assert play(*rounds)["win_rate"] == 0.75
    assert np.isnan(play({"before": REST, "after": REST})["win_rate"])


def test_a_smash_is_the_users_puck_crossing_the_half_way_line():
    hit = {"before": COMING, "after": SAVED, "touched": MINE}
    cross = {"before": (-0.01, 0, 3, 4), "after": (0.02, 0, 3, 4)}
    back = {"before": (0.02, 0, -3, 0), "after": (-0.01, 0, -3, 0)}
    assert play(hit, cross)["mean_smash_speed"] == 5.0
    assert play(hit, cross, back, {**cross, "after": (0.02, 0, 1, 0)})["mean_smash_speed"] == 3.0
    assert np.isnan(play({**hit, "touched": THEIRS}, cross)["mean_smash_speed"])
    assert np.isnan(play(hit, {**cross, "served": True})["mean_smash_speed"])
    assert np.isnan(play(hit, {"before": REST, "after": REST, "goal": -1}, cross)["mean_smash_speed"])


def test_a_shot_is_blocked_by_a_touch_that_turns_it_away():
    shot = {"before": (0.1, 0, -2, 0), "after": COMING, "touched": THEIRS}
    save = {"before": COMING, "after": SAVED, "touched": MINE}
    assert play(shot, save)["defense_rate"] == 1.0
    assert play(shot, {"before": COMING, "after": (-1, 0, -2, 0), "goal": -1})["defense_rate"] == 0.0
    graze = {"before": COMING, "after": (-0.5, 0.01, -1.5, 0.0), "touched": MINE}
    assert play(shot, graze, {"before": COMING, "after": (-1, 0, -2, 0), "goal": -1})["defense_rate"] == 0.0
    assert play(shot, graze, save)["defense_rate"] == 1.0


def test_no_shot_is_no_rate():
    wide = {"before": (0.1, 0.4, -2, 0), "after": (0.0, 0.4, -2, 0), "touched": THEIRS}
    stopped = {"before": COMING, "after": (-0.6, 0.1, 0.0, 0.0)}
    for ticks in ((wide, {**wide, "touched": MINE}), ({"before": REST, "after": COMING}, stopped)):
        assert np.isnan(play(*ticks)["defense_rate"])
    anew = {"before": COMING, "after": (0.0, 0.0, 1.0, 0.0), "served": True}
    assert np.isnan(play({"before": REST, "after": COMING}, anew)["defense_rate"])


def test_unscored_ticks_leave_no_trace():
    assert np.isnan(play({"before": REST, "after": REST, "goal": 1, "scored": False})["win_rate"])


def test_disagreement_is_the_force_against_the_motion():
    """Section 4.3: aligned 0, opposed |F|, across 0, 120 degrees half, no motion 0."""
    force = np.array([[2.0, 0.0]] * 5)
    change = np.array([[0.1, 0], [-0.3, 0], [0, 0.2], [-0.1, 0.1 * 3**0.5], [0, 0]])
    assert disagreement(force, change) == pytest.approx([0, 2, 0, 1, 0], abs=1e-12)
    opposed = {"before": REST, "after": REST}
    assert play({**opposed, "disagreed": 3.0}, {**opposed, "disagreed": 1.0})["mean_disagreement"] == 2.0


@given(st.lists(st.tuples(*[st.integers(0, 40)] * 4), min_size=1))
def test_rates_are_ratios_of_the_counts(games):
    """To the last bit, and undefined together."""
    counters = np.zeros(len(games), METRIC_COUNTERS)
    won, lost, blocked, conceded = np.array(games).T
    counters["won"], counters["lost"], counters["blocked"], counters["shots"] = won, lost, blocked, blocked + conceded
    rates, counts = metric_values(counters), count_values(counters, won + lost + 2)
    assert tuple(counts) == COUNTS and (counts["rounds_undecided"] == 2).all()
    with np.errstate(invalid="ignore"):
        ratios = {
            "win_rate": counts["rounds_won"] / (counts["rounds_won"] + counts["rounds_lost"]),
            "defense_rate": counts["shots_stopped"] / counts["shots_faced"],
        }
    for name, ratio in ratios.items():
        assert np.array_equal(rates[name], ratio, equal_nan=True)


def test_moments_agree_with_numpy():
    values = np.random.default_rng(0).normal(3, 2, (40, 5))
    counted = np.random.default_rng(1).random((40, 5)) < 0.7
    counted[:, 4] = False
    moments = RunningMoments(5)
    for which, value in zip(counted, values, strict=True):
        moments.add(np.arange(5), np.where(which, value, np.nan))
    mean, sd = moments.result()
    for game in range(4):
        chosen = values[counted[:, game], game]
        assert (mean[game], sd[game]) == pytest.approx((chosen.mean(), chosen.std()))
    assert np.isnan(mean[4]) and np.isnan(sd[4])


def test_disagreement_of_many_games_at_once():
    generator = torch.Generator().manual_seed(0)
    force, change = torch.randn(2, 100, 2, generator=generator).numpy()
    got = disagreement(force, change)
    expected = [max(0.0, -f @ c / np.hypot(*c)) for f, c in zip(force, change, strict=True)]
    assert got == pytest.approx(expected, rel=1e-5)
