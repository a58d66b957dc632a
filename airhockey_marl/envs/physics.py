"""Event-driven physics of an air hockey table: the motion of the puck and the two paddles in one tick of 20 ms.

Everything is in SI units. The origin is the table's center, x runs along the table toward the right end, y to the
left as seen from the left end. A table's state is `bodies`, a float64 array (3, 4): the rows are the left paddle, the
right paddle and the puck, the columns x, y, vx, vy.

The functions are compiled with numba. `world.World` calls `step_physics` for each table of a batch, so a single table
and a batch are the same arithmetic, bit for bit. `coast` says where tables are going while nobody steers.

A tick is a few sub-steps of constant velocities, so the time of each contact is a root of a linear or quadratic
equation. All bodies move to the earliest contact, it is resolved, and so on: no puck is too fast to meet what is in
its way. The physics is symmetric under the half turn that swaps the agents.
"""

from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from airhockey_marl.experiment.validation import check_counts, check_numbers

LEFT, RIGHT, PUCK = 0, 1, 2  # rows of `bodies`
X, Y, VX, VY = 0, 1, 2, 3  # columns of `bodies`

TOUCHED_BY = (1, 2)  # bits of a tick's `touched`, by agent

MAX_CONTACTS = 8  # per sub-step; a puck squeezed between paddle and wall would bounce without end
ROUNDING = 1e-9  # m
NO_CONTACT, AT_LEFT, AT_RIGHT, AT_SIDE, AT_END, AT_POST = -1, LEFT, RIGHT, 2, 3, 4

# error model of numpy: divisions are not checked for zero, and none is by zero
compiled = njit(cache=True, error_model="numpy")
inlined = njit(cache=True, error_model="numpy", inline="always")


class TableSpec(NamedTuple):
    """Sizes of a table, and limits of the bodies on it.

    Sizes and restitutions are those of the Robot Air Hockey Challenge (Liu et al. 2021, 2024), whose table has almost
    no friction. Drag, the paddles' limits and the serve are assumptions: with them a hard shot takes 0.35 s from
    paddle to goal, just enough for a person to react.
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
    stall_speed: float = 0.05  # m/s: a puck slower than this for `stall_seconds` is served again
    stall_seconds: float = 2.0  # s
    possession_seconds: float = 7.0  # s: a puck kept in one half for so long is served again (rule of the USAA)
    tick: float = 0.02  # s, 50 Hz
    substeps: int = 4


# Upper bounds of the fields of `TableSpec`, in their units: far above any real table, and far below where numbers
# overflow or rounding becomes as large as a puck.
MAX_VALUES = {
    **dict.fromkeys(("length", "width", "goal", "puck_radius", "paddle_radius"), 100.0),
    **dict.fromkeys(("wall_restitution", "paddle_restitution"), 1.0),
    **dict.fromkeys(("drag", "friction", "paddle_speed", "serve_speed_low", "serve_speed_high", "stall_speed"), 1e3),
    "paddle_acceleration": 1e6,
    "serve_angle": 3.15,
    **dict.fromkeys(("stall_seconds", "possession_seconds"), 1e9),
    "tick": 1.0,
    "substeps": 1000,
}
MAY_BE_ZERO = ("drag", "friction", "serve_speed_low", "serve_angle", "stall_speed")


def check_table(table: TableSpec) -> TableSpec:
    """Return `table`, or raise a ValueError that names the field with which it cannot be played on."""
    for name, value in table._asdict().items():
        least = 0.0 if name in MAY_BE_ZERO else 1e-9
        check_numbers(least, at_most=MAX_VALUES[name], **{f"table.{name}": value})
    check_counts(**{"table.substeps": table.substeps})
    if not 2 * table.puck_radius < table.goal < table.width:
        raise ValueError(f"table.goal = {table.goal} must be between the puck's diameter and the table's width")
    if table.length <= 4 * table.paddle_radius:
        raise ValueError(f"table.paddle_radius = {table.paddle_radius} must be below a quarter of the table's length")
    if table.width <= 2 * (table.paddle_radius + 2 * table.puck_radius) or table.length <= 2 * table.width / 3:
        raise ValueError(f"table.width = {table.width}, table.length = {table.length}: too small to play on")
    if table.serve_speed_high < table.serve_speed_low:
        raise ValueError(f"table.serve_speed_high = {table.serve_speed_high} is below serve_speed_low")
    return table


def action_range(table: TableSpec) -> tuple[np.ndarray, np.ndarray]:
    """The range of the left paddle's center in m: its midpoint (2,), and the half widths (2,) in x and y.

    This is the scale of an action: 0 is the midpoint, +-1 are the ends (section 3.1). The right agent's range is the
    same after a half turn.
    """
    half = np.array([table.length / 4 - table.paddle_radius, table.width / 2 - table.paddle_radius])
    return np.array([-table.length / 4, 0.0]), half


@inlined
def clamp(value: float, low: float, high: float) -> float:
    """`value`, limited to [low, high]."""
    return min(max(value, low), high)


@inlined
def _own_half(agent, table):
    """Range of an agent's paddle center in m: lowest x, highest x, and largest |y|."""
    inner, outer = table.paddle_radius, table.length / 2 - table.paddle_radius
    low_x, high_x = (-outer, -inner) if agent == LEFT else (inner, outer)
    return low_x, high_x, table.width / 2 - table.paddle_radius


