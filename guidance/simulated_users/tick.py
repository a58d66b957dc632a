"""One tick of one person: see, decide, plan, move, feel. Compiled; `play` does it for everyone in one loop.

numba keeps the compiled code beside this file and does not notice a change in a module that this one imports: after
one, delete `guidance/users/__pycache__`.
"""

from math import exp, hypot, log

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.advisors import advised_action
from guidance.simulated_users.arm import (
    HAND_REACH,
    STEADY,
    SUBSTEPS,
    begin_plan,
    draw_motor_noise,
    estimate_state,
    move_arm,
    reset_forward_model,
    rest,
    unexpected,
)
from guidance.simulated_users.force_response import (
    Variant,
    agreement,
    learn_trust,
    respond_to_force,
    shared_goal,
    stiffness_now,
)
from guidance.simulated_users.intention import (
    IMPOSSIBLE,
    INTENTIONS,
    NOTHING,
    Intention,
    Situation,
    aim_y,
    compute_utilities,
    sample_softmax,
    situation_of,
    strike_speed,
    wall_of,
)
from guidance.simulated_users.perception import (
    LOOK_AHEAD,
    OWN,
    PUCK,
    predict_puck,
    standard_normal,
    surprising,
    update_percept_noise,
)
from guidance.simulated_users.ratings import tally_force, tally_hindsight
from guidance.simulated_users.strokes import (
    block,
    clamp,
    go_around,
    guard_x,
    move_seconds,
    strike,
    to_hand,
    to_table,
    unhurried,
)


@njit(cache=True, inline="always")
def _ticks(seconds, tick):
    return int(seconds / tick + 0.5)


@njit(cache=True)
def begin_round(person, mind, arms):
    """The hand at rest at the center, nothing seen or wanted; trust and co-contraction stay."""
    for index in range(len(arms)):
        rest(arms[index], person)
    mind.age = 0
    mind.intention = mind.next_intention = Intention.WAIT
    mind.switch_left = -1.0
    mind.dwell_left = np.inf
    mind.situation = -1
    mind.threatened = 0
    mind.aim = mind.depth = 0.0
    mind.sees_bounces = 1
    mind.strike_left = np.inf
    mind.speed_error = mind.heading_error = mind.bounce_error = 0.0
    mind.plan_left = np.inf
    mind.goal_x = mind.goal_y = 0.0
    mind.noise_left = mind.noise_along = mind.noise_across = mind.tremor_x = mind.tremor_y = 0.0
    mind.push_x = mind.push_y = mind.partner_x = mind.partner_y = 0.0


@njit(cache=True)
def begin_rounds(people, minds, arms, tallies, action, which):
    """`begin_round` for those of the mask `which` (n,); no force is expected, and the hand is at the middle."""
    for index in range(len(people)):
        if which[index]:
            begin_round(people[index], minds[index], arms[index])
            tallies[index].expected_x = tallies[index].expected_y = 0.0
            action[index, 0] = action[index, 1] = 0.0


@njit(cache=True)
def aim_anew(mind, rng, index):
    """Draw where to aim, and where to stand."""
    mind.aim = 2.0 * random_unit(rng, index) - 1.0
    mind.depth = 2.0 * random_unit(rng, index) - 1.0


@njit(cache=True)
def decide(person, mind, arm, percept, situation, advisors, table, path, worth, rng, index):
    """Draw an intention; another one than the present becomes effective after the decision delay."""
    mind.sees_bounces = 1 if random_unit(rng, index) < person.bounce_insight else 0
    mind.threatened = predict_puck(person, mind, percept, person.sight_delay, table, path) >= 0
    compute_utilities(person, mind, arm, percept, path, situation, mind.threatened, table, worth)
    take_advice(person, mind, arm, percept, advisors, table, path, worth)
    drawn = sample_softmax(worth, person.choice_temperature, rng, index)
    unsteady = exp(person.delay_noise * standard_normal(rng, index))
    waiting = -log(1.0 - random_unit(rng, index)) * person.idle
    mind.dwell_left = person.dwell + waiting if situation == Situation.AWAY else np.inf
    if drawn == mind.intention:
        mind.switch_left = -1.0
        if drawn <= Intention.PRESS:
            aim_anew(mind, rng, index)
    elif mind.switch_left < 0.0 or drawn != mind.next_intention:
        mind.next_intention, mind.switch_left = drawn, person.decision_delay * unsteady


