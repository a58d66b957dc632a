"""The arm: a minimum-acceleration plan, motor noise, and mechanics that a force can push.

Meters of the hand, newtons, seconds. Compiled; `arm` is a record of `ARM_STATE`, `person` one of `USER_PARAMETERS`,
`state` one of `USER_STATE`.
"""

from math import exp, hypot, sqrt

import numpy as np
from numba import njit

from guidance.simulated_users.perception import standard_normal

HAND_REACH = 0.075  # m of hand travel for |action| = 1, the workspace of an Omega.7: beyond is a stop
SUBSTEPS = 5  # of the arm in one tick
SHORTEST_PLAN = 0.04  # s, of a cubic; two ticks

# An arm; these fields are pairs, x and y. `ref` is the plan as executed, with motor noise. `estimate` is the person's
# estimate of the hand's position, `correction` the sum of the corrections of its forward model so far.
_PAIRS = (
    *("hand", "hand_v", "muscle", "ref", "start_v", "initial_acceleration", "c2", "c3", "end_v"),
    *("correction", "correction_v", "estimate", "estimate_v"),
)
ARM_STATE = np.dtype(
    [(name + axis, np.float64) for name in _PAIRS for axis in ("_x", "_y")]
    + [("plan_seconds", np.float64), ("plan_age", np.float64)]
)


NO_NOISE = (0.0, 0.0, 0.0, 0.0)  # see `move_arm`


@njit(cache=True)
def reset_arm(arm, person):
    """Put the hand at rest at the center, with the plan to stay there."""
    arm.hand_x = arm.hand_y = arm.hand_v_x = arm.hand_v_y = 0.0
    arm.muscle_x = arm.muscle_y = 0.0
    arm.end_v_x = arm.end_v_y = 0.0
    arm.correction_x = arm.correction_y = arm.correction_v_x = arm.correction_v_y = 0.0
    arm.estimate_x = arm.estimate_y = arm.estimate_v_x = arm.estimate_v_y = 0.0
    arm.plan_seconds = arm.plan_age = 0.0
    begin_plan(arm, person, 0.0, 0.0, 0.0, 0.0, 0.1)


@njit(cache=True)
def cubic(offset_x, offset_y, v_x, v_y, end_v_x, end_v_y, seconds):
    """The motion of least mean squared acceleration by `offset`, from velocity `v` to `end_v`, both axes.

    x0 + v t + c2 t^2 + c3 t^3 with c2 = (3 (g - x0) - (2 v + g') T) / T^2, c3 = (-2 (g - x0) + (v + g') T) / T^3.

    Returns:
        c2 x, c2 y, c3 x, c3 y.
    """
    return (
        (3.0 * offset_x - (2.0 * v_x + end_v_x) * seconds) / seconds**2,
        (3.0 * offset_y - (2.0 * v_y + end_v_y) * seconds) / seconds**2,
        (-2.0 * offset_x + (v_x + end_v_x) * seconds) / seconds**3,
        (-2.0 * offset_y + (v_y + end_v_y) * seconds) / seconds**3,
    )


@njit(cache=True)
def plan_start(arm, person):
    """Where a plan made now begins: x, y, vx, vy of the hand after the muscle lag, expected from the present plan.

    A command moves the hand only after the lag; a practiced person plans from there.
    """
    lag = person.muscle_lag
    now_x, now_y = planned_velocity(arm, person, arm.plan_age)
    then_x, then_y = planned_velocity(arm, person, arm.plan_age + lag)
    v_x, v_y = arm.estimate_v_x + then_x - now_x, arm.estimate_v_y + then_y - now_y
    x = arm.estimate_x + 0.5 * lag * (arm.estimate_v_x + v_x)
    y = arm.estimate_y + 0.5 * lag * (arm.estimate_v_y + v_y)
    return x, y, v_x, v_y


