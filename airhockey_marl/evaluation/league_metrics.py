"""The evaluation of a league: payoff matrix, ratings, saves, and the STD of the last generation by situation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.evaluation.matches import RESULT_COLUMNS, MatchResult
from airhockey_marl.evaluation.policy_std import record_trajectories, smoothness, std_by_situation, std_map
from airhockey_marl.evaluation.ratings import (
    GoodnessOfFit,
    Proportion,
    RatingDifference,
    goodness_of_fit,
    payoff,
    play_pairs,
    rating_differences,
    ratings_table,
    wins_of_matches,
)
from airhockey_marl.evaluation.saves import count_saves
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.players import Player, stochastic
from airhockey_marl.players.scripted import REFERENCE_PLAYERS

BENCHMARK_GENERATIONS = (0, 25, 50)  # opponents of the last generation; in shorter leagues its quarters
REGRESSION_FROM, REGRESSION_REFERENCE = 20, 10  # no generation after 20 should be rated below generation 10
ATTACKER, DEFENDER = "striker", "defender"  # shoots at the last generation; the script whose saves are compared
SEED_OFFSET = 1_000_000  # between the seeds of the payoff matrix, one per table, and of everything else
PAYOFF_TABLES, MATCH_TABLES = 10, 50  # at most, for each pair of the payoff matrix and for each match
SAVES_ROUND_SECONDS = 30.0  # s, of play at each table where saves are counted


class RandomStream(IntEnum):
    """The players whose actions have random generators of their own, seeded with seed + `SEED_OFFSET` + stream."""

    DEFENDING = 1
    ATTACKING = 2
    OPPOSING = 3


@dataclass(frozen=True)
class EvaluationConfig:
    """The amount of play for a report, and how it is played.

    Attributes:
        every: of the generations, every so many are in the payoff matrix, beside the benchmark generations, the last
            one and the scripted players.
        rounds: between each two players of the matrix.
        match_rounds: of the last generation against each benchmark generation and the strongest script.
        save_tables: where saves are counted, for `SAVES_ROUND_SECONDS` each, for the last generation and the script.
        std_tables, std_seconds: tables where the STD is measured, and seconds of play at each.
        seed: of all random numbers.
        frame_skip, arm: ticks for which an action is held, and the arm if there is one, as in the league's training.
    """

    every: int
    rounds: int
    match_rounds: int
    save_tables: int
    std_tables: int
    std_seconds: float
    seed: int
    frame_skip: int
    arm: HandArm | None = None

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON and the page; the arm only if there is one."""
        values = asdict(self)
        del values["arm"]
        return values if self.arm is None else values | {"arm": self.arm._asdict()}


class Regressions(NamedTuple):
    """Generations after `REGRESSION_FROM` rated below `REGRESSION_REFERENCE`.

    Attributes:
        below: their rating differences to the reference, all negative.
        total: rated generations after `REGRESSION_FROM`.
    """

    below: dict[int, RatingDifference]
    total: int

    @property
    def significant(self) -> list[int]:
        """Those below the reference by more than the 95 % interval of the difference."""
        return [generation for generation, difference in self.below.items() if difference.high < 0]