@inlined
def _stop_at_bounds(paddle, agent, velocity_x, velocity_y, dt, table):
    """Set the paddle's velocity for this sub-step: the given one, which ends at the bounds of its own half."""
    low_x, high_x, side = _own_half(agent, table)
    if not low_x <= paddle[X] + velocity_x * dt <= high_x:
        velocity_x = (clamp(paddle[X] + velocity_x * dt, low_x, high_x) - paddle[X]) / dt
    if not -side <= paddle[Y] + velocity_y * dt <= side:
        velocity_y = (clamp(paddle[Y] + velocity_y * dt, -side, side) - paddle[Y]) / dt
    paddle[VX], paddle[VY] = velocity_x, velocity_y


@compiled
def _drive_paddle(paddle, agent, goal_x, goal_y, dt, table):
    """Set the paddle's velocity for this sub-step: toward its goal, as fast as its speed and acceleration allow.

    It brakes in time (v^2 = 2 a d) and stops at the bounds of its own half.
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
    _stop_at_bounds(paddle, agent, paddle[VX] + change_x, paddle[VY] + change_y, dt, table)


@inlined
def _time_to_circle(gap_x, gap_y, velocity_x, velocity_y, radius):
    """Seconds until a point at `gap` from a circle's center, at `velocity` relative to it, meets it; inf if never."""
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
    """Whether the puck certainly has no contact within `seconds`: a cheap test that is true in most sub-steps.

    Conservative, by more than rounding: |vx| + |vy| counts as the speed, and the mouth of a goal as a wall.
    """
    puck = bodies[PUCK]
    side, end = table.width / 2 - table.puck_radius, table.length / 2 - table.puck_radius
    clear = abs(puck[X]) + abs(puck[VX]) * seconds < end - ROUNDING
    clear = clear and abs(puck[Y]) + abs(puck[VY]) * seconds < side - ROUNDING
    for agent in (LEFT, RIGHT):
        gap_x, gap_y = puck[X] - bodies[agent, X], puck[Y] - bodies[agent, Y]
        speed = abs(puck[VX] - bodies[agent, VX]) + abs(puck[VY] - bodies[agent, VY])
        near = table.puck_radius + table.paddle_radius + speed * seconds + ROUNDING
        clear = clear and gap_x * gap_x + gap_y * gap_y > near * near
    return clear


@compiled
def _first_contact(bodies, table):
    """The puck's next contact at constant velocities: (seconds until then, kind of contact, y of the post if any)."""
    puck = bodies[PUCK]
    earliest, contact, post = np.inf, NO_CONTACT, 0.0
    touching = table.puck_radius + table.paddle_radius
    max_closing = 0.0
    for agent in (LEFT, RIGHT):
        gap_x, gap_y = puck[X] - bodies[agent, X], puck[Y] - bodies[agent, Y]
        velocity_x, velocity_y = puck[VX] - bodies[agent, VX], puck[VY] - bodies[agent, VY]
        time = _time_to_circle(gap_x, gap_y, velocity_x, velocity_y, touching)
        closing = -(gap_x * velocity_x + gap_y * velocity_y)
        if time < earliest or (
            time == earliest and closing > max_closing
        ):  # of two at once the harder one, for symmetry
            earliest, contact, max_closing = time, agent, closing
    if puck[VY] != 0.0:
        room = table.width / 2 - table.puck_radius - (puck[Y] if puck[VY] > 0.0 else -puck[Y])
        time = max(room, 0.0) / abs(puck[VY])
        if time < earliest:
            earliest, contact = time, AT_SIDE
    if puck[VX] != 0.0:
        end = table.length / 2
        ahead = puck[X] if puck[VX] > 0.0 else -puck[X]
        time = max(end - table.puck_radius - ahead, 0.0) / abs(puck[VX])
        mouth = abs(puck[Y] + puck[VY] * time) < table.goal / 2
        if time < earliest and not mouth:
            earliest, contact = time, AT_END
        post_x = end if puck[VX] > 0.0 else -end
        for post_y in (table.goal / 2, -table.goal / 2):
            time = _time_to_circle(puck[X] - post_x, puck[Y] - post_y, puck[VX], puck[VY], table.puck_radius)
            if time < earliest:
                earliest, contact, post = time, AT_POST, post_y
    return earliest, contact, post


