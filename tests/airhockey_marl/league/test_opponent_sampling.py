"""Opponent sampling: the probabilities of each rule."""

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

UNKNOWN = PoolStatistics(generations=4, scripted_players=2, win_rates=np.full(6, 0.5))


def test_probabilities_of_generations_and_scripts():
    assert Latest().probabilities(UNKNOWN).tolist() == [0, 0, 0, 1, 0, 0]
    assert DeltaUniform(0.0).probabilities(UNKNOWN).tolist() == [0.25] * 4 + [0, 0]
    assert DeltaUniform(0.5).probabilities(UNKNOWN).tolist() == [0, 0, 0.5, 0.5, 0, 0]
    assert DeltaUniform(0.9).probabilities(PoolStatistics(1, 0, np.full(1, 0.5))).tolist() == [1.0]
    assert ScriptedOnly().probabilities(UNKNOWN).tolist() == [0, 0, 0, 0, 0.5, 0.5]


def test_pfsp_prefers_strong_or_equal_players():
    statistics = PoolStatistics(2, 1, np.array([0.9, 0.5, 0.1]))
    squared, variance = (PFSP(weighting).probabilities(statistics) for weighting in ("squared", "variance"))
    assert np.allclose(squared, np.array([0.01, 0.25, 0.81]) / 1.07, atol=1e-5)
    assert np.allclose(variance, np.array([0.09, 0.25, 0.09]) / 0.43, atol=1e-5)
    always_winning = PoolStatistics(2, 0, np.ones(2))
    assert np.allclose(PFSP("squared").probabilities(always_winning), 0.5)


def test_mixture_weights_its_samplers():
    mixture = Mixture([Latest(), ScriptedOnly()], [3.0, 1.0])
    assert mixture.probabilities(UNKNOWN).tolist() == [0, 0, 0, 0.75, 0.125, 0.125]


def test_curriculum_switches_at_its_generation():
    curriculum = Curriculum(Latest(), ScriptedOnly(), generation=5)
    assert curriculum.probabilities(UNKNOWN).tolist() == Latest().probabilities(UNKNOWN).tolist()
    grown = PoolStatistics(generations=5, scripted_players=1, win_rates=np.full(6, 0.5))
    assert curriculum.probabilities(grown).tolist() == [0, 0, 0, 0, 0, 1]


def test_probabilities_sum_to_one():
    rng = np.random.default_rng(0)
    for sampler in (Latest(), DeltaUniform(0.3), ScriptedOnly(), PFSP("squared"), PFSP("variance")):
        for generations in (1, 2, 17):
            probabilities = sampler.probabilities(PoolStatistics(generations, 3, rng.random(generations + 3)))
            assert (
                probabilities.shape == (generations + 3,)
                and (probabilities >= 0).all()
                and np.isclose(probabilities.sum(), 1)
            )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DeltaUniform(1.0), "delta = 1.0 must be a finite number of at least 0 and below 1"),
        (lambda: PFSP("soft"), "weighting = 'soft' must be one of squared, variance"),
        (lambda: Mixture([Latest()], [1.0, 2.0]), "shares = .* must be 1 numbers above 0"),
        (lambda: Mixture([Latest()], [0.0]), "above 0"),
        (lambda: ScriptedOnly().probabilities(PoolStatistics(1, 0, np.full(1, 0.5))), "league.scripted_players"),
    ],
)
def test_wrong_settings_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
