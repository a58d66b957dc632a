"""The four objective metrics of section 4.3, kept tick by tick for many games at once.

Rules where the paper is silent:

Mean smash speed: the puck's speed, in m/s, as it crosses the half-way line after the user's was the last touch.
Defense rate: a shot is a puck whose path, carried on with its present velocity over the side walls, ends in the
  user's goal. It is blocked when the user touches it and it then no longer does, conceded when it scores; one that
  goes astray by itself (a post, a new serve) was none. Undefined without a shot.
Mean disagreement: over every tick with a force to disagree with, in N; a hand that does not move does not disagree.
Win rate: of the rounds that somebody won.
"""

from math import hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.puck_path import BLOCKED, NO_OUTCOME, heads_for_goal, shot_outcome
from airhockey_marl.experiment.validation import check_arrays, check_counts, check_rows, kind_of

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


def new_counters(n: int) -> np.ndarray:
    """Blank sheets for n games: (n,) of `METRIC_COUNTERS`."""
    check_counts(n=n)
    return np.zeros(n, dtype=METRIC_COUNTERS)


def disagreement(force: np.ndarray, action_change: np.ndarray) -> np.ndarray:
    """Disagreement (...) in N of forces (..., 2) with the action's change in the tick after them (section 4.3).

    The force's component against the motion; 0 where the hand does not move or moves with the force.
    """
    check_arrays(force=(force, "... 2"), action_change=(action_change, "... 2"))
    distance = np.hypot(action_change[..., 0], action_change[..., 1])
    along = (force * action_change).sum(-1)
    return np.where(along < 0, -along / np.where(distance > 0, distance, 1.0), 0.0)


@njit(cache=True)
def _record_tick(sheet, before, after, by_user, by_opponent, served, goal, table):
    if by_user:
        sheet.users_puck = True
    elif by_opponent:
        sheet.users_puck = False
    if sheet.users_puck and before[0] <= 0.0 < after[0] and not served:
        sheet.smashes += 1
        sheet.smash_speed += hypot(after[2], after[3])

    threat = not served and goal == 0 and heads_for_goal(after[0], after[1], after[2], after[3], table)
    outcome = shot_outcome(sheet.under_fire, threat, by_user, served, goal)
    sheet.shots += outcome != NO_OUTCOME  # a goal conceded was a shot, whether it was foreseen or not
    sheet.blocked += outcome == BLOCKED
    sheet.under_fire = threat
    if served or goal != 0:
        sheet.users_puck = False
    sheet.won += goal > 0
    sheet.lost += goal < 0
    sheet.ticks += 1


@njit(cache=True)
def record(sheets, games, before, after, touched, served, goals, disagreed, table):
    """Enter one tick of play into the sheets of some games.

    Args:
        sheets: (n,) `METRIC_COUNTERS`.
        games: (k,) int64, those that are scored.
        before, after: (n, 4) the puck (x, y, vx, vy) around the tick, the user's goal at x = -length / 2.
        touched: (n,) bits: 1 the user, 2 the opponent.
        served: (n,) bool, the puck was served anew.
        goals: (n,) +1 scored, -1 conceded.
        disagreed: (n,) the tick's disagreement in N.
        table: the `Table` played on.
    """
    for i in games:
        by_user, by_opponent = (touched[i] & 1) != 0, (touched[i] & 2) != 0
        _record_tick(sheets[i], before[i], after[i], by_user, by_opponent, served[i], goals[i], table)
        sheets[i].disagreement += disagreed[i]


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.full(len(whole), np.nan), where=whole > 0)


def metric_values(sheets: np.ndarray) -> dict[str, np.ndarray]:
    """The four metrics of each game, (n,) each; not a number where a game gave nothing to measure."""
    if sheets.dtype != METRIC_COUNTERS or sheets.ndim != 1:
        raise ValueError(f"sheets: {kind_of(sheets)}, must be GAME_SHEET of shape (n,)")
    return {
        "win_rate": _ratio(sheets["won"], sheets["won"] + sheets["lost"]),
        "mean_smash_speed": _ratio(sheets["smash_speed"], sheets["smashes"]),
        "defense_rate": _ratio(sheets["blocked"], sheets["shots"]),
        "mean_disagreement": _ratio(sheets["disagreement"], sheets["ticks"]),
    }


@njit(cache=True)
def _add(games, values, count, mean, squares):
    for k in range(len(games)):
        i, value = games[k], values[k]
        if value == value:
            count[i] += 1
            change = value - mean[i]
            mean[i] += change / count[i]
            squares[i] += change * (value - mean[i])


class RunningMoments:
    """Running mean and standard deviation of a weight within each game (Welford), in memory flat in its length."""

    def __init__(self, n: int) -> None:
        check_counts(n=n)
        self.count, self.mean, self._squares = np.zeros(n), np.zeros(n), np.zeros(n)

    def add(self, games: np.ndarray, values: np.ndarray) -> None:
        """Add values (k,) of some games (k,), leaving out what is not a number."""
        check_rows("games", games, len(self.count))
        if np.shape(values) != games.shape or values.dtype.kind != "f":
            raise ValueError(f"values: {kind_of(values)}, must be floats of shape {games.shape}")
        _add(games, values, self.count, self.mean, self._squares)

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and population SD (n,) of each game; not a number where nothing was added."""
        return _ratio(self.mean * self.count, self.count), np.sqrt(_ratio(self._squares, self.count))
