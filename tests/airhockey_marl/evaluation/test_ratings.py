"""Ratings: the payoff matrix, agreement with a textbook likelihood, coverage of the intervals, and matches.csv."""

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

from airhockey_marl.evaluation import ratings
from airhockey_marl.evaluation.ratings import (
    ELO,
    MATCH_COLUMNS,
    PRIOR_ROUNDS,
    Proportion,
    bradley_terry,
    goodness_of_fit,
    payoff,
    play_pairs,
    rating_differences,
    ratings_table,
    read_matches,
    win_rates,
    wins_of_matches,
)
from tests.airhockey_marl.league.test_league import league_of


def tournament(elo: np.ndarray, rounds: int, rng: np.random.Generator, met: np.ndarray | None = None) -> np.ndarray:
    """(k, k) wins of players of these strengths, `rounds` rounds each pair, or each pair in `met`."""
    wins = np.zeros((len(elo), len(elo)), dtype=np.int64)
    for i, j in zip(*np.triu_indices(len(elo), 1), strict=True):
        if met is None or met[i, j]:
            wins[i, j] = rng.binomial(rounds, 1 / (1 + 10 ** ((elo[j] - elo[i]) / 400)))
            wins[j, i] = rounds - wins[i, j]
    return wins


def maximum_likelihood(wins: np.ndarray, prior_rounds: float) -> np.ndarray:
    """Elo above the first player, by minimizing the textbook negative log-likelihood."""
    k = len(wins)
    wins = np.pad(wins.astype(float), (0, 1), constant_values=prior_rounds / 2)
    wins[k, k] = 0.0

    def loss(strength: np.ndarray) -> tuple[float, np.ndarray]:
        margin = strength[:, None] - strength[None, :]
        surprise = wins / (1 + np.exp(margin))
        gradient = surprise.sum(axis=0) - surprise.sum(axis=1)
        return float((wins * np.logaddexp(0.0, -margin)).sum()), gradient

    strength = minimize(loss, np.zeros(k + 1), jac=True, method="BFGS", options={"gtol": 1e-8, "maxiter": 5000}).x[:k]
    return ELO * (strength - strength[0])


def ring(k: int) -> np.ndarray:
    """Which pairs met (k, k), if every player met its two neighbors only."""
    place = np.arange(k)
    return np.isin((place[:, None] - place[None, :]) % k, (1, k - 1))


@pytest.mark.parametrize("met", [None, ring(9)])
def test_ratings_are_the_maximum_of_the_likelihood(met):
    rng = np.random.default_rng(0)
    wins = tournament(200 * rng.normal(size=9), 60, rng, met)
    np.testing.assert_allclose(bradley_terry(wins, 0).value, maximum_likelihood(wins, PRIOR_ROUNDS), atol=0.01)


def test_prior_is_negligible_beside_hundreds_of_rounds():
    rng = np.random.default_rng(1)
    wins = tournament(200 * rng.normal(size=12), 100, rng)
    rated = bradley_terry(wins, 0)
    assert np.abs(maximum_likelihood(wins, 0.0) - rated.value).max() < 0.03 * (rated.high - rated.low).max()


@pytest.mark.parametrize(
    ("elo", "rounds", "met", "reference", "least", "most"),
    [
        ([0.0, 60.0, -150.0, 250.0, 100.0, 20.0], 30, None, 0, 0.92, 0.975),
        ([0.0, 100.0, 200.0, 100.0, 0.0, -100.0, -50.0], 60, ring(7), 2, 0.90, 0.99),
    ],
    ids=["full", "sparse"],
)
def test_intervals_have_their_nominal_coverage(elo, rounds, met, reference, least, most):
    rng, hits, elo = np.random.default_rng(2), [], np.array(elo)
    for _ in range(200):
        rated = bradley_terry(tournament(elo, rounds, rng, met), reference)
        hits.append((rated.low <= elo - elo[reference]) & (elo - elo[reference] <= rated.high))
    assert least < np.delete(hits, reference, axis=1).mean() < most
    assert np.array(hits)[:, reference].all()  # the reference is where it is by definition