@inlined
def _bounce(puck, normal_x, normal_y, wall_x, wall_y, restitution):
    """Reflect the puck off a surface that moves at `wall` and has the unit normal `normal`."""
    approach = (puck[VX] - wall_x) * normal_x + (puck[VY] - wall_y) * normal_y
    if approach < 0.0:
        puck[VX] -= (1.0 + restitution) * approach * normal_x
        puck[VY] -= (1.0 + restitution) * approach * normal_y


@compiled
def _resolve(bodies, contact, post, table):
    puck = bodies[PUCK]
    if contact in (AT_LEFT, AT_RIGHT):
        paddle = bodies[contact]
        gap_x, gap_y = puck[X] - paddle[X], puck[Y] - paddle[Y]
        gap = hypot(gap_x, gap_y)
        if gap > 0.0:
            _bounce(puck, gap_x / gap, gap_y / gap, paddle[VX], paddle[VY], table.paddle_restitution)
    elif contact == AT_SIDE:
        _bounce(puck, 0.0, -1.0 if puck[VY] > 0.0 else 1.0, 0.0, 0.0, table.wall_restitution)
    elif contact == AT_END:
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
    elif abs(puck[X]) > end:  # in the mouth of a goal: push it off the posts
        post_x = table.length / 2 if puck[X] > 0.0 else -table.length / 2
        post_y = table.goal / 2 if puck[Y] > 0.0 else -table.goal / 2
        gap_x, gap_y = puck[X] - post_x, puck[Y] - post_y
        gap = hypot(gap_x, gap_y)
        if 0.0 < gap < table.puck_radius:
            puck[X] = post_x + gap_x * table.puck_radius / gap
            puck[Y] = post_y + gap_y * table.puck_radius / gap


@inlined
def _from_paddle_to_puck(bodies, agent):
    """Unit vector and distance from a paddle's center to the puck's; forward where they coincide."""
    gap_x, gap_y = bodies[PUCK, X] - bodies[agent, X], bodies[PUCK, Y] - bodies[agent, Y]
    gap = hypot(gap_x, gap_y)
    if gap == 0.0:
        return (1.0 if agent == LEFT else -1.0), 0.0, 0.0
    return gap_x / gap, gap_y / gap, gap


@compiled
def _separate(bodies, table):
    """Undo overlaps left by rounding or by a squeeze: the puck gives way, and where it cannot, the paddles do.

    A paddle that gives way is stopped along the contact. Otherwise a paddle that presses the puck against a wall would
    strike it again and again at full speed, and shoot it out sideways faster than anything on the table moves.
    """
    puck = bodies[PUCK]
    touching = table.puck_radius + table.paddle_radius
    _keep_on_table(puck, table)
    push_x, push_y = 0.0, 0.0
    for agent in (LEFT, RIGHT):
        toward_x, toward_y, gap = _from_paddle_to_puck(bodies, agent)
        overlap = max(touching - gap, 0.0)
        push_x += overlap * toward_x
        push_y += overlap * toward_y
    if push_x == 0.0 and push_y == 0.0:
        return
    puck[X] += push_x
    puck[Y] += push_y
    _keep_on_table(puck, table)
    for agent in (LEFT, RIGHT):
        toward_x, toward_y, gap = _from_paddle_to_puck(bodies, agent)
        if gap < touching - ROUNDING:
            paddle = bodies[agent]
            low_x, high_x, side = _own_half(agent, table)
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


