"""Strokes: where the hand has to be, and when, to hit, block or get around the puck.

Meters of the table in the person's own frame, seconds. A move is (x, y, vx, vy, seconds): the paddle's position and
velocity at its end, and its duration. `person` is a record of `USER_PARAMETERS`, `arm` one of `ARM_STATE`, `path` the
expected path of the puck (LOOK_AHEAD, 4), `table` the `TableSpec`.
"""

from math import copysign, hypot, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from airhockey_marl.envs.puck_path import shot_direction
from guidance.simulated_users.arm import HAND_REACH, SHORTEST_PLAN, peak_acceleration, plan_start
from guidance.simulated_users.perception import LOOK_AHEAD, LOOK_AHEAD_STEP

DIRECT, BANK_LEFT, BANK_RIGHT = 0, 1, -1  # the side wall that a shot takes; left is y > 0


class Shot(NamedTuple):
    """A shot at the opponent's goal: the puck's speed in m/s, the wall it takes, and the y that it is aimed at in m."""

    speed: float
    wall: int
    target_y: float


@njit(cache=True, inline="always")
def clamp(value, low, high):
    """`value`, limited to [low, high]."""
    return min(max(value, low), high)


@njit(cache=True, inline="always")
def to_hand(x, y, table):
    """The hand's position in m for a paddle at (x, y): the action times the hand's reach."""
    return (
        HAND_REACH * (x + table.length / 4) / (table.length / 4 - table.paddle_radius),
        HAND_REACH * y / (table.width / 2 - table.paddle_radius),
    )


@njit(cache=True, inline="always")
def to_table(hand_x, hand_y, table):
    """The paddle's target position in m for a hand at (hand_x, hand_y)."""
    return (
        hand_x / HAND_REACH * (table.length / 4 - table.paddle_radius) - table.length / 4,
        hand_y / HAND_REACH * (table.width / 2 - table.paddle_radius),
    )


@njit(cache=True, inline="always")
def hand_gain(table):
    """Meters of the hand per meter of the table, x and y."""
    return to_hand(1.0 - table.length / 4, 1.0, table)


@njit(cache=True)
def move_time(person, hand_x, hand_y, x, y, table):
    """Duration of an unhurried move of the hand to a paddle position: sqrt(6 D / a_pref), within bounds."""
    to_x, to_y = to_hand(x, y, table)
    distance = hypot(to_x - hand_x, to_y - hand_y)
    return clamp(sqrt(6.0 * distance / person.preferred_acceleration), person.min_move_time, person.max_move_time)


@njit(cache=True, inline="always")
def guard_x(person, table):
    """X of this person's home position and line of defense."""
    return -table.length / 2 + person.min_guard_distance + person.guard_range * person.guard_depth


@njit(cache=True)
def detour(person, paddle_x, paddle_y, puck_x, puck_y, table):
    """Next position (x, y) on the way behind a puck that has passed, without knocking it into the own goal."""
    clear = table.puck_radius + table.paddle_radius + person.clearance
    back = max(puck_x - 1.6 * clear, -table.length / 2 + table.paddle_radius)
    if paddle_x < puck_x - clear:
        return back, clamp(puck_y, -table.goal / 2, table.goal / 2)
    beside = paddle_y - puck_y
    room = table.width / 2 - table.paddle_radius
    toward = copysign(1.0, beside)
    if abs(puck_y + toward * clear) > room:  # no room between puck and wall: pass on the inside
        toward = -toward
    y = clamp(puck_y + toward * clear, -room, room)
    if beside * toward < 0.7 * clear:
        return max(paddle_x, puck_x + 0.3 * clear), y  # sideways first
    return back, y


@njit(cache=True)
def path_is_clear(start, end, seconds, lag, path, table):
    """Whether the cubic from `start` to `end`, each (x, y, vx, vy), touches the puck nowhere before its end."""
    touching = table.puck_radius + table.paddle_radius
    for part in (0.25, 0.5, 0.7, 0.85):
        rest = 1.0 - part
        near, far = part * part * (3.0 - 2.0 * part), rest * rest * (1.0 + 2.0 * part)
        leave, arrive = part * rest * rest * seconds, -part * part * rest * seconds
        puck = path[int((lag + part * seconds) / LOOK_AHEAD_STEP + 0.5)]
        offset_x = far * start[0] + leave * start[2] + near * end[0] + arrive * end[2] - puck[0]
        offset_y = far * start[1] + leave * start[3] + near * end[1] + arrive * end[3] - puck[1]
        if hypot(offset_x, offset_y) < touching + 0.02 * rest:
            return False
    return True


@njit(cache=True)
def motion_to_table(hand, table):
    """Position and velocity (x, y, vx, vy) of the hand, in meters of the table."""
    gain_x, gain_y = hand_gain(table)
    x, y = to_table(hand[0], hand[1], table)
    return x, y, hand[2] / gain_x, hand[3] / gain_y


