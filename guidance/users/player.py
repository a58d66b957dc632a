"""One tick of one person: see, decide, plan, move, feel. Compiled; `play` does it for everyone in one loop.

numba keeps the compiled code beside this file and does not notice a change in a module that this one imports: after
one, delete `guidance/users/__pycache__`.
"""

from math import hypot, log

import numpy as np
from numba import njit

from airhockey_marl.tables import random_unit
from guidance.users.arm import HAND_REACH, SUBSTEPS, begin_plan, draw_motor_noise, move_arm, rest
from guidance.users.geometry import (
    block,
    clamp,
    go_around,
    guard_x,
    strike,
    to_hand,
    to_table,
    unhurried,
)
from guidance.users.intention import (
    INTENTIONS,
    Intention,
    Situation,
    aim_y,
    appraise,
    choose,
    situation_of,
    strike_speed,
    wall_of,
)
from guidance.users.perception import LOOK_AHEAD, PUCK, foresee, misjudge, standard_normal
from guidance.users.rating import tally_force, tally_hindsight
from guidance.users.reaction import Variant, answer, learn_trust, shared_goal, stiffness_now


@njit(cache=True, inline="always")
def _ticks(seconds, tick):
    return int(seconds / tick + 0.5)


@njit(cache=True)
def begin_round(person, mind, arm, shadow):
    """The hand at rest at the centre, nothing seen or wanted; trust and co-contraction stay."""
    rest(arm, person)
    rest(shadow, person)
    mind.age = 0
    mind.intention = mind.next_intention = Intention.WAIT
    mind.switch_left = -1.0
    mind.dwell_left = np.inf
    mind.situation = -1
    mind.threatened = 0
    mind.aim = 0.0
    mind.sees_bounces = 1
    mind.strike_left = np.inf
    mind.speed_error = mind.heading_error = mind.bounce_error = 0.0
    mind.plan_left = np.inf
    mind.goal_x = mind.goal_y = 0.0
    mind.noise_left = mind.noise_along = mind.noise_across = 0.0
    mind.push_x = mind.push_y = mind.partner_x = mind.partner_y = 0.0


@njit(cache=True)
def decide(person, mind, arm, percept, situation, table, path, worth, rng, index):
    """Draw an intention; another one than the present becomes effective after the decision delay."""
    mind.sees_bounces = 1 if random_unit(rng, index) < person.bounce_insight else 0
    mind.threatened = foresee(person, mind, percept, person.sight_delay, table, path) >= 0
    appraise(person, mind, arm, percept, path, situation, mind.threatened, table, worth)
    drawn = choose(worth, person.choice_temperature, rng, index)
    waiting = -log(1.0 - random_unit(rng, index)) * person.idle
    mind.dwell_left = person.dwell + waiting if situation == Situation.AWAY else np.inf
    if drawn == mind.intention:
        mind.switch_left = -1.0
        if drawn <= Intention.PRESS:
            mind.aim = 2.0 * random_unit(rng, index) - 1.0
    elif mind.switch_left < 0.0 or drawn != mind.next_intention:
        mind.next_intention, mind.switch_left = drawn, person.decision_delay


