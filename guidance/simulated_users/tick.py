"""The tick: one person perceives, chooses an intention, plans, moves and responds to the force, in this order.

Compiled; `step_users` runs it for everyone in one loop. `person`, `state` and `arm` are records of `USER_PARAMETERS`,
`USER_STATE` and `ARM_STATE`; `rng[index]` is the person's random number generator.

numba caches the compiled code beside this file and does not notice a change in a module that this one imports: after
one, delete `guidance/simulated_users/__pycache__`.
"""

from math import exp, hypot, log

import numpy as np
from numba import njit

from airhockey_marl.envs.world import random_unit
from guidance.simulated_users.adaptation import expected_force, learn
from guidance.simulated_users.advisors import advised_action
from guidance.simulated_users.arm import (
    HAND_REACH,
    NO_NOISE,
    SUBSTEPS,
    begin_plan,
    draw_motor_noise,
    estimate_state,
    move_arm,
    planned_velocity,
    reset_arm,
    reset_forward_model,
    write_prediction_error,
)
from guidance.simulated_users.force_response import (
    Variant,
    agreement,
    current_stiffness,
    respond_to_force,
    shared_goal,
    update_trust,
)
from guidance.simulated_users.intention import (
    IMPOSSIBLE,
    INTENTIONS,
    NO_INSTRUCTION,
    Intention,
    Situation,
    classify_situation,
    compute_utilities,
    find_move,
    sample_softmax,
)
from guidance.simulated_users.perception import (
    LOOK_AHEAD,
    OWN,
    PUCK,
    predict_puck,
    puck_jumps,
    standard_normal,
    update_percept_noise,
)
from guidance.simulated_users.ratings import add_rating_signals
from guidance.simulated_users.state import Scratch
from guidance.simulated_users.strokes import clamp, hand_gain, to_hand, to_table


@njit(cache=True)
def reset_users(arrays, mask):
    """Begin a round for the people of the mask (n,): hand at the center, no percept, no plan.

    Trust stays, and so does what has been learned: people go on with the same force in mind.
    """
    for index in range(len(mask)):
        if mask[index]:
            _reset_state(arrays.states[index])
            for arm in range(arrays.arms.shape[1]):
                reset_arm(arrays.arms[index, arm], arrays.people[index])
            arrays.actions[index, 0] = arrays.actions[index, 1] = 0.0


@njit(cache=True)
def _reset_state(state):
    state.age = 0
    state.intention = state.next_intention = Intention.WAIT
    state.time_to_switch = -1.0
    state.time_to_reconsider = np.inf
    state.situation = -1
    state.goal_threatened = 0
    state.aim_offset = state.depth_offset = 0.0
    state.anticipates_bounces = 1
    state.time_to_contact = np.inf
    state.speed_error = state.heading_error = state.bounce_error = 0.0
    state.time_to_replan = np.inf
    state.goal_x = state.goal_y = 0.0
    state.time_to_noise_draw = state.noise_along = state.noise_across = state.tremor_x = state.tremor_y = 0.0
    state.push_x = state.push_y = 0.0


@njit(cache=True)
def draw_offsets(state, rng, index):
    """Draw where to aim and where to stand."""
    state.aim_offset = 2.0 * random_unit(rng, index) - 1.0
    state.depth_offset = 2.0 * random_unit(rng, index) - 1.0


@njit(cache=True)
def choose_intention(person, state, arm, percept, situation, setting, scratch, rng, index):
    """Draw an intention; one other than the present becomes effective after the decision delay."""
    state.anticipates_bounces = 1 if random_unit(rng, index) < person.bounce_anticipation else 0
    state.goal_threatened = predict_puck(person, state, percept, person.visual_delay, setting.table, scratch.path) >= 0
    compute_utilities(person, state, arm, percept, scratch.path, situation, setting.table, scratch.utilities)
    add_advisor_utilities(person, state, arm, percept, setting, scratch)
    choice = sample_softmax(scratch.utilities, person.choice_temperature, rng, index)
    delay_factor = exp(person.delay_noise * standard_normal(rng, index))
    waiting = -log(1.0 - random_unit(rng, index)) * person.reconsider_time
    state.time_to_reconsider = person.dwell + waiting if situation == Situation.AWAY else np.inf
    if choice == state.intention:
        state.time_to_switch = -1.0
        if choice <= Intention.PRESS:
            draw_offsets(state, rng, index)
    elif state.time_to_switch < 0.0 or choice != state.next_intention:
        state.next_intention, state.time_to_switch = choice, person.decision_delay * delay_factor


