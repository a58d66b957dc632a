"""What a person sees, and where they expect the puck: delay, noise, and straight lines with mirrors at the walls.

All lengths here are meters of the table in the person's own frame: x toward the opponent, own goal at x = -length/2.
"""

from math import cos, expm1, hypot, log, log1p, pi, sqrt

from numba import njit

from airhockey_marl.envs.puck_path import rotate, step_expected_puck
from airhockey_marl.envs.world import random_unit

OWN, OTHER, PUCK = 0, 4, 8  # first column of each body in the 12 numbers of a state

LOOK_AHEAD_STEP = 0.025  # s
LOOK_AHEAD = 49  # rows of a path: now, and 1.2 s ahead


@njit(cache=True)
def standard_normal(rng, index):
    """A draw from N(0, 1) of stream `rng[index]`, by Box-Muller; its twin is not kept."""
    radius = sqrt(-2.0 * log(1.0 - random_unit(rng, index)))
    return radius * cos(2.0 * pi * random_unit(rng, index))


@njit(cache=True)
def update_percept_noise(person, mind, rng, index):
    """Move this plan's errors of seeing one step on: AR(1) with unit variance, three draws."""
    kept = person.noise_memory
    fresh = sqrt(1.0 - kept * kept)
    mind.speed_error = kept * mind.speed_error + fresh * standard_normal(rng, index)
    mind.heading_error = kept * mind.heading_error + fresh * standard_normal(rng, index)
    mind.bounce_error = kept * mind.bounce_error + fresh * standard_normal(rng, index)


@njit(cache=True)
def perceived_velocity(person, mind, vx, vy):
    """The puck's velocity in m/s as this person judges it: speed noise on a logarithmic scale, and heading noise."""
    speed = hypot(vx, vy)
    if speed == 0.0:
        return 0.0, 0.0
    judged = log1p(speed * person.degrees_per_meter / person.weber_floor) + person.speed_noise * mind.speed_error
    ratio = max(person.weber_floor * expm1(judged) / person.degrees_per_meter, 0.0) / speed
    return rotate(vx * ratio, vy * ratio, person.heading_noise * mind.heading_error)


@njit(cache=True)
def surprising(person, percept, before, tick):
    """Whether the puck was kicked, or is somewhere else all of a sudden, between two percepts a tick apart."""
    kick = hypot(percept[PUCK + 2] - before[PUCK + 2], percept[PUCK + 3] - before[PUCK + 3])
    leap_x = percept[PUCK] - before[PUCK] - tick * before[PUCK + 2]
    leap_y = percept[PUCK + 1] - before[PUCK + 1] - tick * before[PUCK + 3]
    return kick > person.kick or hypot(leap_x, leap_y) > person.leap


@njit(cache=True)
def predict_puck(person, mind, percept, delay, table, path):
    """Write where the puck is expected, now and 1.2 s ahead, into `path` (LOOK_AHEAD, 4): x, y, vx, vy.

    Args:
        person, mind: records of this person.
        percept: (12,) the state seen, `delay` seconds old.
        delay: s.
        table: the `Table`.
        path: row k is k * LOOK_AHEAD_STEP seconds from now.

    Returns:
        The first row in which the puck is in the person's own goal, or -1. Paddles in the way are not considered.
    """
    x, y = percept[PUCK], percept[PUCK + 1]
    vx, vy = perceived_velocity(person, mind, percept[PUCK + 2], percept[PUCK + 3])
    bounces = person.foreseen_bounces if mind.sees_bounces else 0
    bounce_turn = person.bounce_noise * mind.bounce_error
    scored = -1
    for row in range(LOOK_AHEAD):
        if scored < 0:
            seconds = delay if row == 0 else LOOK_AHEAD_STEP
            x, y, vx, vy, bounces, in_goal = step_expected_puck(x, y, vx, vy, seconds, bounces, bounce_turn, table)
            if in_goal:
                scored = row
        path[row, 0], path[row, 1], path[row, 2], path[row, 3] = x, y, vx, vy
    return scored
