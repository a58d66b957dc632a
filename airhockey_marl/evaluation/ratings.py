"""Who is how strong: rounds between all pairs of a league, Bradley-Terry ratings with intervals, and kept matches.

A rating is in Elo points: 400 more are odds of ten to one. Rounds that nobody won count for nothing. Ratings follow
from the sums of won rounds alone, so the order in which they were played cannot change a bit of them.
"""

from collections.abc import Callable, Sequence
from math import log
from numbers import Integral
from pathlib import Path
from typing import NamedTuple

import choix
import numpy as np
import pandas as pd
import torch
from scipy import stats
from scipy.sparse.csgraph import connected_components

from airhockey_marl.evaluation.matches import FRAME_SKIP, play_matches
from airhockey_marl.experiment.validation import check_arrays, check_counts, check_numbers
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.players import stochastic

ELO = 400 / log(10)  # points per unit of log-odds
PRIOR_ROUNDS = 1.0  # drawn against a player of no fixed strength; see `bradley_terry`
CONFIDENT = stats.norm.isf(0.025)  # half the width of a 95 % interval, in standard errors
TABLES_AT_ONCE = 250  # more are not faster: from `World.PARALLEL_FROM` on they wait for threads
MATCHES = ("generation", "opponent", "won", "lost", "undecided")  # the columns of matches.csv


class Proportion(NamedTuple):
    """A share of so many trials, with its 95 % interval (Wilson's)."""

    value: float
    low: float
    high: float
    trials: int

    @classmethod
    def of(cls, successes: int, trials: int) -> "Proportion":
        """Not a number, between 0 and 1, if there were no trials."""
        check_counts(0, successes=successes, trials=trials)
        if successes > trials:
            raise ValueError(f"successes = {successes} must be at most trials = {trials}")
        if not trials:
            return cls(float("nan"), 0.0, 1.0, 0)
        low, high = stats.binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
        return cls(successes / trials, float(low), float(high), int(trials))

    def minus(self, other: "Proportion") -> tuple[float, float, float]:
        """The difference of two independent shares and its 95 % interval (Newcombe's hybrid of two Wilson's)."""
        difference = self.value - other.value
        below = np.hypot(self.value - self.low, other.high - other.value)
        above = np.hypot(self.high - self.value, other.value - other.low)
        return difference, difference - float(below), difference + float(above)


class Ratings(NamedTuple):
    """Elo points above the reference (k,), and the ends of their 95 % intervals; the reference has 0, 0, 0."""

    rating: np.ndarray
    low: np.ndarray
    high: np.ndarray


class RatingDifference(NamedTuple):
    """Elo points of one member above another, with the ends of the 95 % interval of that difference."""

    value: float
    low: float
    high: float


class GoodnessOfFit(NamedTuple):
    """Whether strength is one number: Pearson's chi-squared of the payoff under the ratings, and its p.

    Attributes:
        ratio: per degree of freedom. About 1 if the ratings and chance explain who beats whom; more if that goes round
            in circles, and then the intervals of `bradley_terry` are too narrow by about its root. NaN below three members.
        p: of a ratio at least so large if the ratings explain everything.
    """

    ratio: float
    p: float