@njit(cache=True)
def begin_plan(arm, person, goal_x, goal_y, end_v_x, end_v_y, seconds):
    """Plan to be at `goal` in `seconds` at velocity `end_v`, beginning at `plan_start`."""
    lag = person.muscle_lag
    x, y, v_x, v_y = plan_start(arm, person)
    arm.initial_acceleration_x = (v_x - arm.estimate_v_x) / lag
    arm.initial_acceleration_y = (v_y - arm.estimate_v_y) / lag
    seconds = max(seconds - lag, SHORTEST_PLAN)
    arm.c2_x, arm.c2_y, arm.c3_x, arm.c3_y = cubic(goal_x - x, goal_y - y, v_x, v_y, end_v_x, end_v_y, seconds)
    arm.ref_x, arm.ref_y = arm.estimate_x, arm.estimate_y
    arm.start_v_x, arm.start_v_y, arm.end_v_x, arm.end_v_y = v_x, v_y, end_v_x, end_v_y
    arm.plan_seconds, arm.plan_age = seconds, -lag


@njit(cache=True)
def peak_acceleration(offset_x, offset_y, v_x, v_y, end_v_x, end_v_y, seconds):
    """The largest acceleration of the cubic in m/s2, which is at one of its ends."""
    c2_x, c2_y, c3_x, c3_y = cubic(offset_x, offset_y, v_x, v_y, end_v_x, end_v_y, seconds)
    first = 2.0 * hypot(c2_x, c2_y)
    last = hypot(2.0 * c2_x + 6.0 * c3_x * seconds, 2.0 * c2_y + 6.0 * c3_y * seconds)
    return max(first, last)


@njit(cache=True)
def planned_velocity(arm, person, age):
    """Planned velocity (x, y) of the hand in m/s, `age` seconds after the beginning of the plan's cubic."""
    if age < 0.0:
        return arm.start_v_x + arm.initial_acceleration_x * age, arm.start_v_y + arm.initial_acceleration_y * age
    if age < arm.plan_seconds:
        return (
            arm.start_v_x + 2.0 * arm.c2_x * age + 3.0 * arm.c3_x * age * age,
            arm.start_v_y + 2.0 * arm.c2_y * age + 3.0 * arm.c3_y * age * age,
        )
    decay = exp(-max(age - arm.plan_seconds - person.follow_through_time, 0.0) / person.deceleration_time)
    return arm.end_v_x * decay, arm.end_v_y * decay


@njit(cache=True)
def _planned_acceleration(arm, person, age):
    if age < 0.0:
        return arm.initial_acceleration_x, arm.initial_acceleration_y
    if age < arm.plan_seconds:
        return 2.0 * arm.c2_x + 6.0 * arm.c3_x * age, 2.0 * arm.c2_y + 6.0 * arm.c3_y * age
    late = age - arm.plan_seconds - person.follow_through_time
    decay = -exp(-late / person.deceleration_time) / person.deceleration_time if late > 0.0 else 0.0
    return arm.end_v_x * decay, arm.end_v_y * decay


@njit(cache=True)
def write_prediction_error(arm, model, out):
    """Write the deviation of the hand's position and velocity from its forward model: (4,) m and m/s."""
    out[0], out[1] = arm.hand_x - model.hand_x + model.correction_x, arm.hand_y - model.hand_y + model.correction_y
    out[2] = arm.hand_v_x - model.hand_v_x + model.correction_v_x
    out[3] = arm.hand_v_y - model.hand_v_y + model.correction_v_y


@njit(cache=True)
def estimate_state(arm, model, error):
    """Estimate the hand's position and velocity: those of the forward model plus its delayed prediction error (4,).

    The model is a copy of the arm that gets every command but neither noise nor forces (Wolpert et al. 1995).
    """
    arm.estimate_x = model.hand_x - model.correction_x + error[0]
    arm.estimate_y = model.hand_y - model.correction_y + error[1]
    arm.estimate_v_x = model.hand_v_x - model.correction_v_x + error[2]
    arm.estimate_v_y = model.hand_v_y - model.correction_v_y + error[3]


