"""PROXIES of the four subjective ratings; they are not ratings, and claim orderings at most, never levels.

Eight signals are summed over a game from the force, the private intention, and a shadow arm: the same plan and
the same motor noise, without the force. Each is then scaled by the value it has under an anchor force fixed before
any condition runs, see `anchors.py`.

Why these: agency falls with trajectory error (Zama 2017) and rises with apt assistance (Endo 2020); force magnitude
tracks comfort (Boulay 2026); disagreement-aware help is rated more helpful (Medina 2012, 2015); non-biological
velocity raises interaction force (Maurice 2018).
"""

from math import hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from airhockey_marl.experiment.validation import check_arrays, kind_of
from guidance.simulated_users.force_response import agreement, stiffness_now
from guidance.simulated_users.perception import standard_normal

SIGNALS = ("conflict", "unsupported", "supportive_power", "deviation", "effort", "jerk", "surprise", "hindsight")
# Sums over a game of a person's ticks, and the force expected now.
RATING_SIGNALS = np.dtype(
    [("ticks", np.int64), ("hindsight_ticks", np.int64)]
    + [(name, np.float64) for name in (*SIGNALS, "expected_x", "expected_y")]
)

RATINGS = ("helpfulness", "naturalness", "controllability", "comfort")


@njit(cache=True)
def tally_force(tally, person, mind, arm, shadow, felt, force, last_force, tick):
    """Add one tick to the signals.

    Args:
        tally, person, mind: records of this person.
        arm, shadow: the arm, and the arm as it would be without the force.
        felt: (2,) the force as it is perceived now, that is after the delay of touch, N.
        force, last_force: (2,) the force at the hand in this tick and the one before, N.
        tick: s.
    """
    support, conflict = agreement(person, felt[0], felt[1], mind.goal_x - arm.hand_x, mind.goal_y - arm.hand_y)
    tally.ticks += 1
    tally.conflict += conflict
    tally.unsupported += hypot(felt[0], felt[1]) - support
    tally.supportive_power += max(0.0, force[0] * arm.hand_v_x + force[1] * arm.hand_v_y)
    tally.deviation += hypot(arm.hand_x - shadow.hand_x, arm.hand_y - shadow.hand_y)
    stiffer = stiffness_now(person, mind) - person.stiffness
    tally.effort += arm.effort - shadow.effort + person.stiffening_cost * stiffer
    tally.jerk += ((force[0] - last_force[0]) ** 2 + (force[1] - last_force[1]) ** 2) / tick**2
    off_x, off_y = force[0] - tally.expected_x, force[1] - tally.expected_y
    tally.surprise += hypot(off_x, off_y)
    tally.expected_x += min(tick / person.surprise_memory, 1.0) * off_x
    tally.expected_y += min(tick / person.surprise_memory, 1.0) * off_y


@njit(cache=True)
def tally_hindsight(tally, mind, trail):
    """Add how much nearer the force had the hand to where it turns out to be needed now, m.

    `trail` (4,) is where the hand and its shadow were `hindsight_after` seconds ago.
    """
    tally.hindsight_ticks += 1
    without = hypot(trail[2] - mind.goal_x, trail[3] - mind.goal_y)
    tally.hindsight += without - hypot(trail[0] - mind.goal_x, trail[1] - mind.goal_y)


def signals(tallies: np.ndarray) -> np.ndarray:
    """(n,) tallies -> (n, 8) float64 means per tick in the order of `SIGNALS`.

    N, N, W, m, N, N/s (root mean square), N, m. All are 0 without a force; so is hindsight help, which then
    says nothing.
    """
    if tallies.dtype != RATING_SIGNALS or tallies.ndim != 1:
        raise ValueError(f"tallies: {kind_of(tallies)}, must be TALLY of shape (n,)")
    ticks = np.maximum(tallies["ticks"], 1)
    means = np.stack([tallies[name] / ticks for name in SIGNALS], axis=1)
    means[:, SIGNALS.index("jerk")] = np.sqrt(means[:, SIGNALS.index("jerk")])
    means[:, SIGNALS.index("effort")] = np.maximum(means[:, SIGNALS.index("effort")], 0.0)
    means[:, SIGNALS.index("hindsight")] = tallies["hindsight"] / np.maximum(tallies["hindsight_ticks"], 1)
    return means


def appraisals(scaled: np.ndarray) -> np.ndarray:
    """(n, 8) signals in units of their anchors -> (n, 4) z-scores in the order of `RATINGS`."""
    check_arrays(scaled=(scaled, f"n {len(SIGNALS)}"))
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


def answers(people: np.ndarray, z: np.ndarray, streams: np.ndarray) -> dict[str, np.ndarray]:
    """What people tick on a scale of 1 to 7: clip(round(4 + 1.5 a z + b + noise), 1, 7).

    Args:
        people: (n,) of dtype `PERSON`.
        z: (n, 4) from `appraisals`.
        streams: (n,) uint64, each person's own; not advanced.

    Returns:
        Per rating (n,) float64.
    """
    check_arrays("V", people=(people, "n"))
    check_arrays(z=(z, f"{len(people)} {len(RATINGS)}"))
    check_arrays("u", streams=(streams, f"{len(people)}"))
    rng = streams ^ np.uint64(0x5851F42D4C957F2D)  # not the noise that the next game will use
    noise = _normals(rng, len(RATINGS))
    gain, bias, spread = (people[name][:, None] for name in ("rating_gain", "rating_bias", "rating_noise"))
    points = np.clip(np.round(4.0 + 1.5 * gain * z + bias + spread * noise), 1.0, 7.0)
    return {name: points[:, column] for column, name in enumerate(RATINGS)}


@njit(cache=True)
def _normals(rng, count):
    out = np.empty((len(rng), count))
    for index in range(len(rng)):
        random_unit(rng, index)
        for column in range(count):
            out[index, column] = standard_normal(rng, index)
    return out
