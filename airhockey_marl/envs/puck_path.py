"""The free puck: where it goes, when it crosses a line and whether it scores, as long as no paddle is in its way.

One simulation and cheaper forecasts, which differ in what they neglect. Results depend on each of them bit for bit:

function                  side walls      end walls   drag         a goal is           used for
would_score               as `step_physics` does all                                   shots, of the save rate
puck_at                   restitution     like sides  first order  not considered      strikes of scripted players
line_crossing             restitution     -           none         -                   blocks of scripted players
seconds_to_goal_or_post   restitution     -           none         mouth and posts     strikes of scripted players
seconds_to_goal           restitution     -           none         the mouth           what a STD means
heads_for_goal            restitution     -           none         between the posts   shots, of the defense rate
goal_alignment            mirrors         -           none         a Gaussian          reward shaping
step_expected_puck        restitution,    like sides  exponential  the mouth           what a simulated person
                            some noticed                                                 expects

Pucks are in an observer's frame, in m and m/s: x toward the opponent, the own goal at x = -length / 2.
"""

from math import copysign, cos, exp, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec, X, Y, clamp, compiled, inlined, step_physics

if TYPE_CHECKING:
    from torch import Tensor

MAX_BOUNCES = 8  # off the side walls; a path with more of them takes longer than any forecast reaches
METRIC_BOUNCES = 20  # the same in `heads_for_goal`
SHOT_HORIZON = 3.0  # s: a puck that has not scored by then is no shot
NO_PADDLE = 1e-6  # m, radius of an absent paddle: a table must have two

NO_OUTCOME, BLOCKED, CONCEDED = 0, 1, 2  # of a tick, for a shot


@compiled
def coordinate_at(
    position: float, velocity: float, seconds: float, wall: float, restitution: float, max_bounces: int
) -> tuple[float, float]:
    """Position and velocity, in one dimension, after `seconds` of a puck between walls at +-`wall`, without drag."""
    for _ in range(max_bounces):
        if velocity == 0.0:
            break
        until = max((copysign(wall, velocity) - position) / velocity, 0.0)
        if until >= seconds:
            break
        position = copysign(wall, velocity)
        velocity *= -restitution
        seconds -= until
    return clamp(position + velocity * seconds, -wall, wall), velocity


@compiled
def puck_at(puck: np.ndarray, seconds: float, table: TableSpec) -> tuple[float, float, float, float]:
    """The puck (x, y, vx, vy) after `seconds`: x and y apart, drag to first order, the ends as walls without a goal."""
    kept = 1.0 - table.drag * seconds
    seconds *= 0.5 * (1.0 + kept)
    end, side = table.length / 2 - table.puck_radius, table.width / 2 - table.puck_radius
    x, vx = coordinate_at(puck[0], puck[2], seconds, end, table.wall_restitution, MAX_BOUNCES)
    y, vy = coordinate_at(puck[1], puck[3], seconds, side, table.wall_restitution, MAX_BOUNCES)
    return x, y, kept * vx, kept * vy


@compiled
def line_crossing(puck: np.ndarray, line: float, table: TableSpec) -> tuple[float, float]:
    """Seconds until the puck crosses x = `line` on its way to the own end, inf if it does not, and its y there.

    Without drag, which changes the time a little and the path not at all.
    """
    x, y, vx, vy = puck
    if vx >= -table.stall_speed or x <= line:
        return np.inf, y
    seconds = (x - line) / -vx
    side = table.width / 2 - table.puck_radius
    return seconds, coordinate_at(y, vy, seconds, side, table.wall_restitution, MAX_BOUNCES)[0]


@compiled
def seconds_to_goal_or_post(puck: np.ndarray, table: TableSpec) -> float:
    """Seconds until the puck is in the own goal or on its posts; inf if it is slow or passes by."""
    seconds, y = line_crossing(puck, -table.length / 2, table)
    return seconds if abs(y) < table.goal / 2 + 0.5 * table.puck_radius else np.inf


@inlined
def _goal_line_crossing(x, y, vx, vy, max_bounces, table):
    """Seconds until a puck with vx < 0 is at the own goal line, and its y there."""
    seconds = (x + table.length / 2) / -vx
    side = table.width / 2 - table.puck_radius
    return seconds, coordinate_at(y, vy, seconds, side, table.wall_restitution, max_bounces)[0]


@compiled
def heads_for_goal(x: float, y: float, vx: float, vy: float, table: TableSpec) -> bool:
    """Whether the puck, at its present velocity and over the side walls, passes between the posts of the own goal."""
    if vx >= 0.0:
        return False
    return abs(_goal_line_crossing(x, y, vx, vy, METRIC_BOUNCES, table)[1]) < table.goal / 2 - table.puck_radius


@compiled
def _seconds_to_goal(pucks, table, out):
    for index in range(len(pucks)):
        x, y, vx, vy = pucks[index]
        out[index] = np.inf
        if vx < 0.0:
            seconds, crossing = _goal_line_crossing(x, y, vx, vy, MAX_BOUNCES, table)
            if abs(crossing) < table.goal / 2:
                out[index] = seconds


def seconds_to_goal(observation: np.ndarray, table: TableSpec) -> np.ndarray:
    """Seconds (...) until the puck's center is in the own goal, for observations (..., 12); inf if it does not score.

    At its present velocity, over the side walls.
    """
    pucks = np.ascontiguousarray(observation[..., 8:12], dtype=np.float64).reshape(-1, 4)
    out = np.empty(len(pucks))
    _seconds_to_goal(pucks, table, out)
    return out.reshape(observation.shape[:-1])


