"""PROXIES of the four subjective ratings; they are not ratings, and claim orderings at most, never levels.

Signals are summed over a game from the force, the private goal, and a shadow arm: the same plan and the same motor
noise, without the force. A rating is a weighted sum of tanh(signal / unit), between 2 and 6 points, so that no force,
however strong, reaches an end of the scale.

    outcome: by how much the force raised the chance to meet the puck
    force: its size
    support, unsupported: the parts of it that pull toward the own goal, and do not
    deviation: of the hand from its shadow
    jerk: how fast the force changes

Why these: people compare a felt force with the intention that they had when it acted (Blakemore, Wolpert & Frith 2002),
so force and goal are those of the same moment. Assistance is helpful by its outcome (Endo 2020), and less so if it
disagrees (Medina 2012, 2015); agency falls with trajectory error (Zama 2017); force magnitude tracks comfort (Boulay
2026); non-biological motion feels like a disturbance (Maurice 2018).

Why such a mapping: judgments in categories are concave in the magnitude (Stevens & Galanter 1957), relative to the
range of what is judged (Parducci 1965), and logistic in a latent variable (Samejima 1969), as tanh is. The range is
that of forces fixed before any condition runs, see `validation/rating_anchors.py`: the unit of a signal is its size at
their end.
"""

from collections.abc import Mapping
from math import exp, hypot, sqrt

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.force_response import agreement
from guidance.simulated_users.perception import PUCK, standard_normal
from guidance.simulated_users.strokes import clamp, hand_gain, to_table

SIGNALS = ("outcome", "force", "support", "unsupported", "deviation", "jerk")
# Sums over the ticks of a game, of `outcome` over the encounters, and s until another encounter counts.
RATING_SIGNALS = np.dtype(
    [("ticks", np.int64), ("encounters", np.int64)] + [(name, np.float64) for name in (*SIGNALS, "time_to_encounter")]
)

# Weights of the signals; their sum, from its least to its greatest possible value, is spread over the range of points.
WEIGHTS = {
    "helpfulness": {"outcome": 1.5, "support": 0.5, "unsupported": -0.5},
    "naturalness": {"unsupported": -1.0, "jerk": -0.5},
    "controllability": {"deviation": -1.0, "unsupported": -0.5, "support": 0.25},
    "comfort": {"force": -1.0, "jerk": -0.5, "support": 0.5},
}
RATINGS = tuple(WEIGHTS)
SIGNED = "outcome"  # the others are at least 0
LEAST_POINTS, MOST_POINTS = 2.0, 6.0
MEETING_TICKS = 2  # a paddle that is to meet the puck within so many ticks has an encounter


@njit(cache=True)
def add_rating_signals(sums, person, state, arm, shadow, force, last_force, observation, table):
    """Add one tick to the signals, at its beginning.

    Args:
        sums: record of `RATING_SIGNALS`.
        person, state: records of `USER_PARAMETERS` and `USER_STATE`.
        arm, shadow: the arm, and the arm as it would be without the force.
        force, last_force: (2,) N, the force at the hand in this tick and the one before.
        observation: (12,) the table.
        table: the `TableSpec`.
    """
    size = hypot(force[0], force[1])
    support, _ = agreement(person, force[0], force[1], state.goal_x - arm.hand_x, state.goal_y - arm.hand_y)
    sums.ticks += 1
    sums.force += size
    sums.support += support
    sums.unsupported += size - support
    sums.deviation += hypot(arm.hand_x - shadow.hand_x, arm.hand_y - shadow.hand_y)
    sums.jerk += ((force[0] - last_force[0]) ** 2 + (force[1] - last_force[1]) ** 2) / table.tick**2
    sums.time_to_encounter -= table.tick
    touching = table.puck_radius + table.paddle_radius
    if sums.time_to_encounter <= 0.0 and observation[PUCK] <= touching:  # else beyond reach
        add_outcome(sums, person, arm, shadow, observation[PUCK : PUCK + 4], touching, table)


@njit(cache=True)
def add_outcome(sums, person, arm, shadow, puck, touching, table):
    """Add an encounter with the puck (4,), if one begins: the chance to meet it, less what it were without the force.

    An encounter begins when the paddle of the hand, or that of its shadow, is about to touch the puck.
    """
    seconds, chance = meeting(arm, puck, touching, person.plan_period, table)
    shadow_seconds, shadow_chance = meeting(shadow, puck, touching, person.plan_period, table)
    if 0.0 < min(seconds, shadow_seconds) < MEETING_TICKS * table.tick:
        sums.time_to_encounter = person.plan_period
        sums.encounters += 1
        sums.outcome += chance - shadow_chance