@njit(cache=True)
def take_advice(person, mind, arm, percept, advisors, table, path, worth):
    """Add to the `worth` (INTENTIONS,) of each intention how far it goes where an advisor would go, -1 to 1 of `advice`.

    The advisor is a generation of a league, the later the more skilled the person is; it is asked about the situation as
    this person sees it.
    """
    if len(advisors.weights) == 0 or person.advice == 0.0:
        return
    paddle_x, paddle_y = to_table(arm.sensed_x, arm.sensed_y, table)
    gain_x, gain_y = to_hand(1.0 - table.length / 4, 1.0, table)
    seen = percept.copy()
    seen[OWN], seen[OWN + 1] = paddle_x, paddle_y
    seen[OWN + 2], seen[OWN + 3] = arm.sensed_v_x / gain_x, arm.sensed_v_y / gain_y
    seen[PUCK : PUCK + 4] = path[0]
    advised_x, advised_y = advised_action(advisors, person.skill, seen)
    away_x, away_y = HAND_REACH * advised_x - arm.sensed_x, HAND_REACH * advised_y - arm.sensed_y
    present = mind.intention
    for intention in range(INTENTIONS):
        if worth[intention] > IMPOSSIBLE:
            mind.intention = intention
            (x, y, _, _, _), _ = find_move(person, mind, arm, percept, path, table)
            goal_x, goal_y = to_hand(x, y, table)
            support, conflict = agreement(person, away_x, away_y, goal_x - arm.sensed_x, goal_y - arm.sensed_y)
            worth[intention] += person.advice * (support - conflict) / max(hypot(away_x, away_y), person.aim_size)
    mind.intention = present


@njit(cache=True)
def find_move(person, mind, arm, percept, path, table):
    """The move that this intention asks for, and the seconds until its contact with the puck; infinite without one."""
    intention = mind.intention
    home = guard_x(person, table)
    puck_x, puck_y = path[0, 0], path[0, 1]
    x, y = home + 0.5 * person.stray * mind.depth, person.stray * mind.aim
    if intention == Intention.SHADOW:
        y = clamp(person.follow * puck_y, -table.goal / 2, table.goal / 2) + person.stray * mind.aim
    elif intention == Intention.PRESS:
        x = -person.press_at - person.stray * (1.0 + mind.depth)
        y = puck_y * (table.length / 2 + x) / max(table.length / 2 + puck_x, 0.5) + person.stray * mind.aim
    elif intention == Intention.BLOCK:
        x, y, comes = block(person, path, table)
        x, y, vx, vy, seconds = unhurried(person, arm, x, y, path, table)
        return (x, y, vx, vy, min(seconds, comes)), np.inf
    elif intention == Intention.REACH:
        x, y = clamp(puck_x, -table.length / 2, 0.0), puck_y
        seconds = move_seconds(person, arm.sensed_x, arm.sensed_y, x, y, table) + person.muscle_lag
        return (x, y, 0.0, 0.0, seconds), np.inf
    elif intention == Intention.RECOVER:
        paddle_x, paddle_y = to_table(arm.sensed_x, arm.sensed_y, table)
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
def plan(person, mind, arms, percept, felt, variant, table, path, rng, index):
    """Look again, and plan the hand's way for the next plan period from where the hand is."""
    arm, shadow = arms[0], arms[1]
    update_percept_noise(person, mind, rng, index)
    timing = person.timing_noise * standard_normal(rng, index)
    threatened = predict_puck(person, mind, percept, person.sight_delay, table, path) >= 0
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
    if variant == Variant.goal_sharing:
        goal_x, goal_y = shared_goal(person, mind, arm.sensed_x, arm.sensed_y, felt[0], felt[1])
    begin_plan(arm, person, goal_x, goal_y, vx * gain_x, vy * gain_y, seconds)
    reset_forward_model(arms[2], arm)
    reset_forward_model(arms[3], shadow)


@njit(cache=True)
def update(person, mind, arms, percept, before, felt, variant, advisors, table, path, worth, rng, index):
    """Notice what happens, decide if it asks for it, and plan when it is time. `before` is the percept a tick older."""
    arm, tick = arms[0], table.tick
    paddle_x, _ = to_table(arm.sensed_x, arm.sensed_y, table)
    situation = situation_of(person, percept, paddle_x, table)
    event = surprising(person, percept, before, tick)
    struck = mind.strike_left < -person.strike_over
    if struck:
        mind.strike_left = np.inf
    if mind.told == NOTHING:
        if situation != mind.situation or event or struck or mind.dwell_left <= 0.0:
            mind.situation = situation
            decide(person, mind, arm, percept, situation, advisors, table, path, worth, rng, index)
    elif mind.intention != mind.told and mind.switch_left < 0.0 and event:  # the signal to begin; nothing to choose
        unsteady = exp(person.delay_noise * standard_normal(rng, index))
        mind.next_intention, mind.switch_left = mind.told, person.decision_floor * unsteady
    if mind.switch_left >= 0.0:
        mind.switch_left -= tick
        if mind.switch_left < 0.0:
            mind.intention = mind.next_intention
            aim_anew(mind, rng, index)
            mind.strike_left = np.inf
            mind.plan_left = 0.0
    if mind.plan_left < 0.5 * tick:
        plan(person, mind, arms, percept, felt, variant, table, path, rng, index)
    mind.plan_left -= tick
    mind.strike_left -= tick
    mind.dwell_left -= tick


