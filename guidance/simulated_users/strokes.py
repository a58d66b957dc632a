"""Where the hand has to be, and when, for each thing a person can want to do with the puck.

Meters of the table in the person's own frame, seconds. A move is (x, y, vx, vy, seconds): where the paddle should
be, how fast it should go there, and in how long.
"""

from math import copysign, hypot, sqrt

import numpy as np
from numba import njit

from airhockey_marl.envs.puck_path import shot_direction
from guidance.simulated_users.arm import HAND_REACH, SHORTEST_PLAN, hardest_acceleration, start_of_plan
from guidance.simulated_users.perception import LOOK_AHEAD, LOOK_AHEAD_STEP

DIRECT, BANK_LEFT, BANK_RIGHT = 0, 1, -1  # which side wall a shot takes; left is y > 0


@njit(cache=True, inline="always")
def clamp(value, low, high):
    """`value`, or the nearer of the two ends."""
    return min(max(value, low), high)


@njit(cache=True, inline="always")
def to_hand(x, y, table):
    """Where the hand is in m for a paddle at (x, y): the action, times the hand's reach."""
    return (
        HAND_REACH * (x + table.length / 4) / (table.length / 4 - table.paddle_radius),
        HAND_REACH * y / (table.width / 2 - table.paddle_radius),
    )


@njit(cache=True, inline="always")
def to_table(hand_x, hand_y, table):
    """Where the paddle is wanted, in m, for a hand at (hand_x, hand_y)."""
    return (
        hand_x / HAND_REACH * (table.length / 4 - table.paddle_radius) - table.length / 4,
        hand_y / HAND_REACH * (table.width / 2 - table.paddle_radius),
    )


@njit(cache=True)
def move_seconds(person, hand_x, hand_y, x, y, table):
    """How long the hand takes to a place that does not run away: sqrt(6 D / a_pref), within bounds."""
    to_x, to_y = to_hand(x, y, table)
    distance = hypot(to_x - hand_x, to_y - hand_y)
    return clamp(sqrt(6.0 * distance / person.preferred_acceleration), person.quickest_move, person.slowest_move)


@njit(cache=True, inline="always")
def guard_x(person, table):
    """The x of this person's home and line of defense."""
    return -table.length / 2 + person.guard_nearest + person.guard_range * person.guard_depth


@njit(cache=True)
def go_around(person, paddle_x, paddle_y, puck_x, puck_y, table):
    """The next place on the way back behind a puck that has passed, without knocking it into the own goal."""
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
def reaches_cleanly(from_x, from_y, from_vx, from_vy, x, y, vx, vy, seconds, lag, path, table):
    """Whether the cubic way to (x, y) touches the puck nowhere before its end."""
    touching = table.puck_radius + table.paddle_radius
    for part in (0.25, 0.5, 0.7, 0.85):
        rest = 1.0 - part
        near, far = part * part * (3.0 - 2.0 * part), rest * rest * (1.0 + 2.0 * part)
        leave, arrive = part * rest * rest * seconds, -part * part * rest * seconds
        puck = path[int((lag + part * seconds) / LOOK_AHEAD_STEP + 0.5)]
        away_x = far * from_x + leave * from_vx + near * x + arrive * vx - puck[0]
        away_y = far * from_y + leave * from_vy + near * y + arrive * vy - puck[1]
        if hypot(away_x, away_y) < touching + 0.02 * rest:
            return False
    return True


@njit(cache=True)
def unhurried(person, arm, x, y, path, table):
    """A move to a place that does not run away, around a puck that would be knocked toward the own goal on the way."""
    lag = person.muscle_lag
    hand_x, hand_y, hand_v_x, hand_v_y = start_of_plan(arm, person)
    gain_x, gain_y = to_hand(1.0 - table.length / 4, 1.0, table)
    from_x, from_y = to_table(hand_x, hand_y, table)
    seconds = move_seconds(person, hand_x, hand_y, x, y, table)
    if -table.length / 2 < path[0, 0] < from_x and not reaches_cleanly(
        from_x, from_y, hand_v_x / gain_x, hand_v_y / gain_y, x, y, 0.0, 0.0, seconds, lag, path, table
    ):
        x, y = go_around(person, from_x, from_y, path[0, 0], path[0, 1], table)
        seconds = move_seconds(person, hand_x, hand_y, x, y, table)
    return x, y, 0.0, 0.0, seconds + lag


