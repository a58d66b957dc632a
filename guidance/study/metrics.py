"""The four objective metrics of section 4.3, accumulated tick by tick for many games at once.

Definitions where the paper leaves them open:

Mean smash speed: the puck's speed, in m/s, as it crosses the half-way line after the user touched it last.
Defense rate: a shot is a puck whose path, extrapolated with its present velocity and reflected by the side walls, ends
  in the user's goal. It is blocked if the user touches it and its path then no longer ends there, conceded if it
  scores; one that misses otherwise (a post, a new serve) does not count. Undefined without a shot.
Mean disagreement: over every scored tick, in N; 0 where the hand does not move.
Win rate: share of the decided rounds.
"""

from collections.abc import Callable
from math import hypot
from typing import Any, Protocol

import numpy as np
from numba import njit

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.puck_path import BLOCKED, NO_OUTCOME, heads_for_goal, shot_outcome
from airhockey_marl.experiment.registry import Registry

EXTRA_METRICS: Registry[Callable[[int, TableSpec], "ExtraMetric"]] = Registry("metric")
"""Metrics of plug-ins, measured beside the paper's four: called with the number of games and the table."""


class ExtraMetric(Protocol):
    """A metric that accumulates over the scored ticks of n games."""

    label: str
    unit: str

    def add(self, tick: Any) -> None:
        """Add a tick, see `guidance.study.games.GameStep`."""
        ...

    def values(self) -> np.ndarray:
        """The metric of each game (n,) float; NaN where it is undefined."""
        ...


METRIC_COUNTERS = np.dtype(
    [
        ("won", np.int64),
        ("lost", np.int64),
        ("smashes", np.int64),
        ("smash_speed", np.float64),  # sum, m/s
        ("shots", np.int64),  # decided ones
        ("blocked", np.int64),
        ("ticks", np.int64),
        ("disagreement", np.float64),  # sum, N
        ("users_puck", np.bool_),  # the user touched it last
        ("under_fire", np.bool_),  # a shot is on its way
    ]
)


COUNTS = ("rounds_won", "rounds_lost", "rounds_undecided", "shots_faced", "shots_stopped", "smashes")


def disagreement(force: np.ndarray, action_change: np.ndarray) -> np.ndarray:
    """Disagreement (...) in N of forces (..., 2) with the change of action (..., 2) in the same tick (section 4.3).

    The force's component against the motion; 0 where the hand does not move or moves with the force.
    """
    distance = np.hypot(action_change[..., 0], action_change[..., 1])
    along = (force * action_change).sum(-1)
    return np.where(along < 0, -along / np.where(distance > 0, distance, 1.0), 0.0)


@njit(cache=True)
def _record_tick(counter, before, after, by_user, by_opponent, served, goal, table):
    if by_user:
        counter.users_puck = True
    elif by_opponent:
        counter.users_puck = False
    if counter.users_puck and before[0] <= 0.0 < after[0] and not served:
        counter.smashes += 1
        counter.smash_speed += hypot(after[2], after[3])

    threat = not served and goal == 0 and heads_for_goal(after[0], after[1], after[2], after[3], table)
    outcome = shot_outcome(counter.under_fire, threat, by_user, served, goal)
    counter.shots += outcome != NO_OUTCOME  # a conceded goal was a shot, whether it was foreseen or not
    counter.blocked += outcome == BLOCKED
    counter.under_fire = threat
    if served or goal != 0:
        counter.users_puck = False
    counter.won += goal > 0
    counter.lost += goal < 0
    counter.ticks += 1


@njit(cache=True)
def record(counters, games, before, after, touched, served, goals, conflict, table):
    """Add one tick of play to the counters of some games.

    Args:
        counters: (n,) `METRIC_COUNTERS`.
        games: (k,) int64, the scored games.
        before, after: (n, 4) the puck (x, y, vx, vy) around the tick, with the user's goal at x = -length / 2.
        touched: (n,) bits: 1 touched by the user, 2 by the opponent.
        served: (n,) bool, a new serve.
        goals: (n,) +1 scored, -1 conceded.
        conflict: (n,) the disagreement of the tick in N.
        table: the `TableSpec` of the tables.
    """
    for i in games:
        by_user, by_opponent = (touched[i] & 1) != 0, (touched[i] & 2) != 0
        _record_tick(counters[i], before[i], after[i], by_user, by_opponent, served[i], goals[i], table)
        counters[i].disagreement += conflict[i]


def _ratio(part: np.ndarray, total: np.ndarray) -> np.ndarray:
    return np.divide(part, total, out=np.full(len(total), np.nan), where=total > 0)


def metric_values(counters: np.ndarray) -> dict[str, np.ndarray]:
    """The four metrics (n,) of n games; NaN where one is undefined."""
    return {
        "win_rate": _ratio(counters["won"], counters["won"] + counters["lost"]),
        "mean_smash_speed": _ratio(counters["smash_speed"], counters["smashes"]),
        "defense_rate": _ratio(counters["blocked"], counters["shots"]),
        "mean_disagreement": _ratio(counters["disagreement"], counters["ticks"]),
    }


def count_values(counters: np.ndarray, rounds: np.ndarray) -> dict[str, np.ndarray]:
    """What win and defense rate are ratios of, and the smashes: `COUNTS` (n,) int64 of n games.

    Args:
        rounds: (n,) the rounds that were played.
    """
    won, lost = counters["won"], counters["lost"]
    columns = won, lost, np.asarray(rounds, dtype=np.int64) - won - lost
    return dict(zip(COUNTS, (*columns, counters["shots"], counters["blocked"], counters["smashes"]), strict=True))


class RunningMoments:
    """Running mean and standard deviation of a value within each of n games (Welford), in constant memory."""

    def __init__(self, n: int) -> None:
        self.count, self.mean, self._squares = np.zeros(n), np.zeros(n), np.zeros(n)

    def add(self, games: np.ndarray, values: np.ndarray) -> None:
        """Add values (k,) of games (k,), each at most once, skipping NaN."""
        known = ~np.isnan(values)
        games, values = games[known], values[known]
        self.count[games] += 1
        change = values - self.mean[games]
        self.mean[games] += change / self.count[games]
        self._squares[games] += change * (values - self.mean[games])

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and population SD (n,) of each game; NaN where nothing was added."""
        return _ratio(self.mean * self.count, self.count), np.sqrt(_ratio(self._squares, self.count))
