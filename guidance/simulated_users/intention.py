"""What a person means to do: one of nine intentions, drawn from a softmax over what each is worth to them.

Worth is in 0..1 or so and comes from the playstyle traits; the numbers in it are assumptions [A]. An intention is
private: it is not part of the state that anyone else sees.
"""

from enum import IntEnum
from math import exp, hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.perception import PUCK
from guidance.simulated_users.population import WORTHS
from guidance.simulated_users.strokes import BANK_LEFT, BANK_RIGHT, DIRECT, clamp, strike

INTENTIONS = 9  # that one can have of one's own accord
NOTHING = -1  # told by nobody
IMPOSSIBLE = -1e9

# Rows of `PERSON.worth`: the intention, and what is going on.
(
    AWAY_WAIT,
    AWAY_SHADOW,
    AWAY_PRESS,
    BEHIND_RECOVER,
    BEHIND_BLOCK,
    NEAR_CONTROL,
    NEAR_CONTROL_AT_REST,
    NEAR_SMASH,
    NEAR_BANK,
    NEAR_BLOCK,
    NEAR_SHADOW,
) = range(len(WORTHS))


class Intention(IntEnum):
    """What the hand is for."""

    WAIT = 0  # at home before the goal
    SHADOW = 1  # before the goal, following the puck sideways
    PRESS = 2  # near the half-way line, in the opponent's way
    BLOCK = 3  # in the puck's way to the goal
    CONTROL = 4  # stop the puck with a soft touch
    SMASH = 5  # straight at the goal
    SMASH_BANK_LEFT = 6
    SMASH_BANK_RIGHT = 7
    RECOVER = 8  # back behind a puck that has passed
    REACH = 9  # put the paddle where the puck is; only ever because an experimenter says so


class Situation(IntEnum):
    """What a person sees is going on."""

    AWAY = 0  # the puck is the opponent's
    COMING = 1  # on its way here
    OURS = 2  # in the own half and before the paddle
    BEHIND = 3  # in the own half and nearer to the own goal than the paddle


@njit(cache=True)
def situation_of(person, percept, paddle_x, table):
    """The `Situation` at a glance: the percept, as old as sight is late, moved on straight.

    `paddle_x` is where the own paddle is now, in m; its owner feels that.
    """
    vx = percept[PUCK + 2]
    x = percept[PUCK] + vx * person.sight_delay
    if x > 0.0:
        return Situation.COMING if vx < -person.still and x + vx * person.soon < 0.0 else Situation.AWAY
    if x < paddle_x and x > -table.length / 2:
        return Situation.BEHIND
    return Situation.AWAY if vx > person.leaving and x - paddle_x > person.out_of_reach else Situation.OURS


@njit(cache=True)
def wall_of(intention):
    """The side wall a smash takes."""
    if intention == Intention.SMASH_BANK_LEFT:
        return BANK_LEFT
    return BANK_RIGHT if intention == Intention.SMASH_BANK_RIGHT else DIRECT


@njit(cache=True)
def aim_y(person, mind, other_y, table):
    """Where in the opponent's goal a shot is meant to go, m: anywhere, but rather past the opponent's paddle."""
    mouth = table.goal / 2 - table.puck_radius
    past = clamp(-other_y / table.goal, -person.aim_past, person.aim_past)
    return mouth * clamp(person.aim_spread * mind.aim + past, -person.aim_widest, person.aim_widest)


@njit(cache=True)
def strike_speed(person, intention):
    """How fast the puck is meant to leave, m/s."""
    return (
        person.control_speed
        if intention == Intention.CONTROL
        else person.smash_slowest + person.smash_range * person.power
    )


@njit(cache=True)
def worth_of(person, row, open_straight):
    """What one row of the table `WORTHS` comes to for this person."""
    weight = person.worth[row]
    return (
        weight[0]
        + weight[1] * person.aggression
        + weight[2] * person.press
        + weight[3] * person.bank
        + weight[4] * person.shadow
        + weight[5] * open_straight
    )


@njit(cache=True)
def compute_utilities(person, mind, arm, percept, path, situation, threatened, table, worth):
    """Write what each intention is worth now into `worth` (INTENTIONS,); the impossible ones are worth nothing."""
    worth[:] = IMPOSSIBLE
    if situation == Situation.AWAY:
        worth[Intention.WAIT] = worth_of(person, AWAY_WAIT, 0.0)
        worth[Intention.SHADOW] = worth_of(person, AWAY_SHADOW, 0.0)
        worth[Intention.PRESS] = worth_of(person, AWAY_PRESS, 0.0)
    elif situation == Situation.BEHIND:
        worth[Intention.RECOVER] = worth_of(person, BEHIND_RECOVER, 0.0)
        if threatened:
            worth[Intention.BLOCK] = worth_of(person, BEHIND_BLOCK, 0.0)
    else:
        aim = aim_y(person, mind, percept[5], table)
        open_straight = min(abs(aim - percept[5]) / table.goal, 1.0)  # the opponent's paddle is not in the way
        moving = hypot(path[0, 2], path[0, 3]) > person.control_speed
        for intention in range(Intention.CONTROL, Intention.RECOVER):
            speed, wall = strike_speed(person, intention), wall_of(intention)
            _, contact = strike(
                person, arm, path, speed, wall, aim, person.soonest_strike, person.effort_to_begin, table
            )
            if np.isinf(contact):
                continue
            if intention == Intention.CONTROL:
                row = NEAR_CONTROL if moving else NEAR_CONTROL_AT_REST
            else:
                row = NEAR_SMASH if intention == Intention.SMASH else NEAR_BANK
            worth[intention] = worth_of(person, row, open_straight)
        if threatened:
            worth[Intention.BLOCK] = worth_of(person, NEAR_BLOCK, open_straight)
        else:
            worth[Intention.SHADOW] = worth_of(person, NEAR_SHADOW, open_straight)
    if worth[mind.intention] > IMPOSSIBLE:
        worth[mind.intention] += person.staying


@njit(cache=True)
def sample_softmax(worth, temperature, rng, index):
    """Draw an index of `worth` from its softmax at this temperature."""
    best = worth.max()
    total = 0.0
    for value in worth:
        total += exp((value - best) / temperature)
    left = total * random_unit(rng, index)
    for choice in range(len(worth)):
        left -= exp((worth[choice] - best) / temperature)
        if left < 0.0:
            return choice
    return worth.argmax()
