"""Intentions: recognized situation, utility of each intention, softmax choice, and the move that each asks for.

Utilities come from the playstyle traits and lie in 0..1 or so. The present intention is private: it is not part of the
game state. `person` is a record of `USER_PARAMETERS`, `state` one of `USER_STATE`, `arm` one of `ARM_STATE`; `percept`
is an observation (12,), `path` the expected path of the puck.
"""

from enum import IntEnum
from math import exp, hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.perception import OTHER, PUCK
from guidance.simulated_users.population import UtilityRow
from guidance.simulated_users.strokes import (
    BANK_LEFT,
    BANK_RIGHT,
    DIRECT,
    Shot,
    blocking_position,
    clamp,
    detour,
    find_strike,
    free_move,
    guard_x,
    move_time,
    to_table,
)

INTENTIONS = 9  # that people choose from
NO_INSTRUCTION = -1
IMPOSSIBLE = -1e9  # utility


class Intention(IntEnum):
    """What the hand is to do."""

    WAIT = 0  # at home before the goal
    SHADOW = 1  # before the goal, following the puck sideways
    PRESS = 2  # near the half-way line, in the opponent's way
    BLOCK = 3  # in the puck's way to the goal
    CONTROL = 4  # stop the puck with a soft touch
    SMASH = 5  # straight at the goal
    SMASH_BANK_LEFT = 6
    SMASH_BANK_RIGHT = 7
    RECOVER = 8  # back behind a puck that has passed
    REACH = 9  # put the paddle where the puck is; only on an experimenter's instruction


class Situation(IntEnum):
    """The situation as a person sees it."""

    AWAY = 0  # the puck is the opponent's
    COMING = 1  # approaching
    OURS = 2  # in the own half and before the paddle
    BEHIND = 3  # in the own half and nearer to the own goal than the paddle


@njit(cache=True)
def classify_situation(person, percept, paddle_x, table):
    """The `Situation`, from the percept extrapolated over the visual delay and the own paddle's present x in m."""
    vx = percept[PUCK + 2]
    x = percept[PUCK] + vx * person.visual_delay
    if x > 0.0:
        approaches = vx < -person.min_approach_speed and x + vx * person.arrival_horizon < 0.0
        return Situation.COMING if approaches else Situation.AWAY
    if x < paddle_x and x > -table.length / 2:
        return Situation.BEHIND
    departs = vx > person.departure_speed and x - paddle_x > person.reach_margin
    return Situation.AWAY if departs else Situation.OURS


@njit(cache=True)
def intended_shot(person, state, percept, intention, table):
    """The `Shot` of a striking intention: anywhere in the opponent's goal, but rather past the opponent's paddle."""
    wall = DIRECT
    if intention == Intention.SMASH_BANK_LEFT:
        wall = BANK_LEFT
    elif intention == Intention.SMASH_BANK_RIGHT:
        wall = BANK_RIGHT
    if intention == Intention.CONTROL:
        speed = person.control_speed
    else:
        speed = person.min_smash_speed + person.smash_speed_range * person.power
    return Shot(speed, wall, target_y(person, state, percept, table))


@njit(cache=True)
def target_y(person, state, percept, table):
    """Y in the opponent's goal that a shot is aimed at, m."""
    mouth = table.goal / 2 - table.puck_radius
    avoidance = clamp(-percept[OTHER + 1] / table.goal, -person.opponent_avoidance, person.opponent_avoidance)
    return mouth * clamp(person.aim_spread * state.aim_offset + avoidance, -person.max_aim, person.max_aim)


@njit(cache=True)
def utility(person, row, openness):
    """Utility of a row of `utility_weights`; `openness` in 0..1 is that of the direct way to the opponent's goal."""
    weight = person.utility_weights[row]
    return (
        weight[0]
        + weight[1] * person.aggression
        + weight[2] * person.press
        + weight[3] * person.bank
        + weight[4] * person.shadow
        + weight[5] * openness
    )