@njit(cache=True)
def meeting(arm, puck, touching, horizon, table):
    """How an arm's paddle will meet the puck if both go on at their velocities.

    The paddle trails the hand by its braking distance. The chance is exp(-(d / D)^2), d the smallest distance of their
    centers within `horizon` and D = `touching` that at which they touch.

    Returns:
        Seconds until they touch (0 if they overlap, infinite if never), and the chance.
    """
    gain_x, gain_y = hand_gain(table)
    x, y = to_table(arm.hand_x, arm.hand_y, table)
    own_vx, own_vy = arm.hand_v_x / gain_x, arm.hand_v_y / gain_y
    lag = hypot(own_vx, own_vy) / (2.0 * table.paddle_acceleration)
    gap_x, gap_y = puck[0] - x + lag * own_vx, puck[1] - y + lag * own_vy
    vx, vy = puck[2] - own_vx, puck[3] - own_vy
    speed2, closing = vx * vx + vy * vy, -(gap_x * vx + gap_y * vy)
    nearest = clamp(closing / max(speed2, 1e-12), 0.0, horizon)
    distance = hypot(gap_x + nearest * vx, gap_y + nearest * vy) / touching
    outside = gap_x * gap_x + gap_y * gap_y - touching * touching
    root, seconds = closing * closing - speed2 * outside, np.inf
    if outside <= 0.0:
        seconds = 0.0
    elif closing > 0.0 and root >= 0.0:
        seconds = outside / (closing + sqrt(root))
    return seconds, exp(-distance * distance)


def signals(sums: np.ndarray) -> np.ndarray:
    """Means (n, 6) float64, in the order of `SIGNALS`, of the sums (n,) of `RATING_SIGNALS`.

    Difference of chances in -1..1, N, N, N, m, N/s (root mean square). All are 0 without a force.
    """
    means = {name: sums[name] / np.maximum(sums["ticks"], 1) for name in SIGNALS}
    means["outcome"] = sums["outcome"] / np.maximum(sums["encounters"], 1)
    means["jerk"] = np.sqrt(means["jerk"])
    return np.stack(list(means.values()), axis=1)


def expected_points(signals: np.ndarray, units: Mapping[str, float]) -> np.ndarray:
    """Points (..., 4) in 2 to 6, in the order of `RATINGS`, before a person's own use of the scale.

    Args:
        signals: (..., 6) from `signals`.
        units: of each signal the size at the end of the range of the anchor forces.
    """
    effects = {name: np.tanh(signals[..., column] / units[name]) for column, name in enumerate(SIGNALS)}
    points = []
    for weights in WEIGHTS.values():
        least = sum(-abs(weight) if name == SIGNED else min(weight, 0.0) for name, weight in weights.items())
        most = sum(max(weight, 0.0) for weight in weights.values())
        total = sum(weight * effects[name] for name, weight in weights.items())
        points.append(LEAST_POINTS + (MOST_POINTS - LEAST_POINTS) * (total - least) / (most - least))
    return np.stack(points, axis=-1)


def likert_points(people: np.ndarray, expected: np.ndarray, streams: np.ndarray) -> dict[str, np.ndarray]:
    """Ratings on a scale of 1 to 7: clip(round(4 + gain (expected - 4) + bias + noise), 1, 7).

    Args:
        people: (n,) of `USER_PARAMETERS`.
        expected: (n, 4) from `expected_points`.
        streams: (n,) uint64, each person's generator; not advanced.

    Returns:
        Per rating (n,) float64.
    """
    rng = streams ^ np.uint64(0x5851F42D4C957F2D)  # independent of the noise of the next game
    noise = _normals(rng, len(RATINGS))
    gain, bias, sd = (people[name][:, None] for name in ("rating_gain", "rating_bias", "rating_noise"))
    points = np.clip(np.round(4.0 + gain * (expected - 4.0) + bias + sd * noise), 1.0, 7.0)
    return {name: points[:, column] for column, name in enumerate(RATINGS)}


@njit(cache=True)
def _normals(rng, count):
    out = np.empty((len(rng), count))
    for index in range(len(rng)):
        random_unit(rng, index)
        for column in range(count):
            out[index, column] = standard_normal(rng, index)
    return out
