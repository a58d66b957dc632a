"""The air hockey table: where the puck and the two paddles go in one tick of 20 ms.

Everything is in SI units. The origin is the table's center, x runs along the table toward the right seat, y to
the left of someone sitting at the left seat. A table's state is `bodies`, a float64 array (3, 4): the rows are
the left paddle, the right paddle and the puck, the columns x, y, vx, vy.

The functions are scalar and compiled with numba; `tables.Tables` calls `step_physics` for each table of a batch, so the single
game and the batch are the same arithmetic, bit for bit.

A tick is a few sub-steps in which every velocity is constant, so each contact's time is a root of a linear or a
quadratic equation: the earliest is found, everything moves to it, it is resolved, and so on. A puck of any speed
therefore meets what is in its way. Physics is symmetric under the half turn that swaps the seats.
"""

from math import hypot, sqrt
from numbers import Integral, Real
from typing import NamedTuple

import numpy as np
from numba import njit

LEFT, RIGHT, PUCK = 0, 1, 2  # rows of `bodies`
X, Y, VX, VY = 0, 1, 2, 3  # columns of `bodies`

TOUCHED_BY = (1, 2)  # bits of a tick's `touched`, by seat

MAX_CONTACTS = 8  # per sub-step; a puck squeezed between paddle and wall rattles for ever
ROUNDING = 1e-9  # m
NO_CONTACT, AT_LEFT, AT_RIGHT, AT_SIDE, AT_END, AT_POST = -1, LEFT, RIGHT, 2, 3, 4

# the error model: no division is checked for zero, and none is by zero
compiled = njit(cache=True, error_model="numpy")
inlined = njit(cache=True, error_model="numpy", inline="always")


class TableSpec(NamedTuple):
    """A table and the limits of what moves on it.

    Sizes, wall and paddle restitution are those of the Robot Air Hockey Challenge (Liu et al. 2021, 2024), whose
    table friction is nearly none. Drag, the paddles' limits and the service are assumptions: with them a hard shot
    takes 0.35 s from paddle to goal, which a person can just answer.
    """

    length: float = 1.948  # m
    width: float = 1.038  # m
    goal: float = 0.25  # m, mouth of each goal
    puck_radius: float = 0.03165  # m
    paddle_radius: float = 0.04815  # m
    wall_restitution: float = 0.7424
    paddle_restitution: float = 0.8
    drag: float = 0.1  # 1/s, air: slows the puck in proportion to its speed
    friction: float = 0.01  # m/s2, about 0.001 g: stops it in the end
    paddle_speed: float = 3.0  # m/s
    paddle_acceleration: float = 60.0  # m/s2
    serve_speed_low: float = 0.4  # m/s
    serve_speed_high: float = 1.2  # m/s
    serve_angle: float = 0.7  # rad, at most, off the table's long axis
    stall_speed: float = 0.05  # m/s: a puck slower than this ...
    stall_seconds: float = 2.0  # s: ... for so long is served again
    possession_seconds: float = 7.0  # s: and so is a puck kept so long in one half (the rule of the USAA)
    tick: float = 0.02  # s, 50 Hz
    substeps: int = 4


# What a table may be at most, in the units of its fields: far beyond any, and far from where numbers overflow or the
# rounding of a length is as large as a puck.
LARGEST = {
    **dict.fromkeys(("length", "width", "goal", "puck_radius", "paddle_radius"), 100.0),
    **dict.fromkeys(("wall_restitution", "paddle_restitution"), 1.0),
    **dict.fromkeys(("drag", "friction", "paddle_speed", "serve_speed_low", "serve_speed_high", "stall_speed"), 1e3),
    "paddle_acceleration": 1e6,
    "serve_angle": 3.15,
    **dict.fromkeys(("stall_seconds", "possession_seconds"), 1e9),
    "tick": 1.0,
    "substeps": 1000,
}