@njit(cache=True)
def find_move(person, mind, arm, percept, path, table):
    """The move that this intention asks for, and the seconds until its contact with the puck; infinite without one."""
    intention = mind.intention
    home = guard_x(person, table)
    puck_x, puck_y = path[0, 0], path[0, 1]
    x, y = home, person.stray * mind.aim
    if intention == Intention.SHADOW:
        y = clamp(person.follow * puck_y + person.stray * mind.aim, -table.goal / 2, table.goal / 2)
    elif intention == Intention.PRESS:
        x = -person.press_at
        y = puck_y * (table.length / 2 + x) / max(table.length / 2 + puck_x, 0.5) + person.stray * mind.aim
    elif intention == Intention.BLOCK:
        x, y, comes = block(person, path, table)
        x, y, vx, vy, seconds = unhurried(person, arm, x, y, path, table)
        return (x, y, vx, vy, min(seconds, comes)), np.inf
    elif intention == Intention.RECOVER:
        paddle_x, paddle_y = to_table(arm.hand_x, arm.hand_y, table)
        x, y = go_around(person, paddle_x, paddle_y, puck_x, puck_y, table)
    elif intention != Intention.WAIT:
        goes_on = mind.strike_left < np.inf
        move, contact = strike(
            person,
            arm,
            path,
            strike_speed(person, intention),
            wall_of(intention),
            aim_y(person, mind, percept[5], table),
            max(mind.strike_left - person.strike_slack, person.soonest_correction)
            if goes_on
            else person.soonest_strike,
            person.effort_to_go_on if goes_on else person.effort_to_begin,
            table,
        )
        if contact < np.inf:
            return move, contact
        mind.dwell_left = 0.0  # it does not go: think again
        x, y, _ = block(person, path, table)
    return unhurried(person, arm, x, y, path, table), np.inf


@njit(cache=True)
def plan(person, mind, arm, shadow, percept, felt, variant, table, path, rng, index):
    """Look again, and plan the hand's way for the next plan period from where the hand is."""
    misjudge(person, mind, rng, index)
    timing = person.timing_noise * standard_normal(rng, index)
    threatened = foresee(person, mind, percept, person.sight_delay, table, path) >= 0
    if threatened and not mind.threatened:
        mind.dwell_left = 0.0
    mind.threatened = threatened
    (x, y, vx, vy, seconds), contact = find_move(person, mind, arm, percept, path, table)
    goal_x, goal_y = to_hand(x, y, table)
    mind.goal_x = clamp(goal_x, -HAND_REACH, HAND_REACH)
    mind.goal_y = clamp(goal_y, -HAND_REACH, HAND_REACH)
    mind.strike_left = contact
    mind.plan_left = person.plan_period
    if contact < np.inf:
        if contact - seconds > 0.0:  # a back-swing: the next plan is the swing
            mind.plan_left = min(mind.plan_left, seconds)
        elif contact < 1.5 * person.plan_period:  # too late to change it
            mind.plan_left = contact + person.carry_through
        seconds += timing
    gain_x, gain_y = to_hand(1.0 - table.length / 4, 1.0, table)
    goal_x, goal_y = mind.goal_x, mind.goal_y
    begin_plan(shadow, person, goal_x, goal_y, vx * gain_x, vy * gain_y, seconds)
    if variant == Variant.V2:
        goal_x, goal_y = shared_goal(person, mind, arm.hand_x, arm.hand_y, felt[0], felt[1])
    begin_plan(arm, person, goal_x, goal_y, vx * gain_x, vy * gain_y, seconds)


@njit(cache=True)
def think(person, mind, arm, shadow, percept, before, felt, variant, table, path, worth, rng, index):
    """Notice what happens, decide if it asks for it, and plan when it is time. `before` is the percept a tick older."""
    tick = table.tick
    paddle_x, _ = to_table(arm.hand_x, arm.hand_y, table)
    situation = situation_of(person, percept, paddle_x, table)
    kick = hypot(percept[PUCK + 2] - before[PUCK + 2], percept[PUCK + 3] - before[PUCK + 3])
    struck = mind.strike_left < -person.strike_over
    if struck:
        mind.strike_left = np.inf
    if situation != mind.situation or kick > person.kick or struck or mind.dwell_left <= 0.0:
        mind.situation = situation
        decide(person, mind, arm, percept, situation, table, path, worth, rng, index)
    if mind.switch_left >= 0.0:
        mind.switch_left -= tick
        if mind.switch_left < 0.0:
            mind.intention = mind.next_intention
            mind.aim = 2.0 * random_unit(rng, index) - 1.0
            mind.strike_left = np.inf
            mind.plan_left = 0.0
    if mind.plan_left < 0.5 * tick:
        plan(person, mind, arm, shadow, percept, felt, variant, table, path, rng, index)
    mind.plan_left -= tick
    mind.strike_left -= tick
    mind.dwell_left -= tick


