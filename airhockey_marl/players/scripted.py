"""Scripted players: fixed points by which the generations of a league are measured, and opponents they can meet.

random    what an untrained policy does: any place on its side, most often near the middle.
defender  stands on a line before its goal, where the puck will cross it; clears a puck that has come to rest.
striker   stops what comes fast close to its goal, and strikes everything else: it gets behind the puck, and through it
          at full speed, straight or over a side wall, whichever way the opponent's paddle covers least.

A script looks at one observation (12 numbers, see `env`) and remembers nothing, so a match can be repeated. Places are
in m from the table's center, x toward the opponent. All constants are assumptions, tried out against the league and
each other with decisions of 40 ms; with shorter ones the striker changes its mind more often, and strikes less well.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import copysign, hypot

import numpy as np
import torch
from numba import njit
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec, clamp
from airhockey_marl.envs.puck_path import aim_offset, line_crossing, puck_at, seconds_to_goal_or_post
from airhockey_marl.experiment.registry import Registry
from airhockey_marl.experiment.validation import CPU, check_tensors

UNTRAINED = 0.5  # STD of `random`: sigmoid(0), with which `policy.GaussianPolicy` begins
STEADY = 0.02  # STD of the others, a hand's tremor: 1 cm

DEFENDER_LINE, STRIKER_LINE = 0.3, 0.105  # m before the goal; behind the striker's no puck fits
FOLLOWED = 0.5  # of the puck's y, while it is not coming
FORESIGHT = 1.5  # s: a puck that takes longer is not coming yet
AT_REST = 0.5  # m/s: a slower puck the defender clears
TOO_FAST, TOO_FAST_ON_GOAL = 5.0, 3.0  # m/s toward the own end: such a puck the striker only stops
STRIKER_HALF = 0.3  # m: so far from the half-way line the striker strikes, not to be caught far from its goal
RUN_UP = 0.12  # m, to be at full speed when the paddle hits
DECISION = 0.04  # s
ALIGNED = 0.94  # cosine of 20 degrees, how exactly a paddle must be behind the puck


@njit(cache=True)
def _guard(puck, line, table):
    """Where to stop the puck: on the line, or in the mouth of the goal if it has come past that."""
    mouth = table.goal / 2
    if puck[0] < line + table.paddle_radius:
        return -table.length / 2 + table.paddle_radius, clamp(puck[1], -mouth, mouth)
    seconds, y = line_crossing(puck, line, table)
    if seconds < FORESIGHT:
        return line, clamp(y, -1.3 * mouth, 1.3 * mouth)
    return line, clamp(FOLLOWED * puck[1], -mouth, mouth)


@njit(cache=True)
def _shot(bank, x, y, opponent_x, table):
    """The direction from (x, y) to the opponent's goal, and the shot's y where it passes the opponent's paddle.

    `bank` is the wall that the shot takes, see `aim_offset`.
    """
    ahead, across = aim_offset(x, y, bank, 0.0, table)
    passing = y + across / ahead * (opponent_x - x)
    wall = bank * (table.width / 2 - table.puck_radius)
    if abs(passing) > abs(wall) and bank != 0:
        passing = wall - (passing - wall) * table.wall_restitution
    distance = hypot(ahead, across)
    return ahead / distance, across / distance, passing


@njit(cache=True)
def _blow(vx, vy, way_x, way_y, table):
    """How a paddle at full speed must meet a puck of velocity v to send it the given way (a unit vector).

    Returns the unit vector from the paddle to the puck, along which the blow acts and the paddle has to come, and the
    puck's speed after it. Each depends on the other: a few rounds agree to a degree.
    """
    x, y, speed = way_x, way_y, 0.0
    for _ in range(4):
        blow = (1.0 + table.paddle_restitution) * max(table.paddle_speed - (vx * x + vy * y), 0.0)
        speed = max((vx + blow * x) * way_x + (vy + blow * y) * way_y, 0.1)
        change_x, change_y = speed * way_x - vx, speed * way_y - vy
        change = hypot(change_x, change_y)
        if change == 0.0:
            break
        x, y = change_x / change, change_y / change
    return x, y, speed


@njit(cache=True)
def _around(px, py, x, y, puck, table):
    """Where to steer to get from (px, py) to (x, y) without touching the puck: there, or first to the puck's side."""
    clear = 1.2 * (table.puck_radius + table.paddle_radius)
    distance = hypot(x - px, y - py)
    if distance == 0.0:
        return x, y
    way_x, way_y = (x - px) / distance, (y - py) / distance
    along = (puck[0] - px) * way_x + (puck[1] - py) * way_y
    aside = (puck[0] - px) * way_y - (puck[1] - py) * way_x  # above 0: the puck is to the right of the way
    if not 0.0 < along < distance or abs(aside) > clear:
        return x, y
    turn = copysign(clear, aside)
    return puck[0] - turn * way_y, puck[1] + turn * way_x