def goal_alignment(observation: "Tensor", table: TableSpec) -> "Tensor":
    """How well the puck is aimed at the goal at the end it moves to: (..., 1) for observations (..., 12).

    1 in the middle of the goal, falling off as a Gaussian over its half width. The side walls are mirrors: the speed
    lost in a bounce is neglected.
    """
    x, y, vx, vy = observation[..., 8:12].split(1, dim=-1)
    side = table.width / 2 - table.puck_radius
    seconds = (table.length / 2 - x * vx.sign()) / vx.abs().clamp(min=table.stall_speed)
    unfolded = (y + vy * seconds + side).remainder(4 * side)  # one period there and back
    crossing = side - (unfolded - 2 * side).abs()
    return (-((crossing / (table.goal / 2)) ** 2)).exp()


@inlined
def rotate(vx: float, vy: float, angle: float) -> tuple[float, float]:
    """The vector (vx, vy) turned by `angle` rad."""
    return vx * cos(angle) - vy * sin(angle), vx * sin(angle) + vy * cos(angle)


@compiled
def step_expected_puck(
    x: float, y: float, vx: float, vy: float, seconds: float, bounces: int, bounce_turn: float, table: TableSpec
) -> tuple[float, float, float, float, int, bool]:
    """Move an expected puck on by one short step: a bounce is noticed at the end of the step in which it happens.

    Args:
        bounces: off walls that are still thought of; after them the puck is expected to stay along the wall.
        bounce_turn: rad, error of the direction in which the puck leaves a side wall.

    Returns:
        x, y, vx, vy, the bounces left, and whether the puck is in the own goal.
    """
    side, end = table.width / 2 - table.puck_radius, table.length / 2 - table.puck_radius
    kept = exp(-table.drag * seconds)
    x += vx * seconds * 0.5 * (1.0 + kept)
    y += vy * seconds * 0.5 * (1.0 + kept)
    vx *= kept
    vy *= kept
    if abs(y) > side:
        wall = side if y > 0.0 else -side
        if bounces > 0:
            bounces -= 1
            y = wall - table.wall_restitution * (y - wall)
            vx, vy = rotate(vx, -table.wall_restitution * vy, bounce_turn)
        else:
            y, vy = wall, 0.0
    scored = False
    if abs(x) > end:
        if abs(y) < table.goal / 2:
            scored = x < 0.0
        else:
            wall = end if x > 0.0 else -end
            if bounces > 0:
                bounces -= 1
                x, vx = wall - table.wall_restitution * (x - wall), -table.wall_restitution * vx
            else:
                x, vx = wall, 0.0
    return x, y, vx, vy, bounces, scored


@inlined
def aim_offset(x: float, y: float, bank: int, aim_y: float, table: TableSpec) -> tuple[float, float]:
    """From (x, y) to the point `aim_y` in the opponent's goal, or to its image in a side wall: (ahead, across) in m.

    `bank` is the wall that the shot takes: 1 the left one, -1 the right one, 0 none. A wall keeps only a part e of
    the speed across it, so the way back from it counts as 1 / e of its width.
    """
    if bank == 0:
        across = aim_y - y
    else:
        side = bank * (table.width / 2 - table.puck_radius)
        across = (side - y) + (side - aim_y) / table.wall_restitution
    return table.length / 2 - x, across


@inlined
def shot_direction(x: float, y: float, bank: int, aim_y: float, table: TableSpec) -> tuple[float, float]:
    """The unit vector of a shot from (x, y), see `aim_offset`."""
    ahead, across = aim_offset(x, y, bank, aim_y, table)
    distance = hypot(ahead, across)
    return ahead / distance, across / distance


def without_paddles(table: TableSpec) -> TableSpec:
    """The table for `would_score`."""
    return table._replace(paddle_radius=NO_PADDLE)


@compiled
def would_score(bodies: np.ndarray, empty: TableSpec) -> bool:
    """Whether the puck of one table, `bodies` (3, 4), ends in the left goal within `SHOT_HORIZON` if nobody touches it.

    Simulated by `step_physics` on the table `empty`, see `without_paddles`, whose paddles stay in the corners, out of
    the puck's reach.
    """
    alone = np.zeros((3, 4))
    alone[PUCK] = bodies[PUCK]
    for agent in (LEFT, RIGHT):
        alone[agent, X] = (-0.5 if agent == LEFT else 0.5) * empty.length
        alone[agent, Y] = 0.5 * empty.width
    targets = alone[:PUCK, :PUCK].copy()
    for _ in range(round(SHOT_HORIZON / empty.tick)):
        goal, _ = step_physics(alone, targets, empty)
        if goal != 0:
            return goal < 0
    return False


@inlined
def shot_outcome(under_fire: bool, threat: bool, by_defender: bool, served: bool, goal: int) -> int:
    """How one tick ends a shot on the left goal: `NO_OUTCOME`, `BLOCKED` or `CONCEDED`.

    Blocked if the defender touched a puck that was on its way into the goal and no longer is, conceded if it scored.

    Args:
        under_fire: a shot was on its way before the tick.
        threat: the free puck would score now; not looked at after a goal or a serve.
        by_defender: the defender touched the puck in this tick.
        served: the puck was served again.
        goal: +1 in the right goal, -1 in the left one, 0 none.
    """
    if goal < 0:
        return CONCEDED
    if under_fire and by_defender and not threat and not served and goal == 0:
        return BLOCKED
    return NO_OUTCOME