@njit(cache=True)
def _perceived_force(person, felt, row, out):
    out[0], out[1] = felt[row, 0], felt[row, 1]
    if hypot(out[0], out[1]) < person.felt_from:
        out[0] = out[1] = 0.0


@njit(cache=True)
def play(people, minds, arms, tallies, seen, felt, partner, trail, state, force, variant, table, rng, action):
    """One tick of everyone.

    Args:
        people, minds, tallies: (n,) records.
        arms: (n, 2) records, the arm and its shadow.
        seen (n, ring, 12), felt (n, ring, 2), partner (n, ring, 2), trail (n, ring, 4): the last ticks of the
            states, the forces, the goals read from them, and the two hands; row `age % ring` is the present.
        state: (n, 12), force: (n, 2) N.
        variant: the `Variant`.
        table: the `Table`.
        rng: (n,) uint64, the people's streams.
        action: (n, 2) is written: the hand's position over its reach.
    """
    tick = table.tick
    dt = tick / SUBSTEPS
    ring = seen.shape[1]
    path, worth, now = np.empty((LOOK_AHEAD, 4)), np.empty(INTENTIONS), np.empty(2)
    for index in range(len(people)):
        person, mind, tally = people[index], minds[index], tallies[index]
        arm, shadow = arms[index, 0], arms[index, 1]
        age = mind.age
        row = age % ring
        seen[index, row] = state[index]
        felt[index, row] = force[index]

        touched = age - _ticks(person.touch_delay, tick)
        now[:] = 0.0
        if touched >= 0:
            _perceived_force(person, felt[index], touched % ring, now)
        looked = age - _ticks(person.sight_delay, tick)
        if looked >= 0:
            percept = seen[index, looked % ring]
            before = seen[index, max(looked - 1, 0) % ring]
            if looked == 0:
                mind.plan_left = 0.0
            think(person, mind, arm, shadow, percept, before, now, variant, table, path, worth, rng, index)

        answer(person, mind, arm.hand_x, arm.hand_y, now[0], now[1], variant, tick)
        stiffness = stiffness_now(person, mind)
        for _ in range(SUBSTEPS):
            draw_motor_noise(person, mind, dt, rng, index)
            move_arm(arm, person, mind, stiffness, mind.push_x, mind.push_y, force[index, 0], force[index, 1], dt)
            move_arm(shadow, person, mind, person.stiffness, 0.0, 0.0, 0.0, 0.0, dt)

        trail[index, row, 0], trail[index, row, 1] = arm.hand_x, arm.hand_y
        trail[index, row, 2], trail[index, row, 3] = shadow.hand_x, shadow.hand_y
        partner[index, row, 0] = arm.hand_x + now[0] / person.believed_stiffness
        partner[index, row, 1] = arm.hand_y + now[1] / person.believed_stiffness
        meant = age - _ticks(person.believed_ahead, tick)
        if meant >= 0 and variant == Variant.V2:
            old = meant % ring
            believed = touched - _ticks(person.believed_ahead, tick)
            if (
                believed >= 0
                and hypot(felt[index, believed % ring, 0], felt[index, believed % ring, 1]) >= person.felt_from
            ):
                learn_trust(person, mind, partner[index, old, 0], partner[index, old, 1], arm.hand_x, arm.hand_y, tick)
        last = felt[index, (age - 1) % ring] if age > 0 else felt[index, row]
        tally_force(tally, person, mind, arm, shadow, now, force[index], last, tick)
        if age >= _ticks(person.hindsight_after, tick):
            tally_hindsight(tally, mind, trail[index, (age - _ticks(person.hindsight_after, tick)) % ring])
        mind.age = age + 1
        action[index, 0] = clamp(arm.hand_x / HAND_REACH, -1.0, 1.0)
        action[index, 1] = clamp(arm.hand_y / HAND_REACH, -1.0, 1.0)