@njit(cache=True)
def add_advisor_utilities(person, state, arm, percept, setting, scratch):
    """Add to each possible intention's utility how well its move agrees with the advisor's, -1 to 1 of the weight.

    The advisor is a generation of a league, a later one for a more skilled person; its observation is the situation as
    this person perceives it.
    """
    table = setting.table
    if len(setting.advisors.weights) == 0 or person.advisor_weight == 0.0:
        return
    paddle_x, paddle_y = to_table(arm.estimate_x, arm.estimate_y, table)
    gain_x, gain_y = hand_gain(table)
    observation = percept.copy()
    observation[OWN], observation[OWN + 1] = paddle_x, paddle_y
    observation[OWN + 2], observation[OWN + 3] = arm.estimate_v_x / gain_x, arm.estimate_v_y / gain_y
    observation[PUCK : PUCK + 4] = scratch.path[0]
    advised_x, advised_y = advised_action(setting.advisors, person.skill, observation)
    offset_x, offset_y = HAND_REACH * advised_x - arm.estimate_x, HAND_REACH * advised_y - arm.estimate_y
    present = state.intention
    for intention in range(INTENTIONS):
        if scratch.utilities[intention] > IMPOSSIBLE:
            state.intention = intention
            (x, y, _, _, _), _ = find_move(person, state, arm, percept, scratch.path, table)
            goal_x, goal_y = to_hand(x, y, table)
            support, conflict = agreement(person, offset_x, offset_y, goal_x - arm.estimate_x, goal_y - arm.estimate_y)
            size = max(hypot(offset_x, offset_y), person.goal_radius)
            scratch.utilities[intention] += person.advisor_weight * (support - conflict) / size
    state.intention = present


@njit(cache=True)
def plan(person, state, arms, percept, setting, scratch, rng, index):
    """Predict the puck again, and plan the hand's motion from its present estimate."""
    table = setting.table
    arm, shadow = arms[0], arms[1]
    update_percept_noise(person, state, rng, index)
    timing_error = person.timing_noise * standard_normal(rng, index)
    threatened = predict_puck(person, state, percept, person.visual_delay, table, scratch.path) >= 0
    if threatened and not state.goal_threatened:
        state.time_to_reconsider = 0.0
    state.goal_threatened = threatened
    (x, y, vx, vy, seconds), contact = find_move(person, state, arm, percept, scratch.path, table)
    goal_x, goal_y = to_hand(x, y, table)
    state.goal_x = clamp(goal_x, -HAND_REACH, HAND_REACH)
    state.goal_y = clamp(goal_y, -HAND_REACH, HAND_REACH)
    state.time_to_contact = contact
    state.time_to_replan = person.plan_period
    if contact < np.inf:
        if contact - seconds > 0.0:  # a back-swing: the next plan is the swing
            state.time_to_replan = min(state.time_to_replan, seconds)
        elif contact < 1.5 * person.plan_period:  # too late for a correction
            state.time_to_replan = contact + person.follow_through_time
        seconds += timing_error
    gain_x, gain_y = hand_gain(table)
    goal_x, goal_y = state.goal_x, state.goal_y
    begin_plan(shadow, person, goal_x, goal_y, vx * gain_x, vy * gain_y, seconds)
    if setting.variant == Variant.goal_sharing:
        force = scratch.force
        goal_x, goal_y = shared_goal(person, state, arm.estimate_x, arm.estimate_y, force[0], force[1])
    begin_plan(arm, person, goal_x, goal_y, vx * gain_x, vy * gain_y, seconds)
    reset_forward_model(arms[2], arm)
    reset_forward_model(arms[3], shadow)


@njit(cache=True)
def update(person, state, arms, percept, previous, setting, scratch, rng, index):
    """One cognitive update: detect events, choose an intention, replan. `previous` is the percept a tick older."""
    arm, tick = arms[0], setting.table.tick
    paddle_x, _ = to_table(arm.estimate_x, arm.estimate_y, setting.table)
    situation = classify_situation(person, percept, paddle_x, setting.table)
    event = puck_jumps(person, percept, previous, tick)
    strike_ended = state.time_to_contact < -person.strike_timeout
    if strike_ended:
        state.time_to_contact = np.inf
    if state.instruction == NO_INSTRUCTION:
        if situation != state.situation or event or strike_ended or state.time_to_reconsider <= 0.0:
            state.situation = situation
            choose_intention(person, state, arm, percept, situation, setting, scratch, rng, index)
    elif state.intention != state.instruction and state.time_to_switch < 0.0 and event:  # nothing to choose
        delay_factor = exp(person.delay_noise * standard_normal(rng, index))
        state.next_intention, state.time_to_switch = state.instruction, person.response_delay * delay_factor
    if state.time_to_switch >= 0.0:
        state.time_to_switch -= tick
        if state.time_to_switch < 0.0:
            state.intention = state.next_intention
            draw_offsets(state, rng, index)
            state.time_to_contact = np.inf
            state.time_to_replan = 0.0
    if state.time_to_replan < 0.5 * tick:
        plan(person, state, arms, percept, setting, scratch, rng, index)
    state.time_to_replan -= tick
    state.time_to_contact -= tick
    state.time_to_reconsider -= tick


@njit(cache=True)
def expect(person, state, arm):
    """Forces (x, y) in N that are expected where the plan is after the muscle lag, and where it is now.

    The push makes up for the first one. The second one is in the forward model, as in people who have learned a force
    (Wagner & Smith 2008): without it the estimate of the hand would follow the push alone.
    """
    then_x, then_y = planned_velocity(arm, person, arm.plan_age + person.muscle_lag)
    now_x, now_y = planned_velocity(arm, person, arm.plan_age)
    return expected_force(person, state, then_x, then_y), expected_force(person, state, now_x, now_y)


