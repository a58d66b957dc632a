"""Ratings: the payoff matrix of a league, Bradley-Terry ratings with intervals, and the matches of its training.

A rating is in Elo points: 400 points more are odds of ten to one. Draws are ignored. Ratings depend on sums of wins
only, so the order of the rounds does not change a bit of them.
"""

from collections.abc import Callable, Sequence
from math import log
from pathlib import Path
from typing import Any, NamedTuple

import choix
import numpy as np
import pandas as pd
import torch
from scipy import stats

from airhockey_marl.evaluation.matches import RESULT_COLUMNS, play_matches
from airhockey_marl.experiment.validation.tables import Column, read_table
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.players import stochastic

ELO = 400 / log(10)  # points per unit of log-odds
PRIOR_ROUNDS = 1.0  # drawn against a player of free strength; see `bradley_terry`
Z_95 = stats.norm.isf(0.025)  # half the width of a 95 % interval, in standard errors
MAX_TABLES = 250  # played side by side; more are not faster, as `World` then waits for threads
MATCH_COLUMNS = ("generation", "opponent", *RESULT_COLUMNS)  # of matches.csv


class Proportion(NamedTuple):
    """A proportion of `trials` trials with its 95 % interval (Wilson's)."""

    value: float
    low: float
    high: float
    trials: int

    @classmethod
    def from_counts(cls, successes: int, trials: int) -> "Proportion":
        """Without trials: NaN with the interval [0, 1]."""
        if not trials:
            return cls(float("nan"), 0.0, 1.0, 0)
        low, high = stats.binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
        return cls(successes / trials, float(low), float(high), int(trials))

    def difference(self, other: "Proportion") -> tuple[float, float, float]:
        """The difference of two independent proportions and its 95 % interval (Newcombe's hybrid score interval)."""
        difference = self.value - other.value
        below = np.hypot(self.value - self.low, other.high - other.value)
        above = np.hypot(self.high - self.value, other.value - other.low)
        return difference, difference - float(below), difference + float(above)


class RatingDifference(NamedTuple):
    """Elo points of one player, or of k players (k,), above another, and the bounds of the 95 % intervals."""

    value: float | np.ndarray
    low: float | np.ndarray
    high: float | np.ndarray


class GoodnessOfFit(NamedTuple):
    """Whether one number per player explains the payoff matrix: Pearson's chi-squared of the wins under the ratings.

    Attributes:
        ratio: chi-squared per degree of freedom. About 1 if ratings and chance explain the wins; more if strength is
            not transitive, and then the intervals of `bradley_terry` are too narrow by about its root. NaN below three
            players.
        p: probability of a ratio at least as large if the ratings explain the wins.
    """

    ratio: float
    p: float