def check_table(table: TableSpec) -> TableSpec:
    """Return `table` if it can be played on.

    Raises:
        ValueError: a size, rate or restitution is out of range; names the field, the value and what is allowed.
    """
    for name, value in table._asdict().items():
        lowest = 0 if name in ("drag", "friction", "serve_speed_low", "serve_angle", "stall_speed") else 1e-9
        number = isinstance(value, Real) and not isinstance(value, bool) and np.isfinite(value)
        if not number or value < lowest:
            raise ValueError(f"table.{name} = {value} must be a number {'of at least' if lowest == 0 else 'above'} 0")
        if value > LARGEST[name]:
            raise ValueError(f"table.{name} = {value} must be at most {LARGEST[name]:g}")
    if not 2 * table.puck_radius < table.goal < table.width:
        raise ValueError(f"table.goal = {table.goal} must be between the puck's diameter and the table's width")
    if table.length <= 4 * table.paddle_radius:
        raise ValueError(f"table.paddle_radius = {table.paddle_radius} must be below a quarter of the table's length")
    if table.width <= 2 * (table.paddle_radius + 2 * table.puck_radius) or table.length <= 2 * table.width / 3:
        raise ValueError(f"table.width = {table.width}, table.length = {table.length}: too small to play on")
    if table.serve_speed_high < table.serve_speed_low:
        raise ValueError(f"table.serve_speed_high = {table.serve_speed_high} is below serve_speed_low")
    if not isinstance(table.substeps, Integral):
        raise ValueError(f"table.substeps = {table.substeps} must be a whole number")
    return table


def action_range(table: TableSpec) -> tuple[np.ndarray, np.ndarray]:
    """Where the left paddle's center can be: the middle of its side, and how far it gets from there (x, y), in m.

    This is the scale of an action: action 0 is the middle, +-1 are the ends (section 3.1). The right seat has the
    same after a half turn.
    """
    half = np.array([table.length / 4 - table.paddle_radius, table.width / 2 - table.paddle_radius])
    return np.array([-table.length / 4, 0.0]), half


@inlined
def clamp(value, low, high):
    return min(max(value, low), high)


@inlined
def _own_half(seat, table):
    """Where a seat's paddle center may be, in m: x from low to high, y up to `side` off the middle."""
    inner, outer = table.paddle_radius, table.length / 2 - table.paddle_radius
    low_x, high_x = (-outer, -inner) if seat == LEFT else (inner, outer)
    return low_x, high_x, table.width / 2 - table.paddle_radius


@compiled
def _drive_paddle(paddle, seat, goal_x, goal_y, dt, table):
    """Give the paddle its velocity for this sub-step: toward the goal, as fast as its two limits allow.

    It brakes in time (v^2 = 2 a d), and its own half's bounds end the motion, so it never leaves them.
    """
    away_x, away_y = goal_x - paddle[X], goal_y - paddle[Y]
    distance = hypot(away_x, away_y)
    speed = min(table.paddle_speed, sqrt(2.0 * table.paddle_acceleration * distance), distance / dt)
    want_x = speed * away_x / distance if distance > 0.0 else 0.0
    want_y = speed * away_y / distance if distance > 0.0 else 0.0
    change_x, change_y = want_x - paddle[VX], want_y - paddle[VY]
    change = hypot(change_x, change_y)
    allowed = table.paddle_acceleration * dt
    if change > allowed:
        change_x *= allowed / change
        change_y *= allowed / change
    velocity_x, velocity_y = paddle[VX] + change_x, paddle[VY] + change_y

    low_x, high_x, side = _own_half(seat, table)
    if not low_x <= paddle[X] + velocity_x * dt <= high_x:
        velocity_x = (clamp(paddle[X] + velocity_x * dt, low_x, high_x) - paddle[X]) / dt
    if not -side <= paddle[Y] + velocity_y * dt <= side:
        velocity_y = (clamp(paddle[Y] + velocity_y * dt, -side, side) - paddle[Y]) / dt
    paddle[VX], paddle[VY] = velocity_x, velocity_y


@inlined
def _time_to_circle(gap_x, gap_y, velocity_x, velocity_y, radius):
    """When a point at `gap` from a circle's center, moving at `velocity` relative to it, meets it; inf if never."""
    closing = gap_x * velocity_x + gap_y * velocity_y
    if closing >= 0.0:
        return np.inf
    outside = gap_x * gap_x + gap_y * gap_y - radius * radius
    if outside <= 0.0:
        return 0.0
    speed2 = velocity_x * velocity_x + velocity_y * velocity_y
    root = closing * closing - speed2 * outside
    if root < 0.0:
        return np.inf
    return outside / (sqrt(root) - closing)  # the smaller root, without cancellation


@compiled
def _out_of_reach(bodies, seconds, table):
    """Whether the puck surely meets nothing for so long: true in most sub-steps, and found without a root.

    It errs toward False, and by more than rounding: |vx| + |vy| counts as a speed, the mouth of a goal as wall.
    """
    puck = bodies[PUCK]
    side, end = table.width / 2 - table.puck_radius, table.length / 2 - table.puck_radius
    clear = abs(puck[X]) + abs(puck[VX]) * seconds < end - ROUNDING
    clear = clear and abs(puck[Y]) + abs(puck[VY]) * seconds < side - ROUNDING
    for seat in (LEFT, RIGHT):
        gap_x, gap_y = puck[X] - bodies[seat, X], puck[Y] - bodies[seat, Y]
        speed = abs(puck[VX] - bodies[seat, VX]) + abs(puck[VY] - bodies[seat, VY])
        near = table.puck_radius + table.paddle_radius + speed * seconds + ROUNDING
        clear = clear and gap_x * gap_x + gap_y * gap_y > near * near
    return clear


