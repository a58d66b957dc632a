"""PROXIES of the four subjective ratings; they are not ratings, and claim orderings at most, never levels.

Eight signals are summed over a game from the force, the private intention, and a shadow arm: the same plan and
the same motor noise, without the force. Each is then scaled by its value under an anchor force fixed before any
condition runs, see `validation/rating_anchors.py`.

Why these: agency falls with trajectory error (Zama 2017) and rises with apt assistance (Endo 2020); force magnitude
tracks comfort (Boulay 2026); disagreement-aware help is rated more helpful (Medina 2012, 2015); non-biological
velocity raises interaction force (Maurice 2018).
"""

from math import hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.force_response import agreement, current_stiffness
from guidance.simulated_users.perception import standard_normal

SIGNALS = ("conflict", "unsupported", "supportive_power", "deviation", "effort", "jerk", "surprise", "hindsight")
# Sums over the ticks of a game, and the force expected at present; one record per person.
RATING_SIGNALS = np.dtype(
    [("ticks", np.int64), ("hindsight_ticks", np.int64)]
    + [(name, np.float64) for name in (*SIGNALS, "expected_x", "expected_y")]
)

RATINGS = ("helpfulness", "naturalness", "controllability", "comfort")


@njit(cache=True)
def add_force_signals(sums, person, state, arm, shadow, perceived_force, force, last_force, tick):
    """Add one tick to the signals.

    Args:
        sums: record of `RATING_SIGNALS`.
        person, state: records of `USER_PARAMETERS` and `USER_STATE`.
        arm, shadow: the arm, and the arm as it would be without the force.
        perceived_force: (2,) N, after the tactile delay.
        force, last_force: (2,) N, the force at the hand in this tick and the one before.
        tick: s.
    """
    support, conflict = agreement(
        person, perceived_force[0], perceived_force[1], state.goal_x - arm.hand_x, state.goal_y - arm.hand_y
    )
    sums.ticks += 1
    sums.conflict += conflict
    sums.unsupported += hypot(perceived_force[0], perceived_force[1]) - support
    sums.supportive_power += max(0.0, force[0] * arm.hand_v_x + force[1] * arm.hand_v_y)
    sums.deviation += hypot(arm.hand_x - shadow.hand_x, arm.hand_y - shadow.hand_y)
    extra_stiffness = current_stiffness(person, state) - person.stiffness
    sums.effort += arm.effort - shadow.effort + person.stiffening_cost * extra_stiffness
    sums.jerk += ((force[0] - last_force[0]) ** 2 + (force[1] - last_force[1]) ** 2) / tick**2
    error_x, error_y = force[0] - sums.expected_x, force[1] - sums.expected_y
    sums.surprise += hypot(error_x, error_y)
    sums.expected_x += min(tick / person.surprise_time, 1.0) * error_x
    sums.expected_y += min(tick / person.surprise_time, 1.0) * error_y


@njit(cache=True)
def add_hindsight(sums, state, hands):
    """Add by how much the force had brought the hand nearer to the present goal, m.

    `hands` (4,) are the positions of the hand and of its shadow `hindsight_delay` seconds ago.
    """
    sums.hindsight_ticks += 1
    without = hypot(hands[2] - state.goal_x, hands[3] - state.goal_y)
    sums.hindsight += without - hypot(hands[0] - state.goal_x, hands[1] - state.goal_y)


def signals(sums: np.ndarray) -> np.ndarray:
    """Means per tick (n, 8) float64, in the order of `SIGNALS`, of the sums (n,) of `RATING_SIGNALS`.

    N, N, W, m, N, N/s (root mean square), N, m. All are 0 without a force.
    """
    ticks = np.maximum(sums["ticks"], 1)
    means = np.stack([sums[name] / ticks for name in SIGNALS], axis=1)
    means[:, SIGNALS.index("jerk")] = np.sqrt(means[:, SIGNALS.index("jerk")])
    means[:, SIGNALS.index("effort")] = np.maximum(means[:, SIGNALS.index("effort")], 0.0)
    means[:, SIGNALS.index("hindsight")] = sums["hindsight"] / np.maximum(sums["hindsight_ticks"], 1)
    return means


def rating_z_scores(scaled: np.ndarray) -> np.ndarray:
    """Z-scores (n, 4), in the order of `RATINGS`, of signals (n, 8) in units of their anchors."""
    conflict, unsupported, power, deviation, effort, jerk, surprise, hindsight = scaled.T
    return np.stack(
        [
            -0.5 + 1.5 * hindsight + 0.5 * power - 0.5 * conflict,
            1.0 - unsupported - 0.5 * surprise - 0.5 * jerk,
            1.0 - deviation - 0.5 * conflict + 0.25 * power,
            0.5 - effort - 0.5 * jerk + 0.5 * power,
        ],
        axis=1,
    )


def likert_points(people: np.ndarray, z: np.ndarray, streams: np.ndarray) -> dict[str, np.ndarray]:
    """Ratings on a scale of 1 to 7: clip(round(4 + 1.5 gain z + bias + noise), 1, 7).

    Args:
        people: (n,) of `USER_PARAMETERS`.
        z: (n, 4) from `rating_z_scores`.
        streams: (n,) uint64, each person's generator; not advanced.

    Returns:
        Per rating (n,) float64.
    """
    rng = streams ^ np.uint64(0x5851F42D4C957F2D)  # independent of the noise of the next game
    noise = _normals(rng, len(RATINGS))
    gain, bias, sd = (people[name][:, None] for name in ("rating_gain", "rating_bias", "rating_noise"))
    points = np.clip(np.round(4.0 + 1.5 * gain * z + bias + sd * noise), 1.0, 7.0)
    return {name: points[:, column] for column, name in enumerate(RATINGS)}


@njit(cache=True)
def _normals(rng, count):
    out = np.empty((len(rng), count))
    for index in range(len(rng)):
        random_unit(rng, index)
        for column in range(count):
            out[index, column] = standard_normal(rng, index)
    return out