@njit(cache=True)
def free_move(person, arm, x, y, path, table):
    """An unhurried move to (x, y), with a detour around a puck that it would knock toward the own goal."""
    lag = person.muscle_lag
    hand = plan_start(arm, person)
    start = motion_to_table(hand, table)
    seconds = move_time(person, hand[0], hand[1], x, y, table)
    behind_paddle = -table.length / 2 < path[0, 0] < start[0]
    if behind_paddle and not path_is_clear(start, (x, y, 0.0, 0.0), seconds, lag, path, table):
        x, y = detour(person, start[0], start[1], path[0, 0], path[0, 1], table)
        seconds = move_time(person, hand[0], hand[1], x, y, table)
    return x, y, 0.0, 0.0, seconds + lag


@njit(cache=True, inline="always")
def contact_geometry(person, puck, shot, table):
    """How to hit a puck (x, y, vx, vy) so that it makes the shot: unit normal x, y and the paddle's speed along it.

    To change the puck's velocity from v to w, the paddle has to touch it along n = (w - v) / |w - v| while moving
    along n at v.n + |w - v| / (1 + e), e the restitution of a paddle.
    """
    x, y, vx, vy = puck[0], puck[1], puck[2], puck[3]
    to_x, to_y = shot_direction(x, y, shot.wall, shot.target_y, table)
    normal_x, normal_y = shot.speed * to_x - vx, shot.speed * to_y - vy
    change = max(hypot(normal_x, normal_y), 1e-6)
    normal_x, normal_y = normal_x / change, normal_y / change
    along = vx * normal_x + vy * normal_y + change / (1.0 + table.paddle_restitution)
    return normal_x, normal_y, clamp(along, -person.max_strike_speed, person.max_strike_speed)


@njit(cache=True)
def find_strike(person, arm, path, shot, earliest, effort, table):
    """The first possible strike that makes the `Shot`.

    It is direct if its way is clear and the hand fast enough, or has a back-swing behind the puck first.

    Args:
        earliest: s, no contact before.
        effort: bound of the hand's acceleration, in preferred accelerations.

    Returns:
        The move, and the seconds until the contact: infinite if no time of the next 1.2 s allows one.
    """
    inner, outer = table.paddle_radius, table.length / 2 - table.paddle_radius
    side = table.width / 2 - table.paddle_radius
    touching = table.puck_radius + table.paddle_radius
    gain_x, gain_y = hand_gain(table)
    limit = effort * person.preferred_acceleration
    lag = person.muscle_lag
    hand_x, hand_y, hand_v_x, hand_v_y = plan_start(arm, person)
    start = motion_to_table((hand_x, hand_y, hand_v_x, hand_v_y), table)
    for row in range(LOOK_AHEAD):
        seconds = row * LOOK_AHEAD_STEP
        puck_x, puck_y = path[row, 0], path[row, 1]
        if seconds < earliest or not -table.length / 2 <= puck_x <= 0.0:
            continue
        nx, ny, along = contact_geometry(person, path[row], shot, table)
        # A paddle in motion trails the hand by its braking distance; the hand leads by as much.
        lead = along * abs(along) / (2.0 * table.paddle_acceleration)
        x, y = puck_x - (touching - lead) * nx, puck_y - (touching - lead) * ny
        if not (-outer <= x + 0.005 and x - 0.005 <= -inner and abs(y) - 0.005 <= side):
            continue
        goal_x, goal_y = to_hand(x, y, table)
        end_v_x, end_v_y = along * nx * gain_x, along * ny * gain_y
        duration = max(seconds - lag, SHORTEST_PLAN)
        if (
            seconds <= person.direct_strike_horizon
            and peak_acceleration(goal_x - hand_x, goal_y - hand_y, hand_v_x, hand_v_y, end_v_x, end_v_y, duration)
            <= limit
        ):
            end = (x - lead * nx, y - lead * ny, along * nx, along * ny)
            if path_is_clear(start, end, duration, lag, path, table):
                return (x, y, along * nx, along * ny, seconds), seconds
        run_up = 0.5 * person.swing_time * max(along, 0.0) + 0.01
        x, y = clamp(x - run_up * nx, -outer, -inner), clamp(y - run_up * ny, -side, side)
        if move_time(person, arm.estimate_x, arm.estimate_y, x, y, table) + person.swing_time <= seconds:
            duration = max(seconds - person.swing_time - lag, SHORTEST_PLAN)
            if not path_is_clear(start, (x, y, 0.0, 0.0), duration, lag, path, table):
                x, y = detour(person, start[0], start[1], path[0, 0], path[0, 1], table)
            return (x, y, 0.0, 0.0, seconds - person.swing_time), seconds
    return (0.0, 0.0, 0.0, 0.0, 0.0), np.inf


@njit(cache=True)
def blocking_position(person, path, table):
    """Where the puck is expected to cross the own line of defense, limited to the surroundings of the goal's mouth.

    Returns:
        x, y, and the seconds until the puck is there; infinite if it does not come.
    """
    line = guard_x(person, table)
    reach_y = table.goal / 2 + person.goal_margin
    touching = table.puck_radius + table.paddle_radius
    x, y = min(line, max(path[0, 0] - 1.5 * touching, -table.length / 2 + table.paddle_radius)), path[0, 1]
    seconds = np.inf
    for row in range(LOOK_AHEAD):
        if path[row, 2] < 0.0 and path[row, 0] <= x + touching:
            y, seconds = path[row, 1], row * LOOK_AHEAD_STEP
            break
    return x, clamp(y, -reach_y, reach_y), seconds
