"""Who is met how often."""

import numpy as np
import pytest

from airhockey_marl.league.opponent_sampling import (
    PFSP,
    Curriculum,
    DeltaUniform,
    Latest,
    Mixture,
    PoolStatistics,
    ScriptedOnly,
)

UNKNOWN = PoolStatistics(generations=4, anchors=2, win_rates=np.full(6, 0.5))


def test_generations():
    assert Latest().probabilities(UNKNOWN).tolist() == [0, 0, 0, 1, 0, 0]
    assert DeltaUniform(0.0).probabilities(UNKNOWN).tolist() == [0.25] * 4 + [0, 0]
    assert DeltaUniform(0.5).probabilities(UNKNOWN).tolist() == [0, 0, 0.5, 0.5, 0, 0]
    assert DeltaUniform(0.9).probabilities(PoolStatistics(1, 0, np.full(1, 0.5))).tolist() == [1.0]
    assert ScriptedOnly().probabilities(UNKNOWN).tolist() == [0, 0, 0, 0, 0.5, 0.5]


def test_prioritized_prefers_whoever_wins_or_whoever_is_an_equal():
    standing = PoolStatistics(2, 1, np.array([0.9, 0.5, 0.1]))
    hard, even = (PFSP(weighting).probabilities(standing) for weighting in ("squared", "variance"))
    assert np.allclose(hard, np.array([0.01, 0.25, 0.81]) / 1.07, atol=1e-5)
    assert np.allclose(even, np.array([0.09, 0.25, 0.09]) / 0.43, atol=1e-5)
    beaten_all = PoolStatistics(2, 0, np.ones(2))
    assert np.allclose(PFSP("squared").probabilities(beaten_all), 0.5)


def test_a_mixture_gives_each_its_share():
    mixture = Mixture([Latest(), ScriptedOnly()], [3.0, 1.0])
    assert mixture.probabilities(UNKNOWN).tolist() == [0, 0, 0, 0.75, 0.125, 0.125]


def test_a_curriculum_changes_over_once():
    curriculum = Curriculum(Latest(), ScriptedOnly(), generation=5)
    assert curriculum.probabilities(UNKNOWN).tolist() == Latest().probabilities(UNKNOWN).tolist()
    grown = PoolStatistics(generations=5, anchors=1, win_rates=np.full(6, 0.5))
    assert curriculum.probabilities(grown).tolist() == [0, 0, 0, 0, 0, 1]


def test_chances_sum_to_one():
    rng = np.random.default_rng(0)
    for sampler in (Latest(), DeltaUniform(0.3), ScriptedOnly(), PFSP("squared"), PFSP("variance")):
        for generations in (1, 2, 17):
            chances = sampler.probabilities(PoolStatistics(generations, 3, rng.random(generations + 3)))
            assert chances.shape == (generations + 3,) and (chances >= 0).all() and np.isclose(chances.sum(), 1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DeltaUniform(1.0), "delta = 1.0 must be at least 0 and below 1"),
        (lambda: PFSP("soft"), "weighting = 'soft' must be one of squared, variance"),
        (lambda: Mixture([Latest()], [1.0, 2.0]), "shares = .* must be 1 numbers above 0"),
        (lambda: Mixture([Latest()], [0.0]), "above 0"),
        (lambda: ScriptedOnly().probabilities(PoolStatistics(1, 0, np.full(1, 0.5))), "league.anchors"),
    ],
)
def test_wrong_settings_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