@njit(cache=True, inline="always")
def _to_ticks(seconds, tick):
    return int(seconds / tick + 0.5)


@njit(cache=True)
def _feels(person, force):
    return hypot(force[0], force[1]) >= person.force_threshold


@njit(cache=True, nogil=True)
def step_users(rows, arrays, observation, force, setting):
    """Run one tick of the people in `rows` (k,) int64; for the others time stands still.

    Args:
        arrays: `UserArrays`; its `actions` are written.
        observation: (n, 12).
        force: (n, 2) N.
        setting: `Setting`.
    """
    variant, tick = setting.variant, setting.table.tick
    dt = tick / SUBSTEPS
    ring = arrays.observations.shape[1]
    rng = arrays.streams
    scratch = Scratch(np.empty((LOOK_AHEAD, 4)), np.empty(INTENTIONS), np.empty(2))
    for index in rows:
        person, state, sums = arrays.people[index], arrays.states[index], arrays.sums[index]
        arms = arrays.arms[index]
        arm, shadow, arm_model, shadow_model = arms[0], arms[1], arms[2], arms[3]
        observations, forces, errors = arrays.observations[index], arrays.forces[index], arrays.prediction_errors[index]
        partner_goals, velocities = arrays.partner_goals[index], arrays.velocities[index]
        age = state.age
        row = age % ring
        observations[row] = observation[index]
        forces[row] = force[index]
        velocities[row, 0], velocities[row, 1] = arm.hand_v_x, arm.hand_v_y
        last_force = forces[(age - 1) % ring] if age > 0 else forces[row]
        add_rating_signals(sums, person, state, arm, shadow, forces[row], last_force, observations[row], setting.table)

        # proprioception
        felt_row = max(age - _to_ticks(person.proprioceptive_delay, tick), 0) % ring
        write_prediction_error(arm, arm_model, errors[row, 0])
        write_prediction_error(shadow, shadow_model, errors[row, 1])
        estimate_state(arm, arm_model, errors[felt_row, 0])
        estimate_state(shadow, shadow_model, errors[felt_row, 1])

        # touch
        touch_age = age - _to_ticks(person.tactile_delay, tick)
        scratch.force[:] = 0.0
        if touch_age >= 0 and _feels(person, forces[touch_age % ring]):
            scratch.force[:] = forces[touch_age % ring]

        # vision, choice and planning
        sight_age = age - _to_ticks(person.visual_delay, tick)
        if sight_age >= 0:
            percept = observations[sight_age % ring]
            previous = observations[max(sight_age - 1, 0) % ring]
            if sight_age == 0:
                state.time_to_replan = 0.0
            update(person, state, arms, percept, previous, setting, scratch, rng, index)

        # adaptation and response to the force
        force_x, force_y = scratch.force[0], scratch.force[1]
        surprise, ahead, now = (force_x, force_y), (0.0, 0.0), (0.0, 0.0)
        if setting.adapts:
            if touch_age >= 0:
                felt_at = velocities[touch_age % ring]
                surprise = learn(person, state, felt_at[0], felt_at[1], force_x, force_y, tick)
            ahead, now = expect(person, state, arm)
        hand = (arm.hand_x, arm.hand_y)
        respond_to_force(person, state, hand, (force_x, force_y), surprise, ahead, setting.adapts, variant, tick)

        # motion
        stiffness = current_stiffness(person, state)
        for _ in range(SUBSTEPS):
            draw_motor_noise(person, state, dt, rng, index)
            noise = (state.noise_along, state.noise_across, state.tremor_x, state.tremor_y)
            push_x, push_y = state.push_x, state.push_y
            move_arm(arm, person, noise, stiffness, push_x, push_y, force[index, 0], force[index, 1], dt)
            move_arm(shadow, person, noise, person.stiffness, 0.0, 0.0, 0.0, 0.0, dt)
            move_arm(arm_model, person, NO_NOISE, stiffness, push_x, push_y, now[0], now[1], dt)
            move_arm(shadow_model, person, NO_NOISE, person.stiffness, 0.0, 0.0, 0.0, 0.0, dt)

        # trust in the partner whose goal the force tells
        partner_goals[row, 0] = arm.hand_x + force_x / person.partner_stiffness
        partner_goals[row, 1] = arm.hand_y + force_y / person.partner_stiffness
        goal_age = age - _to_ticks(person.partner_lead_time, tick)
        force_age = touch_age - _to_ticks(person.partner_lead_time, tick)
        if variant == Variant.goal_sharing and force_age >= 0 and _feels(person, forces[force_age % ring]):
            goal = partner_goals[goal_age % ring]
            update_trust(person, state, goal[0], goal[1], arm.hand_x, arm.hand_y, tick)

        state.age = age + 1
        arrays.actions[index, 0] = clamp(arm.hand_x / HAND_REACH, -1.0, 1.0)
        arrays.actions[index, 1] = clamp(arm.hand_y / HAND_REACH, -1.0, 1.0)