@njit(cache=True)
def compute_utilities(person, state, arm, percept, path, situation, table, utilities):
    """Write the utility of each intention in this situation into `utilities` (INTENTIONS,)."""
    utilities[:] = IMPOSSIBLE
    if situation == Situation.AWAY:
        utilities[Intention.WAIT] = utility(person, UtilityRow.away_wait, 0.0)
        utilities[Intention.SHADOW] = utility(person, UtilityRow.away_shadow, 0.0)
        utilities[Intention.PRESS] = utility(person, UtilityRow.away_press, 0.0)
    elif situation == Situation.BEHIND:
        utilities[Intention.RECOVER] = utility(person, UtilityRow.behind_recover, 0.0)
        if state.goal_threatened:
            utilities[Intention.BLOCK] = utility(person, UtilityRow.behind_block, 0.0)
    else:
        opponent_y = percept[OTHER + 1]
        openness = min(abs(target_y(person, state, percept, table) - opponent_y) / table.goal, 1.0)
        moving = hypot(path[0, 2], path[0, 3]) > person.control_speed
        for intention in range(Intention.CONTROL, Intention.RECOVER):
            shot = intended_shot(person, state, percept, intention, table)
            _, contact = find_strike(person, arm, path, shot, person.min_strike_time, person.start_effort_limit, table)
            if np.isinf(contact):
                continue
            if intention == Intention.CONTROL:
                row = UtilityRow.near_control if moving else UtilityRow.near_control_at_rest
            else:
                row = UtilityRow.near_smash if intention == Intention.SMASH else UtilityRow.near_bank
            utilities[intention] = utility(person, row, openness)
        if state.goal_threatened:
            utilities[Intention.BLOCK] = utility(person, UtilityRow.near_block, openness)
        else:
            utilities[Intention.SHADOW] = utility(person, UtilityRow.near_shadow, openness)
    if utilities[state.intention] > IMPOSSIBLE:
        utilities[state.intention] += person.persistence_bonus


@njit(cache=True)
def sample_softmax(utilities, temperature, rng, index):
    """Draw an index of `utilities` from their softmax, with the generator `rng[index]`."""
    best = utilities.max()
    total = 0.0
    for value in utilities:
        total += exp((value - best) / temperature)
    left = total * random_unit(rng, index)
    for choice in range(len(utilities)):
        left -= exp((utilities[choice] - best) / temperature)
        if left < 0.0:
            return choice
    return utilities.argmax()


@njit(cache=True)
def find_move(person, state, arm, percept, path, table):
    """The move that the present intention asks for: ((x, y, vx, vy, seconds), seconds until contact with the puck).

    The contact is infinite where none is planned. If the intended strike is impossible, the move is a block and the
    person will choose again.
    """
    intention = state.intention
    jitter = person.position_jitter
    puck_x, puck_y = path[0, 0], path[0, 1]
    x, y = guard_x(person, table) + 0.5 * jitter * state.depth_offset, jitter * state.aim_offset
    if intention == Intention.SHADOW:
        y = clamp(person.lateral_tracking_gain * puck_y, -table.goal / 2, table.goal / 2) + jitter * state.aim_offset
    elif intention == Intention.PRESS:
        x = -person.press_distance - jitter * (1.0 + state.depth_offset)
        y = puck_y * (table.length / 2 + x) / max(table.length / 2 + puck_x, 0.5) + jitter * state.aim_offset
    elif intention == Intention.BLOCK:
        x, y, arrival = blocking_position(person, path, table)
        x, y, vx, vy, seconds = free_move(person, arm, x, y, path, table)
        return (x, y, vx, vy, min(seconds, arrival)), np.inf
    elif intention == Intention.REACH:
        x, y = clamp(puck_x, -table.length / 2, 0.0), puck_y
        seconds = move_time(person, arm.estimate_x, arm.estimate_y, x, y, table) + person.muscle_lag
        return (x, y, 0.0, 0.0, seconds), np.inf
    elif intention == Intention.RECOVER:
        paddle_x, paddle_y = to_table(arm.estimate_x, arm.estimate_y, table)
        x, y = detour(person, paddle_x, paddle_y, puck_x, puck_y, table)
    elif intention != Intention.WAIT:
        if state.time_to_contact < np.inf:  # under way
            earliest = max(state.time_to_contact - person.strike_time_slack, person.min_correction_time)
            effort = person.continue_effort_limit
        else:
            earliest, effort = person.min_strike_time, person.start_effort_limit
        shot = intended_shot(person, state, percept, intention, table)
        move, contact = find_strike(person, arm, path, shot, earliest, effort, table)
        if contact < np.inf:
            return move, contact
        state.time_to_reconsider = 0.0
        x, y, _ = blocking_position(person, path, table)
    return free_move(person, arm, x, y, path, table), np.inf