def test_players_that_won_or_lost_all_rounds_have_finite_ratings_and_wide_intervals():
    wins = tournament(np.zeros(5), 50, np.random.default_rng(4))
    wins[3], wins[:, 3] = np.array([50, 50, 50, 0, 50]), 0
    best, worst = bradley_terry(wins, 0), bradley_terry(wins.T, 0)
    for rated in (best, worst):
        assert np.isfinite(rated).all() and rated.low[3] < rated.value[3] < rated.high[3]
        assert rated.high[3] - rated.low[3] > 3 * (rated.high[1] - rated.low[1])
    assert best.low[3] > 200
    np.testing.assert_allclose(best.value, -worst.value, atol=1e-6)  # winners and losers are treated alike


def test_reference_shifts_the_ratings():
    rng = np.random.default_rng(5)
    wins = tournament(100 * rng.normal(size=6), 40, rng)
    first, third = bradley_terry(wins, 0), bradley_terry(wins, 2)
    np.testing.assert_allclose(first.value - first.value[2], third.value, atol=1e-9)
    assert third[0][2] == third[1][2] == third[2][2] == 0
    there, back = rating_differences("abcdef", wins, "c")["a"], rating_differences("abcdef", wins, "a")["c"]
    np.testing.assert_allclose(there, (-back.value, -back.high, -back.low), atol=1e-6)


def test_unconnected_players_have_wide_intervals():
    wins = np.zeros((4, 4))
    wins[0, 1] = wins[1, 0] = 500
    wins[2, 3] = 5
    rated = bradley_terry(wins, 0)
    assert np.isfinite(rated).all()
    assert (rated.high - rated.low)[1] < 100 and ((rated.high - rated.low)[2:] > 1000).all()


def test_goodness_of_fit_distinguishes_cycles_from_chance():
    rng, ratios, surprises = np.random.default_rng(6), [], 0
    for _ in range(100):
        wins = tournament(150 * rng.normal(size=8), 50, rng)
        fit = goodness_of_fit(wins, bradley_terry(wins, 0).value)
        ratios.append(fit.ratio)
        surprises += fit.p < 0.05
    assert 0.9 < np.mean(ratios) < 1.1 and surprises <= 12
    rock_paper_scissors = 40 * np.roll(np.eye(3), 1, axis=1) + 10 * np.roll(np.eye(3), -1, axis=1)
    fit = goodness_of_fit(rock_paper_scissors, bradley_terry(rock_paper_scissors, 0).value)
    assert fit.ratio > 20 and fit.p < 1e-6
    assert np.isnan(goodness_of_fit(np.ones((2, 2)), np.zeros(2))).all()


def test_proportions_have_wilsons_intervals_and_newcombes_difference():
    """Newcombe 1998, the example 56/70 against 48/80: .2 [.0524, .3339]."""
    assert Proportion.from_counts(56, 70)[:3] == pytest.approx((0.8, 0.6921, 0.8771), abs=5e-4)
    assert Proportion.from_counts(56, 70).difference(Proportion.from_counts(48, 80)) == pytest.approx(
        (0.2, 0.0524, 0.3339), abs=5e-5
    )
    assert Proportion.from_counts(0, 0)[1:] == (0.0, 1.0, 0) and np.isnan(Proportion.from_counts(0, 0).value)


PLAYERS = [0, 2, 1, "random", "striker"]


@pytest.fixture(scope="module")
def score() -> np.ndarray:
    return payoff(league_of(3), PLAYERS, rounds=4, seed=3)


def test_payoff_counts_every_round_for_both_players(score):
    assert score.shape == (5, 5, 3)
    assert (score.sum(axis=2) == 4 * (1 - np.eye(5))).all()
    np.testing.assert_array_equal(score, score.transpose(1, 0, 2)[..., [1, 0, 2]])
    shares = win_rates(score)
    assert np.isnan(np.diag(shares)).all() and shares[4, 3] > 0.5  # a striker beats a wild paddle


def test_payoff_is_reproducible(score):
    np.testing.assert_array_equal(payoff(league_of(3), PLAYERS, rounds=4, seed=3), score)


