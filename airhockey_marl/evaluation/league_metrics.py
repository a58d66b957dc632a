"""What there is to find out about a league: who beats whom, ratings, saves, and whether the STD means anything."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from airhockey_marl.evaluation.matches import FRAME_SKIP, MatchResult
from airhockey_marl.evaluation.policy_std import record, smoothness, std_by_situation, std_map
from airhockey_marl.evaluation.ratings import (
    MATCHES,
    GoodnessOfFit,
    Proportion,
    RatingDifference,
    bradley_terry,
    goodness_of_fit,
    payoff,
    play_pairs,
    rating_differences,
    ratings_of_matches,
    wins_of_matches,
)
from airhockey_marl.evaluation.saves import count_saves
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.players import Player, stochastic
from airhockey_marl.players.scripted import REFERENCE_PLAYERS

MILESTONES = (0, 25, 50)  # the last generation is measured against these; in shorter leagues against its quarters
LATER_THAN, BELOW = 20, 10  # no generation after 20 should be rated below generation 10
ATTACKER, KEEPER = "striker", "defender"  # who shoots at the last generation, and who is asked for the same saves
OTHER_ROUNDS = 1_000_000  # between the seeds of the matrix and of the rest


@dataclass(frozen=True)
class EvaluationBudget:
    """How much is played for a report.

    Attributes:
        every: every so many generations are in the payoff matrix, beside the milestones, the last and the anchors.
        rounds: between each two of the matrix.
        match_rounds: of the last generation against each milestone and the strongest anchor.
        save_tables: where saves are counted, 30 s at each, for either keeper.
        std_tables, std_seconds: of play in which the STD is measured.
    """

    every: int
    rounds: int
    match_rounds: int
    save_tables: int
    std_tables: int
    std_seconds: float


class Regressions(NamedTuple):
    """Generations after `LATER_THAN` rated below `BELOW`.

    Attributes:
        below: each with how far it is above, which is less than nothing.
        of: how many generations after `LATER_THAN` are rated.
    """

    below: dict[int, RatingDifference]
    of: int

    @property
    def clear(self) -> list[int]:
        """Those for which the interval of the difference says so too."""
        return [member for member, gain in self.below.items() if gain.high < 0]


@dataclass(frozen=True)
class LeagueMetrics:
    """What was measured. Shares carry 95 % intervals, ratings are in Elo points above generation 0.

    Attributes:
        members, score: of the payoff matrix, (k, k, 3); see `ratings.payoff`.
        ratings: from the matrix; columns member, rating, low, high.
        misfit: of these ratings to the matrix.
        middle, growth: the generation of the matrix in the middle of the league, and how far the last is above it.
        above_strongest: how far the last is above the strongest anchor.
        kept: ratings from the matches kept during training, or None.
        against: what the last generation wins against each milestone and the strongest anchor.
        strongest: the anchor rated highest in the matrix.
        fallen, kept_fallen: by the ratings from the matrix, and from the matches kept. The matrix is the better judge
            but has not everybody: there all have met the same, whereas in the matches a generation that is a reference
            has met all those after it, the others only references. Unless strength is one number, that makes its
            rating hard to compare.
        saves: save rates of the last generation and of the scripted keeper.
        std, maps: see `std_by_situation.precision` and `std_by_situation.std_map`: for a puck that comes, and for one that goes.
        smoothness: of the last generation and of the strongest anchor, both against the last generation.
        best_response: after so many steps of learning, what it wins against the last generation; None if untried.
    """

    members: list[PlayerId]
    score: np.ndarray
    ratings: pd.DataFrame
    misfit: GoodnessOfFit
    middle: int
    growth: RatingDifference
    above_strongest: RatingDifference
    kept: pd.DataFrame | None
    against: dict[PlayerId, Proportion]
    strongest: str
    fallen: Regressions
    kept_fallen: Regressions | None
    saves: dict[str, Proportion]
    std: pd.DataFrame
    maps: tuple[np.ndarray, np.ndarray]
    smoothness: dict[str, dict[str, float]]
    best_response: list[tuple[int, Proportion]] | None

    @property
    def last(self) -> int:
        """The newest generation."""
        return max(member for member in self.members if not isinstance(member, str))

    def payoff_table(self) -> pd.DataFrame:
        """The matrix as rows member, opponent, won, lost, undecided."""
        rows = [
            (member, opponent, *self.score[row, column].tolist())
            for row, member in enumerate(self.members)
            for column, opponent in enumerate(self.members)
            if row != column
        ]
        return pd.DataFrame(rows, columns=["member", "opponent", *MATCHES[2:]])

    def ratings_table(self) -> pd.DataFrame:
        """All ratings; the column `source` says whether they are from the matrix or from the matches kept."""
        sources = {"payoff": self.ratings, "matches": self.kept}
        return pd.concat([table.assign(source=name) for name, table in sources.items() if table is not None])

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the matrix and the maps; what is not a number is None."""
        without = {"score", "maps"}
        return _plain({name: value for name, value in vars(self).items() if name not in without})