@inlined
def _advance_paddles(bodies, seconds):
    for agent in (LEFT, RIGHT):
        bodies[agent, X] += bodies[agent, VX] * seconds
        bodies[agent, Y] += bodies[agent, VY] * seconds


@compiled
def _substep(bodies, dt, table):
    """Move all bodies on by `dt`, the paddles at their velocities, or until a goal.

    Returns `goal` and `touched` as `step_physics`, and the seconds of `dt` that are left after a goal.
    """
    puck, end = bodies[PUCK], table.length / 2
    speed = hypot(puck[VX], puck[VY])
    if speed > 0.0:
        kept = max(0.0, 1.0 - dt * (table.drag + table.friction / speed))
        puck[VX] *= kept
        puck[VY] *= kept

    if _out_of_reach(bodies, dt, table):
        _advance(bodies, dt)
        return 0, 0, 0.0
    left_over, touched = dt, 0
    for _ in range(MAX_CONTACTS):
        time, contact, post = _first_contact(bodies, table)
        if contact == NO_CONTACT or time >= left_over:
            _advance(bodies, left_over)
            left_over = 0.0
            break
        _advance(bodies, time)
        left_over -= time
        if abs(puck[X]) > end:
            break
        if contact <= AT_RIGHT:
            touched |= 1 << contact
        _resolve(bodies, contact, post, table)
    if abs(puck[X]) > end:
        return (1 if puck[X] > 0.0 else -1), touched, left_over
    if left_over > 0.0:  # squeezed: the paddles finish their motion, `_separate` moves the puck
        _advance_paddles(bodies, left_over)
    _separate(bodies, table)
    return 0, touched, 0.0


@compiled
def step_physics(bodies: np.ndarray, targets: np.ndarray, table: TableSpec) -> tuple[int, int]:
    """Advance one table by one tick (`table.tick` seconds), in place.

    Args:
        bodies: (3, 4) the state, see the module's docstring.
        targets: (2, 2) the desired position of each paddle, in m in the table's frame; NaN means stay.
        table: the `TableSpec`.

    Returns:
        goal: +1 if the left agent scored, -1 if the right one did, 0 otherwise. After a goal the puck stays there.
        touched: bits of `TOUCHED_BY`, the agents whose paddles hit the puck.
    """
    dt = table.tick / table.substeps
    touched = 0
    for _ in range(table.substeps):
        for agent in (LEFT, RIGHT):
            goal_x, goal_y = targets[agent, X], targets[agent, Y]
            if not (np.isfinite(goal_x) and np.isfinite(goal_y)):
                goal_x, goal_y = bodies[agent, X], bodies[agent, Y]
            _drive_paddle(bodies[agent], agent, goal_x, goal_y, dt, table)
        goal, hit, _ = _substep(bodies, dt, table)
        touched |= hit
        if goal != 0:
            return goal, touched
    return 0, touched


@compiled
def _coast(bodies, dt, substeps, table):
    """`substeps` sub-steps of `coast`."""
    puck = bodies[PUCK]
    for _ in range(substeps):
        for agent in (LEFT, RIGHT):
            _stop_at_bounds(bodies[agent], agent, bodies[agent, VX], bodies[agent, VY], dt, table)
        in_goal, left_over = abs(puck[X]) > table.length / 2, dt
        if not in_goal:
            goal, _, left_over = _substep(bodies, dt, table)
            in_goal = goal != 0
        if in_goal:
            puck[VX], puck[VY] = 0.0, 0.0
            _advance_paddles(bodies, left_over)


@compiled
def coast(bodies: np.ndarray, seconds: float, table: TableSpec) -> None:
    """Move n tables on by `seconds` in which nobody steers, in place.

    As in `step_physics`, but the paddles keep their velocities until the bounds of their halves. A puck that enters a
    goal stays and rests there. What is left of `seconds` after whole ticks is a shorter tick.

    Args:
        bodies: (n, 3, 4) the states, see the module's docstring.
        seconds: >= 0.
        table: the `TableSpec`.
    """
    ticks = int(seconds / table.tick + ROUNDING)
    rest = seconds - ticks * table.tick
    for index in range(len(bodies)):
        _coast(bodies[index], table.tick / table.substeps, ticks * table.substeps, table)
        if rest > ROUNDING * table.tick:
            _coast(bodies[index], rest / table.substeps, table.substeps, table)