@njit(cache=True, inline="always")
def contact_geometry(person, x, y, vx, vy, speed, wall, aim_y, table):
    """How to hit a puck at (x, y) so that it leaves at `speed` toward the goal: the unit normal and the speed along it.

    To change the puck's velocity from v to w, the paddle has to touch it along n = (w - v) / |w - v| while moving
    along n at v.n + |w - v| / (1 + e), e the restitution of a paddle.
    """
    to_x, to_y = shot_direction(x, y, wall, aim_y, table)
    normal_x, normal_y = speed * to_x - vx, speed * to_y - vy
    change = max(hypot(normal_x, normal_y), 1e-6)
    normal_x, normal_y = normal_x / change, normal_y / change
    along = vx * normal_x + vy * normal_y + change / (1.0 + table.paddle_restitution)
    return normal_x, normal_y, clamp(along, -person.fastest_strike, person.fastest_strike)


@njit(cache=True)
def strike(person, arm, path, speed, wall, aim_y, earliest, effort, table):
    """The first way to hit the puck so that it leaves at `speed` m/s toward the goal.

    Either at once, if the way there is free and the hand fast enough, or after a run-up from behind the puck.

    Args:
        person, arm: records; the hand's position and velocity are known to their owner.
        path: (LOOK_AHEAD, 4) where the puck is expected.
        wall: DIRECT, BANK_LEFT or BANK_RIGHT.
        aim_y: m, where in the opponent's goal.
        earliest: s, no contact before.
        effort: the hand's acceleration allowed, in preferred accelerations.
        table: the `Table`.

    Returns:
        The move, and the seconds until the contact: infinite if no time of the next 1.2 s allows it.
    """
    inner, outer = table.paddle_radius, table.length / 2 - table.paddle_radius
    side = table.width / 2 - table.paddle_radius
    touching = table.puck_radius + table.paddle_radius
    gain_x, gain_y = to_hand(1.0 - table.length / 4, 1.0, table)
    limit = effort * person.preferred_acceleration
    lag = person.muscle_lag
    hand_x, hand_y, hand_v_x, hand_v_y = start_of_plan(arm, person)
    from_x, from_y = to_table(hand_x, hand_y, table)
    from_vx, from_vy = hand_v_x / gain_x, hand_v_y / gain_y
    for row in range(LOOK_AHEAD):
        seconds = row * LOOK_AHEAD_STEP
        puck_x, puck_y = path[row, 0], path[row, 1]
        if seconds < earliest or not -table.length / 2 <= puck_x <= 0.0:
            continue
        nx, ny, along = contact_geometry(person, puck_x, puck_y, path[row, 2], path[row, 3], speed, wall, aim_y, table)
        # A paddle in motion trails the hand by its braking distance; the hand leads by as much.
        lead = along * abs(along) / (2.0 * table.paddle_acceleration)
        x, y = puck_x - (touching - lead) * nx, puck_y - (touching - lead) * ny
        if not (-outer <= x + 0.005 and x - 0.005 <= -inner and abs(y) - 0.005 <= side):
            continue
        goal_x, goal_y = to_hand(x, y, table)
        end_v_x, end_v_y = along * nx * gain_x, along * ny * gain_y
        away_x, away_y = goal_x - hand_x, goal_y - hand_y
        way = max(seconds - lag, SHORTEST_PLAN)
        if seconds <= person.at_once and (
            hardest_acceleration(away_x, away_y, hand_v_x, hand_v_y, end_v_x, end_v_y, way) <= limit
            and reaches_cleanly(
                from_x,
                from_y,
                from_vx,
                from_vy,
                x - lead * nx,
                y - lead * ny,
                along * nx,
                along * ny,
                way,
                lag,
                path,
                table,
            )
        ):
            return (x, y, along * nx, along * ny, seconds), seconds
        run_up = 0.5 * person.swing * max(along, 0.0) + 0.01
        x, y = clamp(x - run_up * nx, -outer, -inner), clamp(y - run_up * ny, -side, side)
        if move_seconds(person, arm.sensed_x, arm.sensed_y, x, y, table) + person.swing <= seconds:
            way = max(seconds - person.swing - lag, SHORTEST_PLAN)
            if not reaches_cleanly(from_x, from_y, from_vx, from_vy, x, y, 0.0, 0.0, way, lag, path, table):
                x, y = go_around(person, from_x, from_y, path[0, 0], path[0, 1], table)
            return (x, y, 0.0, 0.0, seconds - person.swing), seconds
    return (0.0, 0.0, 0.0, 0.0, 0.0), np.inf


@njit(cache=True)
def block(person, path, table):
    """Where and when the puck will cross the own line of defense; the paddle stays near the goal's mouth.

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