@njit(cache=True)
def reset_forward_model(model, arm):
    """Start the forward model on the arm's new plan, at the estimated position and velocity of the hand."""
    model.correction_x += arm.estimate_x - model.hand_x
    model.correction_y += arm.estimate_y - model.hand_y
    model.correction_v_x += arm.estimate_v_x - model.hand_v_x
    model.correction_v_y += arm.estimate_v_y - model.hand_v_y
    model.hand_x, model.hand_y = arm.estimate_x, arm.estimate_y
    model.hand_v_x, model.hand_v_y = arm.estimate_v_x, arm.estimate_v_y
    model.ref_x, model.ref_y, model.plan_seconds, model.plan_age = arm.ref_x, arm.ref_y, arm.plan_seconds, arm.plan_age
    model.initial_acceleration_x, model.initial_acceleration_y = arm.initial_acceleration_x, arm.initial_acceleration_y
    model.start_v_x, model.start_v_y = arm.start_v_x, arm.start_v_y
    model.c2_x, model.c2_y, model.c3_x, model.c3_y = arm.c2_x, arm.c2_y, arm.c3_x, arm.c3_y
    model.end_v_x, model.end_v_y = arm.end_v_x, arm.end_v_y


@njit(cache=True)
def draw_motor_noise(person, state, dt, rng, index):
    """Redraw the motor noise when its hold time is over: shares of speed along and across the motion, and a tremor."""
    state.time_to_noise_draw -= dt
    if state.time_to_noise_draw < 0.5 * dt:
        state.time_to_noise_draw += person.noise_hold_time
        state.noise_along = person.noise_along * standard_normal(rng, index)
        state.noise_across = person.noise_across * standard_normal(rng, index)
        state.tremor_x = person.tremor * standard_normal(rng, index)
        state.tremor_y = person.tremor * standard_normal(rng, index)


@njit(cache=True)
def move_arm(arm, person, noise, stiffness, push_x, push_y, force_x, force_y, dt):
    """Move the hand by `dt`.

        (M_h + M_dev) x'' = a + F_v + K_h (r_exec - x) + B_h (r'_exec - x') + b_dev (r' - x') + F_HG
        tau_m a' = -a + (M_h + M_dev) r''(t + tau_m)

    The command runs ahead of the plan by the muscle's own lag, which a practiced motor system has learned.

    Args:
        noise: on the plan's velocity: shares of its size along and across it, then a tremor in x and y, m/s.
        stiffness: K_h, N/m; its damping B_h grows with its root.
        push_x, push_y: F_v, the voluntary force, N.
        force_x, force_y: F_HG, the force of the device on the hand, N.
    """
    mass = person.arm_mass + person.device_mass
    damping = person.damping_time * sqrt(person.stiffness * stiffness)
    arm.plan_age += dt
    plan_x, plan_y = planned_velocity(arm, person, arm.plan_age)
    along, across, tremor_x, tremor_y = noise
    exec_x = plan_x + plan_x * along - plan_y * across + tremor_x
    exec_y = plan_y + plan_y * along + plan_x * across + tremor_y
    arm.ref_x += exec_x * dt
    arm.ref_y += exec_y * dt
    accel_x, accel_y = _planned_acceleration(arm, person, arm.plan_age + person.muscle_lag)
    gain = 1.0 - exp(-dt / person.muscle_lag)
    arm.muscle_x += gain * (mass * accel_x - arm.muscle_x)
    arm.muscle_y += gain * (mass * accel_y - arm.muscle_y)
    own_x = arm.muscle_x + push_x + stiffness * (arm.ref_x - arm.hand_x) + damping * (exec_x - arm.hand_v_x)
    own_y = arm.muscle_y + push_y + stiffness * (arm.ref_y - arm.hand_y) + damping * (exec_y - arm.hand_v_y)
    arm.hand_v_x += dt * (own_x + person.device_damping * (plan_x - arm.hand_v_x) + force_x) / mass
    arm.hand_v_y += dt * (own_y + person.device_damping * (plan_y - arm.hand_v_y) + force_y) / mass
    arm.hand_x += dt * arm.hand_v_x
    arm.hand_y += dt * arm.hand_v_y
    if abs(arm.hand_x) > HAND_REACH:
        arm.hand_x, arm.hand_v_x = (HAND_REACH if arm.hand_x > 0.0 else -HAND_REACH), 0.0
    if abs(arm.hand_y) > HAND_REACH:
        arm.hand_y, arm.hand_v_y = (HAND_REACH if arm.hand_y > 0.0 else -HAND_REACH), 0.0