@dataclass(frozen=True)
class LeagueMetrics:
    """The metrics of a league. Proportions have 95 % intervals; ratings are in Elo points above generation 0.

    Attributes:
        player_ids, score: of the payoff matrix, (k, k, 3); see `ratings.payoff`.
        ratings: from the matrix; columns member, rating, low, high.
        goodness_of_fit: of these ratings to the matrix.
        midpoint, gain_since_midpoint: the generation in the middle of the league, and the last one's rating above it.
        lead_over_script: the last generation's rating above the strongest script.
        training_ratings: from the matches of the training, or None.
        win_rates: of the last generation against each benchmark generation and the strongest script.
        strongest_script: the scripted player rated highest in the matrix.
        regressions, training_regressions: by the ratings from the matrix, and from the matches of the training. The
            matrix has fewer generations but is fairer: all its players met the same opponents. In training the
            reference opponents met all later generations, the others met the reference opponents only.
        saves: save rates of the last generation and of the scripted defender.
        std, std_maps: see `policy_std.std_by_situation` and `policy_std.std_map`: approaching puck, other puck.
        smoothness: of the last generation and of the strongest script, both against the last generation.
        best_response: the win rate against the last generation after so many steps of training; None if not tried.
    """

    player_ids: list[PlayerId]
    score: np.ndarray
    ratings: pd.DataFrame
    goodness_of_fit: GoodnessOfFit
    midpoint: int
    gain_since_midpoint: RatingDifference
    lead_over_script: RatingDifference
    training_ratings: pd.DataFrame | None
    win_rates: dict[PlayerId, Proportion]
    strongest_script: str
    regressions: Regressions
    training_regressions: Regressions | None
    saves: dict[str, Proportion]
    std: pd.DataFrame
    std_maps: tuple[np.ndarray, np.ndarray]
    smoothness: dict[str, dict[str, float]]
    best_response: list[tuple[int, Proportion]] | None

    @property
    def last(self) -> int:
        return max(generations_of(self.player_ids))

    def payoff_table(self) -> pd.DataFrame:
        """The matrix as rows member, opponent, won, lost, undecided."""
        rows = [
            (player, opponent, *self.score[row, column].tolist())
            for row, player in enumerate(self.player_ids)
            for column, opponent in enumerate(self.player_ids)
            if row != column
        ]
        return pd.DataFrame(rows, columns=["member", "opponent", *RESULT_COLUMNS])

    def ratings_table(self) -> pd.DataFrame:
        """All ratings; the column `source` is "payoff" for the matrix, "matches" for the matches of the training."""
        sources = {"payoff": self.ratings, "matches": self.training_ratings}
        return pd.concat([table.assign(source=name) for name, table in sources.items() if table is not None])

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON, without the matrix and the maps; None in place of NaN and inf."""
        return _json_values({name: value for name, value in vars(self).items() if name not in ("score", "std_maps")})


def generations_of(player_ids: Sequence[PlayerId]) -> list[int]:
    """The generations among some players, without the scripted ones."""
    return [player for player in player_ids if not isinstance(player, str)]


def benchmark_generations(last: int) -> list[int]:
    """The generations that the last one plays for its win rates."""
    if last > BENCHMARK_GENERATIONS[-1]:
        return list(BENCHMARK_GENERATIONS)
    return sorted({0, last // 4, last // 2, 3 * last // 4} - {last})


def payoff_players(generations: int, every: int) -> list[PlayerId]:
    """The players in the payoff matrix of a league with so many generations; see `EvaluationConfig.every`."""
    last = generations - 1
    chosen = {*range(0, generations, every), *benchmark_generations(last), last}
    return [*sorted(chosen | ({REGRESSION_REFERENCE} if last > REGRESSION_FROM else set())), *REFERENCE_PLAYERS]


def check_league(league: League, matches: pd.DataFrame | None) -> None:
    """Raise a ValueError if the league has one generation only, or a player in the matches is not in it."""
    if len(league) < 2:
        raise ValueError("a league of one generation has nothing to report, it must have at least 2")
    if matches is not None:
        league.opponent_batch(list({*matches["generation"], *matches["opponent"]}))


def evaluate_league(
    league: League,
    matches: pd.DataFrame | None,
    config: EvaluationConfig,
    best_response: Sequence[tuple[int, MatchResult]] | None = None,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
) -> LeagueMetrics:
    """Play all that the metrics need, in a league that `check_league` has accepted.

    Args:
        matches: of the training, see `ratings.MATCH_COLUMNS`; None if there are none.
        best_response: results against the last generation after so many steps of training against it only; None if
            not tried.
        progress: called with the phase and the fraction of it that is done.
    """
    training = wins_of_matches(matches) if matches is not None and not matches.empty else None
    last, player_ids, seed = len(league) - 1, payoff_players(len(league), config.every), config.seed + SEED_OFFSET
    as_trained = {"frame_skip": config.frame_skip, "arm": config.arm}
    options = as_trained | {"tables_per_pair": PAYOFF_TABLES, "progress": partial(progress, "payoff matrix")}
    score = payoff(league, player_ids, config.rounds, config.seed, **options)
    wins, ratings = score[..., 0], ratings_table(player_ids, score[..., 0])
    rating_of = dict(zip(player_ids, ratings["rating"], strict=True))
    strongest = max(REFERENCE_PLAYERS, key=lambda name: rating_of[name])
    midpoint = min(generations_of(player_ids), key=lambda generation: abs(generation - last / 2))
    opponents = [*benchmark_generations(last), strongest]
    pairs = [(last, opponent) for opponent in opponents]
    options = as_trained | {"tables_per_pair": MATCH_TABLES, "progress": partial(progress, "matches")}
    results = play_pairs(league, pairs, config.match_rounds, seed, **options)

    def player(player_id: PlayerId, stream: RandomStream) -> Player:
        return stochastic(league.opponent_batch([player_id]), torch.Generator().manual_seed(seed + stream))

    saves, trajectories = {}, {}
    for done, (name, player_id) in enumerate({"last": last, DEFENDER: DEFENDER}.items()):
        progress("saves", done / 2)
        players = player(player_id, RandomStream.DEFENDING), player(ATTACKER, RandomStream.ATTACKING)
        counts = count_saves(*players, config.save_tables, seed, SAVES_ROUND_SECONDS, **as_trained)
        saves[name] = Proportion.from_counts(counts.blocked, sum(counts))
    for done, (name, player_id) in enumerate({"last": last, strongest: strongest}.items()):
        progress("STD", done / 2)
        policy, opponent = league.opponent_batch([player_id]), player(last, RandomStream.OPPOSING)
        sizes = config.std_tables, config.std_seconds
        trajectories[name] = record_trajectories(policy, opponent, *sizes, seed, **as_trained)
    return LeagueMetrics(
        player_ids=player_ids,
        score=score,
        ratings=ratings,
        goodness_of_fit=goodness_of_fit(wins, ratings["rating"].to_numpy()),
        midpoint=midpoint,
        gain_since_midpoint=rating_differences(player_ids, wins, midpoint)[last],
        lead_over_script=rating_differences(player_ids, wins, strongest)[last],
        training_ratings=training and ratings_table(*training),
        win_rates={opponent: _win_rate(*row[:2]) for opponent, row in zip(opponents, results.tolist(), strict=True)},
        strongest_script=strongest,
        regressions=find_regressions(player_ids, wins),
        training_regressions=training and find_regressions(*training),
        saves=saves,
        std=std_by_situation(trajectories["last"], seed),
        std_maps=tuple(std_map(trajectories["last"], approaching) for approaching in (True, False)),
        smoothness={name: smoothness(recorded) for name, recorded in trajectories.items()},
        best_response=best_response
        and [(steps, _win_rate(result.wins, result.losses)) for steps, result in best_response],
    )


def find_regressions(player_ids: Sequence[PlayerId], wins: np.ndarray) -> Regressions:
    """The `Regressions` by the ratings of these wins (k, k); none if the reference is not among the players."""
    if REGRESSION_REFERENCE not in player_ids:
        return Regressions({}, 0)
    differences = rating_differences(player_ids, wins, REGRESSION_REFERENCE)
    later = {g: differences[g] for g in generations_of(player_ids) if g > REGRESSION_FROM}
    return Regressions({g: difference for g, difference in later.items() if difference.value < 0}, len(later))


def _win_rate(wins: int, losses: int) -> Proportion:
    return Proportion.from_counts(wins, wins + losses)


def _json_values(value: Any) -> Any:
    """A value without data frames, NumPy's types and named tuples; None in place of NaN and inf."""
    if isinstance(value, pd.DataFrame):
        return _json_values(value.to_dict("records"))
    if hasattr(value, "_asdict"):
        return _json_values(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _json_values(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_json_values(inner) for inner in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