@compiled
def _first_contact(bodies, table):
    """The puck's next contact if every velocity stays: (seconds until then, which, y of the post if it is one)."""
    puck = bodies[PUCK]
    soonest, which, post = np.inf, NO_CONTACT, 0.0
    touching = table.puck_radius + table.paddle_radius
    hardest = 0.0
    for seat in (LEFT, RIGHT):
        gap_x, gap_y = puck[X] - bodies[seat, X], puck[Y] - bodies[seat, Y]
        velocity_x, velocity_y = puck[VX] - bodies[seat, VX], puck[VY] - bodies[seat, VY]
        time = _time_to_circle(gap_x, gap_y, velocity_x, velocity_y, touching)
        closing = -(gap_x * velocity_x + gap_y * velocity_y)
        if time < soonest or (time == soonest and closing > hardest):  # of two at once, whichever seat it is
            soonest, which, hardest = time, seat, closing
    if puck[VY] != 0.0:
        room = table.width / 2 - table.puck_radius - (puck[Y] if puck[VY] > 0.0 else -puck[Y])
        time = max(room, 0.0) / abs(puck[VY])
        if time < soonest:
            soonest, which = time, AT_SIDE
    if puck[VX] != 0.0:
        end = table.length / 2
        ahead = puck[X] if puck[VX] > 0.0 else -puck[X]
        time = max(end - table.puck_radius - ahead, 0.0) / abs(puck[VX])
        mouth = abs(puck[Y] + puck[VY] * time) < table.goal / 2
        if time < soonest and not mouth:
            soonest, which = time, AT_END
        post_x = end if puck[VX] > 0.0 else -end
        for post_y in (table.goal / 2, -table.goal / 2):
            time = _time_to_circle(puck[X] - post_x, puck[Y] - post_y, puck[VX], puck[VY], table.puck_radius)
            if time < soonest:
                soonest, which, post = time, AT_POST, post_y
    return soonest, which, post


@inlined
def _bounce(puck, normal_x, normal_y, wall_x, wall_y, restitution):
    """Reflect the puck off something moving at `wall`, whose surface points along the unit `normal`."""
    approach = (puck[VX] - wall_x) * normal_x + (puck[VY] - wall_y) * normal_y
    if approach < 0.0:
        puck[VX] -= (1.0 + restitution) * approach * normal_x
        puck[VY] -= (1.0 + restitution) * approach * normal_y


@compiled
def _resolve(bodies, which, post, table):
    puck = bodies[PUCK]
    if which in (AT_LEFT, AT_RIGHT):
        paddle = bodies[which]
        gap_x, gap_y = puck[X] - paddle[X], puck[Y] - paddle[Y]
        gap = hypot(gap_x, gap_y)
        if gap > 0.0:
            _bounce(puck, gap_x / gap, gap_y / gap, paddle[VX], paddle[VY], table.paddle_restitution)
    elif which == AT_SIDE:
        _bounce(puck, 0.0, -1.0 if puck[VY] > 0.0 else 1.0, 0.0, 0.0, table.wall_restitution)
    elif which == AT_END:
        _bounce(puck, -1.0 if puck[VX] > 0.0 else 1.0, 0.0, 0.0, 0.0, table.wall_restitution)
    else:
        gap_x = puck[X] - (table.length / 2 if puck[VX] > 0.0 else -table.length / 2)
        gap_y = puck[Y] - post
        gap = hypot(gap_x, gap_y)
        _bounce(puck, gap_x / gap, gap_y / gap, 0.0, 0.0, table.wall_restitution)


@compiled
def _keep_on_table(puck, table):
    side, end = table.width / 2 - table.puck_radius, table.length / 2 - table.puck_radius
    puck[Y] = clamp(puck[Y], -side, side)
    if abs(puck[Y]) >= table.goal / 2:
        puck[X] = clamp(puck[X], -end, end)
    elif abs(puck[X]) > end:  # in a goal's mouth: off its posts
        post_x = table.length / 2 if puck[X] > 0.0 else -table.length / 2
        post_y = table.goal / 2 if puck[Y] > 0.0 else -table.goal / 2
        gap_x, gap_y = puck[X] - post_x, puck[Y] - post_y
        gap = hypot(gap_x, gap_y)
        if 0.0 < gap < table.puck_radius:
            puck[X] = post_x + gap_x * table.puck_radius / gap
            puck[Y] = post_y + gap_y * table.puck_radius / gap


