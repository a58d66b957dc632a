"""What a person means to do: one of nine intentions, drawn from a softmax over what each is worth to them.

Worth is in 0..1 or so and comes from the playstyle traits; the numbers in it are assumptions [A]. An intention is
private: it is not part of the state that anyone else sees.
"""

from enum import IntEnum
from math import exp, hypot

import numpy as np
from numba import njit

from airhockey_marl.tables import random_unit
from guidance.users.geometry import (
    BANK_LEFT,
    BANK_RIGHT,
    CONTROL_SPEED,
    DIRECT,
    SMASH_RANGE,
    SMASH_SLOWEST,
    SOONEST_STRIKE,
    strike,
)
from guidance.users.perception import PUCK

INTENTIONS = 9
STAYS = 0.15  # worth of going on with the present intention
IMPOSSIBLE = -1e9


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


class Situation(IntEnum):
    """What a person sees is going on."""

    AWAY = 0  # the puck is the opponent's
    COMING = 1  # on its way here
    OURS = 2  # in the own half and before the paddle
    BEHIND = 3  # in the own half and nearer to the own goal than the paddle


@njit(cache=True)
def situation_of(percept, delay, paddle_x, table):
    """The `Situation` at a glance: the percept of `delay` seconds ago moved on straight.

    `paddle_x` is where the own paddle is now, in m; its owner feels that.
    """
    vx = percept[PUCK + 2]
    x = percept[PUCK] + vx * delay
    if x > 0.0:
        return Situation.COMING if vx < -0.1 and x + 1.0 * vx < 0.0 else Situation.AWAY
    if x < paddle_x and x > -table.length / 2:
        return Situation.BEHIND
    return Situation.AWAY if vx > 0.35 and x - paddle_x > 0.1 else Situation.OURS


@njit(cache=True)
def wall_of(intention):
    """The side wall a smash takes."""
    if intention == Intention.SMASH_BANK_LEFT:
        return BANK_LEFT
    return BANK_RIGHT if intention == Intention.SMASH_BANK_RIGHT else DIRECT


@njit(cache=True)
def aim_y(mind, other_y, table):
    """Where in the opponent's goal a shot is meant to go, m: anywhere, but rather past the opponent's paddle."""
    mouth = table.goal / 2 - table.puck_radius
    past = min(max(-other_y / table.goal, -0.5), 0.5)
    return mouth * min(max(0.6 * mind.aim + past, -0.9), 0.9)


@njit(cache=True)
def strike_speed(person, intention):
    """How fast the puck is meant to leave, m/s."""
    return CONTROL_SPEED if intention == Intention.CONTROL else SMASH_SLOWEST + SMASH_RANGE * person.power


@njit(cache=True)
def appraise(person, mind, arm, percept, path, situation, threatened, table, worth):
    """Write what each intention is worth now into `worth` (INTENTIONS,); the impossible ones are worth nothing."""
    worth[:] = IMPOSSIBLE
    if situation == Situation.AWAY:
        worth[Intention.WAIT] = 1.0 - person.shadow
        worth[Intention.SHADOW] = person.shadow
        worth[Intention.PRESS] = 1.5 * person.press - 0.3
    elif situation == Situation.BEHIND:
        worth[Intention.RECOVER] = 1.0
        if threatened:
            worth[Intention.BLOCK] = 0.9
    else:
        caution = 1.0 - person.aggression
        aim = aim_y(mind, percept[5], table)
        open_straight = min(abs(aim - percept[5]) / table.goal, 1.0)  # the opponent's paddle is not in the way
        for intention in range(Intention.CONTROL, Intention.RECOVER):
            _, contact = strike(
                person, arm, path, strike_speed(person, intention), wall_of(intention), aim, SOONEST_STRIKE, 1.2, table
            )
            if np.isinf(contact):
                continue
            if intention == Intention.CONTROL:
                worth[intention] = 0.7 * caution if hypot(path[0, 2], path[0, 3]) > CONTROL_SPEED else -0.2
            elif intention == Intention.SMASH:
                worth[intention] = 0.3 + 0.5 * person.aggression + 0.4 * open_straight - 0.6 * person.bank
            else:
                worth[intention] = 0.1 + 0.5 * person.aggression + 0.7 * person.bank - 0.2 * open_straight
        if threatened:
            worth[Intention.BLOCK] = 0.4 + 0.7 * caution
        else:
            worth[Intention.SHADOW] = 0.2 * caution
    if worth[mind.intention] > IMPOSSIBLE:
        worth[mind.intention] += STAYS


@njit(cache=True)
def choose(worth, temperature, rng, index):
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