def milestones(last: int) -> list[int]:
    """The generations that the last one is measured against."""
    return list(MILESTONES) if last > MILESTONES[-1] else sorted({0, last // 4, last // 2, 3 * last // 4} - {last})


def members_of_matrix(generations: int, every: int) -> list[PlayerId]:
    """Who is in the payoff matrix of a league of so many generations; see `EvaluationBudget.every`."""
    last = generations - 1
    chosen = {*range(0, generations, every), *milestones(last), last, *([BELOW] if last > LATER_THAN else [])}
    return [*sorted(chosen), *REFERENCE_PLAYERS]


def check(league: League, matches: pd.DataFrame | None) -> None:
    """Refuse what cannot be reported.

    Raises:
        ValueError: the league has fewer than two generations, or `matches` are of members that it does not have.
    """
    if len(league) < 2:
        raise ValueError("a league of one generation has nothing to report, it must have at least 2")
    if matches is not None:
        league.lineup(list({*matches["generation"], *matches["opponent"]}))


def evaluate_league(
    league: League,
    matches: pd.DataFrame | None,
    effort: EvaluationBudget,
    seed: int,
    best_response: Sequence[tuple[int, MatchResult]] | None = None,
    frame_skip: int = FRAME_SKIP,
    progress: Callable[[str, float], None] | None = None,
) -> LeagueMetrics:
    """Play all that the report needs; see `write_report`."""
    check(league, matches)
    tell = progress or (lambda phase, share: None)
    last, members = len(league) - 1, members_of_matrix(len(league), effort.every)
    score = payoff(league, members, effort.rounds, seed, 10, frame_skip, partial(tell, "payoff matrix"))
    wins, place = score[..., 0], {member: i for i, member in enumerate(members)}
    ratings = pd.DataFrame({"member": pd.Series(members, dtype=object), **bradley_terry(wins, 0)._asdict()})
    strongest = max(REFERENCE_PLAYERS, key=lambda name: ratings["rating"][place[name]])
    middle = min((m for m in members if not isinstance(m, str)), key=lambda m: abs(m - last / 2))
    rivals, other = [*milestones(last), strongest], seed + OTHER_ROUNDS
    pairs = [(last, rival) for rival in rivals]
    met = play_pairs(league, pairs, effort.match_rounds, other, 50, frame_skip, partial(tell, "matches"))
    kept = None if matches is None or matches.empty else ratings_of_matches(matches)

    def player(member: PlayerId, stream: int) -> Player:
        return stochastic(league.lineup([member]), torch.Generator().manual_seed(other + stream))

    saves, play = {}, {}
    for done, member in enumerate((last, KEEPER)):
        tell("saves", done / 2)
        counted = count_saves(player(member, 1), player(ATTACKER, 2), effort.save_tables, other, 30.0, frame_skip)
        saves["last" if member == last else member] = Proportion.of(counted.blocked, sum(counted))
    for done, member in enumerate((last, strongest)):
        tell("STD", done / 2)
        its, where = league.lineup([member]), (effort.std_tables, effort.std_seconds)
        play[member] = record(its, player(last, 3), *where, other, frame_skip=frame_skip)
    return LeagueMetrics(
        members=members,
        score=score,
        ratings=ratings,
        misfit=goodness_of_fit(wins, ratings["rating"].to_numpy()),
        middle=middle,
        growth=rating_differences(members, wins, middle)[last],
        above_strongest=rating_differences(members, wins, strongest)[last],
        kept=kept,
        against={rival: Proportion.of(won, won + lost) for rival, (won, lost, _) in zip(rivals, met, strict=True)},
        strongest=strongest,
        fallen=find_regressions(members, wins),
        kept_fallen=None if kept is None else find_regressions(*wins_of_matches(matches)),
        saves=saves,
        std=std_by_situation(play[last], other),
        maps=(std_map(play[last], toward=True), std_map(play[last], toward=False)),
        smoothness={"last" if member == last else member: smoothness(games) for member, games in play.items()},
        best_response=best_response
        and [(steps, Proportion.of(result.won, result.won + result.lost)) for steps, result in best_response],
    )


def find_regressions(members: Sequence[PlayerId], wins: np.ndarray) -> Regressions:
    """The `Regressions` by the ratings of these wins; of nobody if `BELOW` is not among the members."""
    rated = rating_differences(members, wins, BELOW) if BELOW in members else {}
    later = {member: gain for member, gain in rated.items() if not isinstance(member, str) and member > LATER_THAN}
    return Regressions({member: gain for member, gain in later.items() if gain.value < 0}, len(later))


def _plain(value: Any) -> Any:
    """The same without tables, NumPy's types and named tuples; numbers that are none become None."""
    if isinstance(value, pd.DataFrame):
        return _plain(value.to_dict("records"))
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