@inlined
def _from_paddle_to_puck(bodies, seat):
    """Unit vector and distance from a paddle's center to the puck's; forward where they coincide."""
    gap_x, gap_y = bodies[PUCK, X] - bodies[seat, X], bodies[PUCK, Y] - bodies[seat, Y]
    gap = hypot(gap_x, gap_y)
    if gap == 0.0:
        return (1.0 if seat == LEFT else -1.0), 0.0, 0.0
    return gap_x / gap, gap_y / gap, gap


@compiled
def _separate(bodies, table):
    """Undo the overlap that rounding or a squeeze has left: the puck gives way, and where it cannot the paddles do.

    A paddle that has to give way is stopped along the contact: otherwise one that is held up by a puck against the
    wall would go on striking it at full speed, and shoot it out sideways faster than anything on the table moves.
    """
    puck = bodies[PUCK]
    touching = table.puck_radius + table.paddle_radius
    _keep_on_table(puck, table)
    push_x, push_y = 0.0, 0.0
    for seat in (LEFT, RIGHT):
        toward_x, toward_y, gap = _from_paddle_to_puck(bodies, seat)
        overlap = max(touching - gap, 0.0)
        push_x += overlap * toward_x
        push_y += overlap * toward_y
    if push_x == 0.0 and push_y == 0.0:
        return
    puck[X] += push_x
    puck[Y] += push_y
    _keep_on_table(puck, table)
    for seat in (LEFT, RIGHT):
        toward_x, toward_y, gap = _from_paddle_to_puck(bodies, seat)
        if gap < touching - ROUNDING:
            paddle = bodies[seat]
            low_x, high_x, side = _own_half(seat, table)
            paddle[X] = clamp(puck[X] - touching * toward_x, low_x, high_x)
            paddle[Y] = clamp(puck[Y] - touching * toward_y, -side, side)
            pressing = max(paddle[VX] * toward_x + paddle[VY] * toward_y, 0.0)
            paddle[VX] -= pressing * toward_x
            paddle[VY] -= pressing * toward_y


@inlined
def _advance(bodies, seconds):
    for body in range(3):
        bodies[body, X] += bodies[body, VX] * seconds
        bodies[body, Y] += bodies[body, VY] * seconds


@compiled
def step_physics(bodies, targets, table):
    """Move one table by one tick (`table.tick` seconds), in place.

    Args:
        bodies: (3, 4) the state, see the module's docstring.
        targets: (2, 2) the places each seat wants its paddle at, in m in the table's frame; a target that is not a
            number means stay.
        table: the `TableSpec`.

    Returns:
        goal: +1 if the left seat scored, -1 if the right one did, 0 otherwise. The puck then stays in the goal.
        touched: bits of `TOUCHED_BY`: the seats whose paddle hit the puck.
    """
    dt = table.tick / table.substeps
    end = table.length / 2
    puck = bodies[PUCK]
    touched = 0
    for _ in range(table.substeps):
        for seat in (LEFT, RIGHT):
            goal_x, goal_y = targets[seat, X], targets[seat, Y]
            if not (np.isfinite(goal_x) and np.isfinite(goal_y)):
                goal_x, goal_y = bodies[seat, X], bodies[seat, Y]
            _drive_paddle(bodies[seat], seat, goal_x, goal_y, dt, table)
        speed = hypot(puck[VX], puck[VY])
        if speed > 0.0:
            kept = max(0.0, 1.0 - dt * (table.drag + table.friction / speed))
            puck[VX] *= kept
            puck[VY] *= kept

        if _out_of_reach(bodies, dt, table):
            _advance(bodies, dt)
            continue
        left_over = dt
        for _ in range(MAX_CONTACTS):
            time, which, post = _first_contact(bodies, table)
            if which == NO_CONTACT or time >= left_over:
                _advance(bodies, left_over)
                left_over = 0.0
                break
            _advance(bodies, time)
            left_over -= time
            if abs(puck[X]) > end:
                break
            if which <= AT_RIGHT:
                touched |= 1 << which
            _resolve(bodies, which, post, table)
        if abs(puck[X]) > end:
            return (1 if puck[X] > 0.0 else -1), touched
        if left_over > 0.0:  # squeezed: the paddles finish their way, the puck rides on them
            for seat in (LEFT, RIGHT):
                bodies[seat, X] += bodies[seat, VX] * left_over
                bodies[seat, Y] += bodies[seat, VY] * left_over
        _separate(bodies, table)
    return 0, touched