@njit(cache=True)
def _perceived_force(person, felt, row, out):
    out[0], out[1] = felt[row, 0], felt[row, 1]
    if hypot(out[0], out[1]) < person.force_threshold:
        out[0] = out[1] = 0.0


@njit(cache=True, nogil=True)
def play(
    rows,
    people,
    minds,
    arms,
    tallies,
    seen,
    felt,
    off,
    partner,
    trail,
    advisors,
    state,
    force,
    variant,
    table,
    rng,
    action,
):
    """One tick of everyone.

    Args:
        rows: (k,) int64, who lives through it; for the others time stands still.
        people, minds, tallies: (n,) records.
        arms: (n, 4) records: the arm, its shadow, and the forward model of each.
        seen (n, ring, 12), felt (n, ring, 2), off (n, ring, 2, 4), partner (n, ring, 2), trail (n, ring, 4): the last
            ticks of the states, the forces, what the two hands' models do not explain, the goals read from the forces,
            and the two hands; row `age % ring` is the present.
        advisors: `Advisors`.
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
    for index in rows:
        person, mind, tally = people[index], minds[index], tallies[index]
        arm, shadow, arm_model, shadow_model = arms[index, 0], arms[index, 1], arms[index, 2], arms[index, 3]
        age = mind.age
        row = age % ring
        seen[index, row] = state[index]
        felt[index, row] = force[index]

        felt_late = max(age - _ticks(person.proprioceptive_delay, tick), 0) % ring
        unexpected(arm, arm_model, off[index, row, 0])
        unexpected(shadow, shadow_model, off[index, row, 1])
        estimate_state(arm, arm_model, off[index, felt_late, 0])
        estimate_state(shadow, shadow_model, off[index, felt_late, 1])

        touched = age - _ticks(person.tactile_delay, tick)
        now[:] = 0.0
        if touched >= 0:
            _perceived_force(person, felt[index], touched % ring, now)
        looked = age - _ticks(person.sight_delay, tick)
        if looked >= 0:
            percept = seen[index, looked % ring]
            before = seen[index, max(looked - 1, 0) % ring]
            if looked == 0:
                mind.plan_left = 0.0
            update(person, mind, arms[index], percept, before, now, variant, advisors, table, path, worth, rng, index)

        respond_to_force(person, mind, arm.hand_x, arm.hand_y, now[0], now[1], variant, tick)
        stiffness = stiffness_now(person, mind)
        for _ in range(SUBSTEPS):
            draw_motor_noise(person, mind, dt, rng, index)
            noise = (mind.noise_along, mind.noise_across, mind.tremor_x, mind.tremor_y)
            push_x, push_y = mind.push_x, mind.push_y
            move_arm(arm, person, noise, stiffness, push_x, push_y, force[index, 0], force[index, 1], dt)
            move_arm(shadow, person, noise, person.stiffness, 0.0, 0.0, 0.0, 0.0, dt)
            move_arm(arm_model, person, STEADY, stiffness, push_x, push_y, 0.0, 0.0, dt)
            move_arm(shadow_model, person, STEADY, person.stiffness, 0.0, 0.0, 0.0, 0.0, dt)

        trail[index, row, 0], trail[index, row, 1] = arm.hand_x, arm.hand_y
        trail[index, row, 2], trail[index, row, 3] = shadow.hand_x, shadow.hand_y
        partner[index, row, 0] = arm.hand_x + now[0] / person.believed_stiffness
        partner[index, row, 1] = arm.hand_y + now[1] / person.believed_stiffness
        meant = age - _ticks(person.believed_ahead, tick)
        if meant >= 0 and variant == Variant.goal_sharing:
            old = meant % ring
            believed = touched - _ticks(person.believed_ahead, tick)
            if (
                believed >= 0
                and hypot(felt[index, believed % ring, 0], felt[index, believed % ring, 1]) >= person.force_threshold
            ):
                learn_trust(person, mind, partner[index, old, 0], partner[index, old, 1], arm.hand_x, arm.hand_y, tick)
        last = felt[index, (age - 1) % ring] if age > 0 else felt[index, row]
        tally_force(tally, person, mind, arm, shadow, now, force[index], last, tick)
        if age >= _ticks(person.hindsight_after, tick):
            tally_hindsight(tally, mind, trail[index, (age - _ticks(person.hindsight_after, tick)) % ring])
        mind.age = age + 1
        action[index, 0] = clamp(arm.hand_x / HAND_REACH, -1.0, 1.0)
        action[index, 1] = clamp(arm.hand_y / HAND_REACH, -1.0, 1.0)