@njit(cache=True)
def _strike(seen, banks, foremost, table):
    """Where to go to strike the puck as soon as possible, and whether that can be done at all.

    Args:
        seen: (12,) the observation.
        banks: whether shots over the side walls are considered.
        foremost: the puck is struck where its x is below this.

    For each moment of the next second: where is the puck, where must the paddle be to shoot it, and can it be there
    by then, either straight or by way of a run-up? Of the first moment's shots, the one is taken for which the
    opponent would have to be fastest.
    """
    px, py, puck = seen[0], seen[1], seen[8:12]
    touching, fast = table.puck_radius + table.paddle_radius, table.paddle_speed
    low, high = table.paddle_radius - table.length / 2, -table.paddle_radius
    side = table.width / 2 - table.paddle_radius
    until_goal = seconds_to_goal_or_post(puck, table)
    hardest, to_x, to_y = -1.0, px, py
    for step in range(25):
        seconds = (step + 0.5) * DECISION
        if hardest >= 0.0 or seconds > until_goal - DECISION:
            break
        x, y, vx, vy = puck_at(puck, seconds, table)
        if x > foremost:
            continue
        for bank in range(-1, 2):
            if bank != 0 and not banks:
                continue
            way_x, way_y, passing = _shot(bank, x, y, seen[4], table)
            blow_x, blow_y, speed = _blow(vx, vy, way_x, way_y, table)
            at_x, at_y = x - touching * blow_x, y - touching * blow_y
            if not low <= at_x <= high or abs(at_y) > side:
                continue
            distance = hypot(at_x - px, at_y - py)
            behind = (at_x - px) * blow_x + (at_y - py) * blow_y >= ALIGNED * distance
            start_x, start_y = clamp(at_x - RUN_UP * blow_x, low, high), clamp(at_y - RUN_UP * blow_y, -side, side)
            if behind:  # and, as a rule, already moving
                needed = distance / fast - 0.25 * DECISION
            else:
                needed = (hypot(start_x - px, start_y - py) + RUN_UP) / fast + DECISION
            hard = abs(passing - seen[5]) * speed * way_x / max(seen[4] - x, table.paddle_radius)
            if needed > seconds or hard <= hardest:
                continue
            hardest = hard
            if behind and needed > seconds - 1.5 * DECISION:  # it is time
                to_x, to_y = at_x + RUN_UP * blow_x, at_y + RUN_UP * blow_y
            else:
                to_x, to_y = _around(px, py, start_x, start_y, puck, table)
    return hardest >= 0.0, to_x, to_y


@njit(cache=True)
def _defender(seen, table):
    puck = seen[8:12]
    if puck[0] < 0.0 and hypot(puck[2], puck[3]) < AT_REST:
        possible, x, y = _strike(seen, False, 0.0, table)
        if possible:
            return x, y
    return _guard(puck, DEFENDER_LINE - table.length / 2, table)


@njit(cache=True)
def _striker(seen, table):
    puck = seen[8:12]
    too_fast = TOO_FAST if seconds_to_goal_or_post(puck, table) == np.inf else TOO_FAST_ON_GOAL
    if puck[2] > -too_fast:
        possible, x, y = _strike(seen, True, -STRIKER_HALF, table)
        if possible:
            return x, y
    return _guard(puck, STRIKER_LINE - table.length / 2, table)


@njit(cache=True)
def _as_action(place, action, table):
    """Write the action (2,) that means this place."""
    action[0] = clamp((place[0] + table.length / 4) / (table.length / 4 - table.paddle_radius), -1.0, 1.0)
    action[1] = clamp(place[1] / (table.width / 2 - table.paddle_radius), -1.0, 1.0)


def _rest(seen, actions, table):
    actions[:] = 0.0


@njit(cache=True)
def _defend(seen, actions, table):
    for index in range(len(seen)):
        _as_action(_defender(seen[index], table), actions[index], table)


@njit(cache=True)
def _attack(seen, actions, table):
    for index in range(len(seen)):
        _as_action(_striker(seen[index], table), actions[index], table)


@dataclass(frozen=True)
class ScriptedPlayer:
    """A script that can be asked like a policy.

    Attributes:
        script: writes the actions (n, 2) for observations (n, 12), both float64, at a `TableSpec`.
        std: of the action.
        table: the table it plays on.
    """

    script: Callable[[np.ndarray, np.ndarray, TableSpec], None]
    std: float
    table: TableSpec = field(default_factory=TableSpec)

    def __call__(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (..., 12) to mean (..., 2), in [-1, 1], and STD (..., 2)."""
        check_tensors(CPU, observation=(observation, "... 12"))
        seen = observation.detach().reshape(-1, observation.shape[-1]).numpy().astype(np.float64)
        actions = np.empty((len(seen), 2))
        self.script(seen, actions, self.table)
        mean = torch.from_numpy(actions).to(observation.dtype).reshape(*observation.shape[:-1], 2)
        return mean, torch.full_like(mean, self.std)


REFERENCE_PLAYERS = ("random", "defender", "striker")  # every league is measured against these
SCRIPTED_PLAYERS: Registry[ScriptedPlayer] = Registry("scripted player")
for _name, _player in zip(
    REFERENCE_PLAYERS,
    (ScriptedPlayer(_rest, UNTRAINED), ScriptedPlayer(_defend, STEADY), ScriptedPlayer(_attack, STEADY)),
    strict=True,
):
    SCRIPTED_PLAYERS.register(_name)(_player)