def play_pairs(
    league: League,
    pairs: Sequence[tuple[PlayerId, PlayerId]],
    rounds: int,
    seed: int,
    tables_per_pair: int = 10,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> np.ndarray:
    """Let each pair of players play `rounds` rounds, many pairs side by side, with actions sampled as in training.

    The table is symmetric under a half turn, so the first of a pair always plays on the left.

    Args:
        tables_per_pair: the largest number of tables among which a pair's rounds are divided, evenly.
        progress: called with the fraction of pairs that have played.
        options: see `matches.play_rounds`.

    Returns:
        (pairs, 3) int: wins of the first of each pair, losses, and draws.
    """
    tables = max(n for n in range(1, tables_per_pair + 1) if rounds % n == 0)
    generator = torch.Generator().manual_seed(seed)
    score = np.zeros((len(pairs), 3), dtype=np.int64)
    chunk_size = max(1, MAX_TABLES // tables)
    for first in range(0, len(pairs), chunk_size):
        chunk = pairs[first : first + chunk_size]
        left, right = (stochastic(league.opponent_batch(ids), generator) for ids in zip(*chunk, strict=True))
        sizes = (len(chunk), tables, rounds // tables)
        score[first : first + len(chunk)] = play_matches(left, right, *sizes, seed + first * tables, **options)
        if progress:
            progress((first + len(chunk)) / len(pairs))
    return score


def payoff(league: League, player_ids: Sequence[PlayerId], rounds: int, seed: int, **options: Any) -> np.ndarray:
    """The payoff matrix: every pair of different players plays; see `play_pairs` for the options.

    Returns:
        (k, k, 3) int: wins of the row's player against the column's, losses, and draws.
    """
    rows, columns = np.triu_indices(len(player_ids), 1)
    pairs = [(player_ids[row], player_ids[column]) for row, column in zip(rows, columns, strict=True)]
    score = np.zeros((len(player_ids), len(player_ids), 3), dtype=np.int64)
    score[rows, columns] = play_pairs(league, pairs, rounds, seed, **options)
    score[columns, rows] = score[rows, columns][:, [1, 0, 2]]
    return score


def win_rates(score: np.ndarray) -> np.ndarray:
    """Win rates (...) among the decided rounds, from wins, losses and draws (..., 3); NaN where none was decided."""
    decided = score[..., 0] + score[..., 1]
    return np.where(decided > 0, score[..., 0] / np.maximum(decided, 1), np.nan)


def bradley_terry(wins: np.ndarray, reference: int) -> RatingDifference:
    """Bradley-Terry ratings: the probability that i beats j is the logistic of the difference of their strengths.

    Maximum likelihood by iterative Luce spectral ranking (Maystre and Grossglauser 2015), with a prior:
    `PRIOR_ROUNDS` of each player against one more player, of free strength, half of them won. It keeps the rating of a
    player finite who won or lost all rounds or has no decided round (then the interval is wide), is symmetric in wins
    and losses, and is small beside the hundreds of rounds that are usual here. The intervals are from the observed
    information; they are valid if one number explains strength, see `goodness_of_fit`.

    Args:
        wins: (k, k) rounds that the row's player won against the column's; not all pairs need to have met.
        reference: index of the player whose rating is 0.
    """
    k = len(wins)
    padded_wins = np.pad(np.asarray(wins, dtype=np.float64), (0, 1), constant_values=PRIOR_ROUNDS / 2)
    np.fill_diagonal(padded_wins, 0.0)  # self-play carries no rating information
    strength = choix.ilsr_pairwise_dense(padded_wins, max_iter=100_000, tol=1e-11)
    rounds, probability = padded_wins + padded_wins.T, _logistic(strength)
    information = np.diag((rounds * probability * (1 - probability)).sum(axis=1))
    information -= rounds * probability * (1 - probability)
    # only differences to the reference are identified: without its row and column the information is regular
    others = np.delete(np.arange(len(strength)), reference)
    error = np.zeros(len(strength))
    error[others] = np.sqrt(np.diag(np.linalg.inv(information[np.ix_(others, others)])))
    rating = ELO * (strength - strength[reference])[:k]
    half_width = ELO * Z_95 * error[:k]
    return RatingDifference(rating, rating - half_width, rating + half_width)


def rating_differences(
    player_ids: Sequence[PlayerId], wins: np.ndarray, reference: PlayerId
) -> dict[PlayerId, RatingDifference]:
    """The rating differences of all players to `reference`; see `bradley_terry`."""
    rows = np.stack(bradley_terry(wins, list(player_ids).index(reference)), axis=1).tolist()
    return {player: RatingDifference(*row) for player, row in zip(player_ids, rows, strict=True)}


def goodness_of_fit(wins: np.ndarray, rating: np.ndarray) -> GoodnessOfFit:
    """The fit of wins (k, k) to the predictions of the ratings (k,), in Elo points."""
    rows, columns = np.triu_indices(len(wins), 1)
    rounds, probability = (wins + wins.T)[rows, columns], _logistic(rating / ELO)[rows, columns]
    freedom = np.count_nonzero(rounds) - (len(wins) - 1)
    if freedom < 1:
        return GoodnessOfFit(float("nan"), float("nan"))
    variance = np.maximum(rounds * probability * (1 - probability), 1e-12)
    chi2 = ((wins[rows, columns] - rounds * probability) ** 2 / variance)[rounds > 0].sum()
    return GoodnessOfFit(float(chi2 / freedom), float(stats.chi2.sf(chi2, freedom)))


def _logistic(strength: np.ndarray) -> np.ndarray:
    """(k, k): the probability that the row beats the column, from strengths (k,) in log-odds."""
    return 1 / (1 + np.exp(strength[None, :] - strength[:, None]))


def ratings_table(player_ids: Sequence[PlayerId], wins: np.ndarray) -> pd.DataFrame:
    """Ratings relative to the first player, with the columns member, rating, low, high; see `bradley_terry`."""
    rating, low, high = bradley_terry(wins, 0)
    return pd.DataFrame({"member": pd.Series(player_ids, dtype=object), "rating": rating, "low": low, "high": high})


def wins_of_matches(matches: pd.DataFrame) -> tuple[list[PlayerId], np.ndarray]:
    """The players in `matches` (`MATCH_COLUMNS`), first the generations in their order, and their wins (k, k)."""
    players = {*matches["generation"], *matches["opponent"]}
    player_ids = sorted(players, key=lambda player: (isinstance(player, str), player))
    index = {player: i for i, player in enumerate(player_ids)}
    wins = np.zeros((len(player_ids), len(player_ids)), dtype=np.int64)
    for generation, opponent, won, lost, _ in matches[list(MATCH_COLUMNS)].itertuples(index=False):
        wins[index[generation], index[opponent]] += won
        wins[index[opponent], index[generation]] += lost
    return player_ids, wins


def read_matches(path: Path | str) -> pd.DataFrame:
    """Read a matches.csv: columns `MATCH_COLUMNS`; opponents are generations or names of scripted players."""
    columns = dict.fromkeys(MATCH_COLUMNS, Column(low=0.0, whole=True)) | {"opponent": Column(text=True)}
    matches = read_table(path, columns)[list(MATCH_COLUMNS)]
    opponents = [int(m) if m.isdigit() else m for m in matches["opponent"]]
    return matches.assign(opponent=pd.Series(opponents, dtype=object))
