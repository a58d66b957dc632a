"""Scripted players: fixed reference points of a league's ratings, and opponents in its training.

random    an untrained policy: samples positions on its side, most often near the midpoint.
defender  stands on a line before its goal, where the puck will cross it; clears a puck that has come to rest.
striker   stops fast pucks close to its goal and strikes all others: it moves behind the puck and then through it at
          full speed, directly or over a side wall, where the opponent's paddle covers the goal least.

A script is a function of one observation (12 numbers, see `pettingzoo_env`) without memory, so matches are repeatable.
Positions are in m from the table's center, x toward the opponent. All constants are assumptions, tuned against the
league and each other with decisions of 40 ms; with shorter ones the striker changes its plan more often and strikes
less well.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from math import copysign, hypot

import numpy as np
import torch
from numba import njit
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec, clamp
from airhockey_marl.envs.puck_path import aim_offset, line_crossing, puck_at, seconds_to_goal_or_post
from airhockey_marl.experiment.registry import Registry
from airhockey_marl.experiment.validation import as_tensor

UNTRAINED_STD = 0.5  # of `random`: sigmoid(0), the initial STD of `networks.GaussianPolicy`
TREMOR_STD = 0.02  # of the others: a hand's tremor of 1 cm

DEFENDER_LINE, STRIKER_LINE = 0.3, 0.105  # m before the goal; no puck fits behind the striker's
LATERAL_GAIN = 0.5  # share of the puck's y that is followed while it does not approach
BLOCK_HORIZON = 1.5  # s: a puck that needs longer to the line is not approaching yet
REST_SPEED = 0.5  # m/s: the defender clears a slower puck
MAX_PUCK_SPEED, MAX_SHOT_SPEED = 5.0, 3.0  # m/s toward the own end: the striker only blocks faster pucks and shots
STRIKER_MARGIN = 0.3  # m: the striker does not strike closer to the half-way line, to stay near its goal
RUN_UP = 0.12  # m, in which the paddle reaches full speed
DECISION = 0.04  # s, assumed time between decisions
ALIGNMENT = 0.94  # cosine of 20 degrees: how exactly the paddle must be behind the puck


@njit(cache=True)
def _guard(puck, line, table):
    """The position to block the puck: on the line, or in the mouth of the goal if the puck has passed the line."""
    mouth = table.goal / 2
    if puck[0] < line + table.paddle_radius:
        return -table.length / 2 + table.paddle_radius, clamp(puck[1], -mouth, mouth)
    seconds, y = line_crossing(puck, line, table)
    if seconds < BLOCK_HORIZON:
        return line, clamp(y, -1.3 * mouth, 1.3 * mouth)
    return line, clamp(LATERAL_GAIN * puck[1], -mouth, mouth)


@njit(cache=True)
def _shot(bank, x, y, opponent_x, table):
    """Direction (a unit vector) of a shot from (x, y) at the opponent's goal, and its y where it passes `opponent_x`.

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
def _blow(vx, vy, to_x, to_y, table):
    """Contact of a paddle at full speed that sends a puck of velocity (vx, vy) along the unit vector (to_x, to_y).

    Returns the unit vector from the paddle to the puck, along which the paddle has to move, and the puck's speed after
    the contact. Each depends on the other: a few fixed-point iterations agree to a degree.
    """
    x, y, speed = to_x, to_y, 0.0
    for _ in range(4):
        blow = (1.0 + table.paddle_restitution) * max(table.paddle_speed - (vx * x + vy * y), 0.0)
        speed = max((vx + blow * x) * to_x + (vy + blow * y) * to_y, 0.1)
        change_x, change_y = speed * to_x - vx, speed * to_y - vy
        change = hypot(change_x, change_y)
        if change == 0.0:
            break
        x, y = change_x / change, change_y / change
    return x, y, speed


@njit(cache=True)
def _around(px, py, x, y, puck, table):
    """Next waypoint from (px, py) to (x, y) that avoids the puck: (x, y) itself, or a point beside the puck."""
    clear = 1.2 * (table.puck_radius + table.paddle_radius)
    distance = hypot(x - px, y - py)
    if distance == 0.0:
        return x, y
    to_x, to_y = (x - px) / distance, (y - py) / distance
    ahead = (puck[0] - px) * to_x + (puck[1] - py) * to_y
    across = (puck[0] - px) * to_y - (puck[1] - py) * to_x  # above 0: the puck is right of the straight line
    if not 0.0 < ahead < distance or abs(across) > clear:
        return x, y
    turn = copysign(clear, across)
    return puck[0] - turn * to_y, puck[1] + turn * to_x