def play_pairs(
    league: League,
    pairs: Sequence[tuple[PlayerId, PlayerId]],
    rounds: int,
    seed: int,
    tables_per_pair: int = 10,
    frame_skip: int = FRAME_SKIP,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Let each pair of members play `rounds` rounds, many pairs side by side, with actions sampled as in training.

    A half turn of the table swaps the seats and changes nothing, so the first of a pair always sits left.

    Args:
        tables_per_pair: at most so many share a pair's rounds, each as many.
        progress: told the share of the pairs that have played.

    Returns:
        (pairs, 3) int: rounds won by the first of each pair, lost, and undecided.

    Raises:
        ValueError: no rounds, or a member is not there.
    """
    check_counts(rounds=rounds, tables_per_pair=tables_per_pair, frame_skip=frame_skip)
    check_counts(0, seed=seed)
    tables = max(n for n in range(1, tables_per_pair + 1) if rounds % n == 0)
    generator = torch.Generator().manual_seed(seed)
    score = np.zeros((len(pairs), 3), dtype=np.int64)
    at_once = max(1, TABLES_AT_ONCE // tables)
    for first in range(0, len(pairs), at_once):
        chunk = pairs[first : first + at_once]
        left, right = (stochastic(league.lineup([pair[seat] for pair in chunk]), generator) for seat in (0, 1))
        shared = (len(chunk), tables, rounds // tables)
        score[first : first + len(chunk)] = play_matches(
            left, right, *shared, seed + first * tables, frame_skip=frame_skip
        )
        if progress:
            progress((first + len(chunk)) / len(pairs))
    return score


def payoff(
    league: League,
    members: Sequence[PlayerId],
    rounds: int,
    seed: int,
    tables_per_pair: int = 10,
    frame_skip: int = FRAME_SKIP,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Every pair of different members plays; see `play_pairs`.

    Returns:
        (k, k, 3) int: rounds won by the member of the row against that of the column, lost, and undecided.
    """
    rows, columns = np.triu_indices(len(members), 1)
    pairs = [(members[row], members[column]) for row, column in zip(rows, columns, strict=True)]
    score = np.zeros((len(members), len(members), 3), dtype=np.int64)
    score[rows, columns] = play_pairs(league, pairs, rounds, seed, tables_per_pair, frame_skip, progress)
    score[columns, rows] = score[rows, columns][:, [1, 0, 2]]
    return score


def win_rates(score: np.ndarray) -> np.ndarray:
    """Share of the decided rounds that the row won, from (..., 3); not a number where none was decided."""
    check_arrays(score=(score, "... 3"))
    decided = score[..., 0] + score[..., 1]
    return np.where(decided > 0, score[..., 0] / np.maximum(decided, 1), np.nan)


def bradley_terry(wins: np.ndarray, reference: int, prior_rounds: float = PRIOR_ROUNDS) -> Ratings:
    """Bradley-Terry ratings: the chance that i wins a round against j is the logistic of the difference of strengths.

    Maximum likelihood by iterative Luce spectral ranking (Maystre and Grossglauser 2015), after one more player, whose
    strength is free, has drawn `prior_rounds` rounds with everybody. That half a win and half a defeat keeps the rating
    finite of somebody who won or lost everything, or who has no decided round (the interval says so), treats winners
    and losers alike, and is little beside the hundreds of rounds that are usual here. The intervals are those of the
    observed information; they hold if strength is one number. `goodness_of_fit` says whether it is.

    Args:
        wins: (k, k) how many rounds the member of the row won against that of the column; not all need to have met.
        reference: whose rating is 0.

    Raises:
        ValueError: wins are not counts, or `prior_rounds` is 0 and somebody cannot be compared with the reference, not
            even by way of others.
    """
    check_arrays(wins=(np.asarray(wins), "k k"))
    check_numbers(0.0, prior_rounds=prior_rounds)
    wins, k = np.array(wins, dtype=np.float64), len(wins)
    if not np.isfinite(wins).all() or (wins < 0).any():
        raise ValueError(f"wins = {wins[~(wins >= 0) | np.isinf(wins)][0]:g} must be counts of at least 0")
    if not isinstance(reference, Integral) or not -k <= reference < k:
        raise ValueError(f"reference = {reference!r} must be the place of one of {k} members")
    np.fill_diagonal(wins, 0.0)  # whoever plays himself learns nothing about his strength
    everybody = wins
    if prior_rounds:
        everybody = np.pad(wins, (0, 1), constant_values=prior_rounds / 2)
        everybody[k, k] = 0.0
    component = connected_components(everybody, directed=False)[1]
    if (apart := np.flatnonzero(component != component[reference])).size:
        raise ValueError(f"members {apart.tolist()} have no decided round that leads to member {reference}")
    strength = choix.ilsr_pairwise_dense(everybody, max_iter=100_000, tol=1e-11)
    rounds, chance = everybody + everybody.T, _logistic(strength)
    information = np.diag((rounds * chance * (1 - chance)).sum(axis=1)) - rounds * chance * (1 - chance)
    others = np.delete(np.arange(len(strength)), reference)
    error = np.zeros(len(strength))  # of the difference to the reference: with that one held, the rest is regular
    error[others] = np.sqrt(np.diag(np.linalg.inv(information[np.ix_(others, others)])))
    rating = ELO * (strength - strength[reference])[:k]
    half = ELO * CONFIDENT * error[:k]
    return Ratings(rating, rating - half, rating + half)


def rating_differences(
    members: Sequence[PlayerId], wins: np.ndarray, over: PlayerId
) -> dict[PlayerId, RatingDifference]:
    """How far everybody is rated above `over`; see `bradley_terry`."""
    check_arrays(wins=(wins, f"{len(members)} {len(members)}"))
    if over not in members:
        raise ValueError(f"over = {over!r} must be one of {', '.join(map(str, members))}")
    rated = np.stack(bradley_terry(wins, list(members).index(over)), axis=1)
    return {member: RatingDifference(*row) for member, row in zip(members, rated.tolist(), strict=True)}


def goodness_of_fit(wins: np.ndarray, rating: np.ndarray) -> GoodnessOfFit:
    """How far the win rates are from those that the ratings (k,) foretell; see `GoodnessOfFit`."""
    check_arrays(wins=(wins, "k k"), rating=(np.asarray(rating), "k"))
    rows, columns = np.triu_indices(len(wins), 1)
    rounds, chance = (wins + wins.T)[rows, columns], _logistic(np.asarray(rating) / ELO)[rows, columns]
    freedom = np.count_nonzero(rounds) - (len(wins) - 1)
    if freedom < 1:
        return GoodnessOfFit(float("nan"), float("nan"))
    squares = (wins[rows, columns] - rounds * chance) ** 2 / np.maximum(rounds * chance * (1 - chance), 1e-12)
    chi2 = squares[rounds > 0].sum()
    return GoodnessOfFit(float(chi2 / freedom), float(stats.chi2.sf(chi2, freedom)))


def _logistic(strength: np.ndarray) -> np.ndarray:
    """(k, k): the chance that the row wins against the column."""
    return 1 / (1 + np.exp(strength[None, :] - strength[:, None]))


def ratings_of_matches(matches: pd.DataFrame, reference: PlayerId | None = None) -> pd.DataFrame:
    """Rate everybody who occurs in `matches` (see `MATCHES`), generations and anchors.

    Args:
        reference: whose rating is 0; the oldest generation unless given.

    Returns:
        Columns member, rating, low, high: the generations in their order, then the anchors by name.

    Raises:
        ValueError: there are no matches, or not enough to compare everybody; see `bradley_terry`.
    """
    members, wins = wins_of_matches(matches)
    if not members:
        raise ValueError("no matches to rate")
    place = members.index(members[0] if reference is None else reference)
    return pd.DataFrame({"member": pd.Series(members, dtype=object), **bradley_terry(wins, place)._asdict()})


def wins_of_matches(matches: pd.DataFrame) -> tuple[list[PlayerId], np.ndarray]:
    """Who occurs in `matches`, generations in order before anchors by name, and how many rounds each won, (k, k)."""
    seen = {*matches["generation"], *matches["opponent"]}
    members = [*sorted(int(m) for m in seen if not isinstance(m, str)), *sorted(m for m in seen if isinstance(m, str))]
    place = {member: i for i, member in enumerate(members)}
    wins = np.zeros((len(members), len(members)), dtype=np.int64)
    for generation, opponent, won, lost, _ in matches[list(MATCHES)].itertuples(index=False):
        wins[place[generation], place[opponent]] += won
        wins[place[opponent], place[generation]] += lost
    return members, wins


def read_matches(path: Path | str) -> pd.DataFrame:
    """Read a matches.csv: columns `MATCHES`; an opponent is a generation's number or an anchor's name.

    Raises:
        ValueError: the file is missing, has other columns, or holds something else than counts of at least 0.
    """
    try:
        matches = pd.read_csv(path, dtype={"opponent": "str"})
    except FileNotFoundError:
        raise ValueError(f"no such file: {path}") from None
    except ValueError as error:  # pandas' parser errors are ValueErrors, and do not name the file
        raise ValueError(f"{path}: {error}") from error
    if tuple(matches.columns) != MATCHES:
        raise ValueError(f"{path} has the columns {', '.join(map(str, matches.columns))}, not {', '.join(MATCHES)}")
    for column in MATCHES:
        counts = matches[column]
        if column == "opponent":
            wrong = counts.isna()
        else:
            wrong = pd.to_numeric(counts, errors="coerce").mod(1).ne(0) | pd.to_numeric(counts, errors="coerce").lt(0)
        if wrong.any():
            allowed = "a generation or an anchor" if column == "opponent" else "a whole number of at least 0"
            raise ValueError(f"{path}, row {wrong.idxmax() + 1}: {column} = {counts[wrong.idxmax()]} must be {allowed}")
    matches["opponent"] = pd.Series([int(m) if m.isdigit() else m for m in matches["opponent"]], dtype=object)
    counts = [column for column in MATCHES if column != "opponent"]
    return matches.astype({column: np.int64 for column in counts})