def test_results_belong_to_their_pairs_in_chunks_of_any_size(monkeypatch):
    """Striker and random among untrained generations, in chunks of one pair and in one chunk."""
    league, progress = league_of(2), []
    pairs = [(0, 1), ("striker", "random"), (1, 0), ("random", "striker")]
    for max_tables in (4, 250):
        monkeypatch.setattr(ratings, "MAX_TABLES", max_tables)
        won = play_pairs(league, pairs, rounds=8, seed=0, tables_per_pair=4, progress=progress.append)
        assert (won.sum(axis=1) == 8).all()
        assert won[1, 0] > won[1, 1] and won[3, 0] < won[3, 1]
    assert progress == [0.25, 0.5, 0.75, 1.0, 1.0]
    with pytest.raises(ValueError, match="generation = 7"):
        payoff(league, [0, 7], 1, 0)


def matches_of(seed: int = 0) -> pd.DataFrame:
    """Ten generations of growing strength, each against every third before it and two scripted players."""
    rng, rows = np.random.default_rng(seed), []
    strength = {**{g: 40.0 * g for g in range(10)}, "random": -50.0, "striker": 300.0}
    for g in range(1, 10):
        for other in (*range(0, g, 3), "random", "striker"):
            won = int(rng.binomial(50, 1 / (1 + 10 ** ((strength[other] - strength[g]) / 400))))
            rows.append((g, other, won, 50 - won, 3))
    return pd.DataFrame(rows, columns=list(MATCH_COLUMNS))


def ratings_of_matches(matches: pd.DataFrame) -> pd.DataFrame:
    return ratings_table(*wins_of_matches(matches))


def test_ratings_of_matches_are_of_all_players():
    rated = ratings_of_matches(matches_of())
    assert list(rated.columns) == ["member", "rating", "low", "high"]
    assert list(rated["member"]) == [*range(10), "random", "striker"]
    assert tuple(rated.iloc[0, 1:]) == (0, 0, 0)
    truth = np.array([*(40.0 * g for g in range(10)), -50.0, 300.0])
    assert ((rated["low"] <= truth) & (truth <= rated["high"])).mean() > 0.7


def test_order_of_the_matches_does_not_matter():
    matches = matches_of()
    rated = ratings_of_matches(matches)
    for seed in range(5):
        shuffled = matches.sample(frac=1, random_state=seed)
        pd.testing.assert_frame_equal(ratings_of_matches(shuffled), rated, check_exact=True)
    halves = pd.concat([matches, matches.assign(won=0, lost=0, undecided=9)])  # undecided rounds count for nothing
    pd.testing.assert_frame_equal(ratings_of_matches(halves), rated, check_exact=True)


def test_matches_are_restored_from_their_file(tmp_path):
    matches = matches_of()
    matches.to_csv(tmp_path / "matches.csv", index=False)
    again = read_matches(tmp_path / "matches.csv")
    assert list(again["opponent"]) == list(matches["opponent"])
    pd.testing.assert_frame_equal(ratings_of_matches(again), ratings_of_matches(matches), check_exact=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("generation,opponent,won,lost\n1,0,1,2\n", "lacks the columns undecided"),
        ("generation,opponent,won,lost,undecided\n1,0,1,-2,0\n", "row 2, lost = '-2' must be a whole number"),
        ("generation,opponent,won,lost,undecided\n1,0,1,2,0\n2,0,x,2,0\n", "row 3, won = 'x' must be a whole number"),
        ("generation,opponent,won,lost,undecided\n1,0,1.5,2,0\n", "won = '1.5' must be a whole number"),
        ("generation,opponent,won,lost,undecided\n1,,1,2,0\n", "row 2, opponent = empty must be a name"),
        ("", "must be a table, and is empty"),
        ('generation,opponent,won,lost,undecided\n"1,0', "matches.csv"),
    ],
)
def test_invalid_files_are_named(tmp_path, text, message):
    (tmp_path / "matches.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as refused:
        read_matches(tmp_path / "matches.csv")
    assert "matches.csv" in str(refused.value)
    with pytest.raises(ValueError, match="no such file"):
        read_matches(tmp_path / "nowhere.csv")