@njit(cache=True)
def _strike(observation, bank_shots, max_x, table):
    """The position to move to in order to strike the puck as soon as possible.

    Searches the next second for the first time at which the paddle can be where it has to hit the predicted puck,
    directly or after a run-up, and of the shots at that time takes the one that the opponent would need the highest
    speed to reach.

    Args:
        observation: (12,).
        bank_shots: whether shots over the side walls are considered.
        max_x: m, the puck is not struck beyond this x.

    Returns:
        Whether there is such a shot, and the position (x, y).
    """
    px, py, puck = observation[0], observation[1], observation[8:12]
    touching, top_speed = table.puck_radius + table.paddle_radius, table.paddle_speed
    low, high = table.paddle_radius - table.length / 2, -table.paddle_radius
    side = table.width / 2 - table.paddle_radius
    until_goal = seconds_to_goal_or_post(puck, table)
    best, to_x, to_y = -1.0, px, py
    for step in range(25):
        seconds = (step + 0.5) * DECISION
        if best >= 0.0 or seconds > until_goal - DECISION:
            break
        x, y, vx, vy = puck_at(puck, seconds, table)
        if x > max_x:
            continue
        for bank in range(-1, 2):
            if bank != 0 and not bank_shots:
                continue
            toward_x, toward_y, passing = _shot(bank, x, y, observation[4], table)
            blow_x, blow_y, speed = _blow(vx, vy, toward_x, toward_y, table)
            at_x, at_y = x - touching * blow_x, y - touching * blow_y
            if not low <= at_x <= high or abs(at_y) > side:
                continue
            distance = hypot(at_x - px, at_y - py)
            behind = (at_x - px) * blow_x + (at_y - py) * blow_y >= ALIGNMENT * distance
            start_x, start_y = clamp(at_x - RUN_UP * blow_x, low, high), clamp(at_y - RUN_UP * blow_y, -side, side)
            if behind:  # and usually already moving
                seconds_needed = distance / top_speed - 0.25 * DECISION
            else:
                seconds_needed = (hypot(start_x - px, start_y - py) + RUN_UP) / top_speed + DECISION
            difficulty = abs(passing - observation[5]) * speed * toward_x / max(observation[4] - x, table.paddle_radius)
            if seconds_needed > seconds or difficulty <= best:
                continue
            best = difficulty
            if behind and seconds_needed > seconds - 1.5 * DECISION:  # strike now
                to_x, to_y = at_x + RUN_UP * blow_x, at_y + RUN_UP * blow_y
            else:
                to_x, to_y = _around(px, py, start_x, start_y, puck, table)
    return best >= 0.0, to_x, to_y


@njit(cache=True)
def _defender(observation, table):
    puck = observation[8:12]
    if puck[0] < 0.0 and hypot(puck[2], puck[3]) < REST_SPEED:
        possible, x, y = _strike(observation, False, 0.0, table)
        if possible:
            return x, y
    return _guard(puck, DEFENDER_LINE - table.length / 2, table)


@njit(cache=True)
def _striker(observation, table):
    puck = observation[8:12]
    max_speed = MAX_PUCK_SPEED if seconds_to_goal_or_post(puck, table) == np.inf else MAX_SHOT_SPEED
    if puck[2] > -max_speed:
        possible, x, y = _strike(observation, True, -STRIKER_MARGIN, table)
        if possible:
            return x, y
    return _guard(puck, STRIKER_LINE - table.length / 2, table)


@njit(cache=True)
def _write_action(position, action, table):
    """Write the action (2,) whose desired position is `position`."""
    action[0] = clamp((position[0] + table.length / 4) / (table.length / 4 - table.paddle_radius), -1.0, 1.0)
    action[1] = clamp(position[1] / (table.width / 2 - table.paddle_radius), -1.0, 1.0)


def _stay(observation, actions, table):
    actions[:] = 0.0


@njit(cache=True)
def _play(observation, actions, table, strikes):
    for index in range(len(observation)):
        position = _striker(observation[index], table) if strikes else _defender(observation[index], table)
        _write_action(position, actions[index], table)


@dataclass(frozen=True)
class ScriptedPlayer:
    """A script with the interface of a policy.

    Attributes:
        script: writes the mean actions (n, 2) for observations (n, 12), both float64, on a `TableSpec`.
        std: standard deviation of the action.
        table: the table that is played on.
    """

    script: Callable[[np.ndarray, np.ndarray, TableSpec], None]
    std: float
    table: TableSpec = field(default_factory=TableSpec)

    def __call__(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (..., 12) to the mean (..., 2), in [-1, 1], and the STD (..., 2) of the action."""
        observation = as_tensor("observation", observation, 12)
        rows = observation.detach().reshape(-1, 12).numpy().astype(np.float64)
        actions = np.empty((len(rows), 2))
        self.script(rows, actions, self.table)
        mean = torch.from_numpy(actions).to(observation.dtype).reshape(*observation.shape[:-1], 2)
        return mean, torch.full_like(mean, self.std)


REFERENCE_PLAYERS = ("random", "defender", "striker")  # every league is measured against these
SCRIPTED_PLAYERS: Registry[ScriptedPlayer] = Registry("scripted player")
SCRIPTED_PLAYERS.register("random")(ScriptedPlayer(_stay, UNTRAINED_STD))
SCRIPTED_PLAYERS.register("defender")(ScriptedPlayer(partial(_play, strikes=False), TREMOR_STD))
SCRIPTED_PLAYERS.register("striker")(ScriptedPlayer(partial(_play, strikes=True), TREMOR_STD))
