"""Perception: the puck as a person sees it, and its expected path along straight lines that bounce off the walls.

Meters of the table in the person's own frame: x toward the opponent, own goal at x = -length/2. `person` is a record of
`USER_PARAMETERS`, `state` one of `USER_STATE`, `percept` an observation (12,) that is `visual_delay` old.
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
    """A draw from N(0, 1) of the generator `rng[index]`, by Box-Muller; the second normal is discarded."""
    radius = sqrt(-2.0 * log(1.0 - random_unit(rng, index)))
    return radius * cos(2.0 * pi * random_unit(rng, index))


@njit(cache=True)
def update_percept_noise(person, state, rng, index):
    """Draw the errors of perception of the next plan: AR(1) with unit variance."""
    kept = person.noise_autocorrelation
    fresh = sqrt(1.0 - kept * kept)
    state.speed_error = kept * state.speed_error + fresh * standard_normal(rng, index)
    state.heading_error = kept * state.heading_error + fresh * standard_normal(rng, index)
    state.bounce_error = kept * state.bounce_error + fresh * standard_normal(rng, index)


@njit(cache=True)
def perceived_velocity(person, state, vx, vy):
    """The puck's velocity in m/s as it is perceived: speed noise on a logarithmic scale, and heading noise."""
    speed = hypot(vx, vy)
    if speed == 0.0:
        return 0.0, 0.0
    log_speed = (
        log1p(speed * person.degrees_per_meter / person.weber_min_speed) + person.speed_noise * state.speed_error
    )
    ratio = max(person.weber_min_speed * expm1(log_speed) / person.degrees_per_meter, 0.0) / speed
    return rotate(vx * ratio, vy * ratio, person.heading_noise * state.heading_error)


@njit(cache=True)
def puck_jumps(person, percept, previous, tick):
    """Whether velocity or position of the puck jumps between two percepts a tick apart: a contact, or a new puck."""
    change = hypot(percept[PUCK + 2] - previous[PUCK + 2], percept[PUCK + 3] - previous[PUCK + 3])
    jump_x = percept[PUCK] - previous[PUCK] - tick * previous[PUCK + 2]
    jump_y = percept[PUCK + 1] - previous[PUCK + 1] - tick * previous[PUCK + 3]
    return change > person.velocity_jump or hypot(jump_x, jump_y) > person.position_jump


@njit(cache=True)
def predict_puck(person, state, percept, delay, table, path):
    """Write the expected path of the puck into `path`, from now to 1.2 s ahead.

    Args:
        percept: (12,) the observation, `delay` seconds old.
        delay: s.
        table: the `TableSpec`.
        path: (LOOK_AHEAD, 4) x, y, vx, vy; row k is k * LOOK_AHEAD_STEP seconds from now.

    Returns:
        The first row in which the puck is in the person's own goal, or -1. Paddles are not considered.
    """
    x, y = percept[PUCK], percept[PUCK + 1]
    vx, vy = perceived_velocity(person, state, percept[PUCK + 2], percept[PUCK + 3])
    bounces = person.anticipated_bounces if state.anticipates_bounces else 0
    bounce_error = person.bounce_noise * state.bounce_error
    goal_row = -1
    for row in range(LOOK_AHEAD):
        if goal_row < 0:
            seconds = delay if row == 0 else LOOK_AHEAD_STEP
            x, y, vx, vy, bounces, in_goal = step_expected_puck(x, y, vx, vy, seconds, bounces, bounce_error, table)
            if in_goal:
                goal_row = row
        path[row, 0], path[row, 1], path[row, 2], path[row, 3] = x, y, vx, vy
    return goal_row
