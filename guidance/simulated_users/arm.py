"""The hand at the device: a minimum-acceleration plan, motor noise, and an arm that a force can push.

Meters of the hand, newtons, seconds. Scalar and compiled; an arm and a person are records of `ARM_STATE` and `PERSON`.
"""

from math import exp, hypot, sqrt

import numpy as np
from numba import njit

from guidance.simulated_users.perception import standard_normal

HAND_REACH = 0.075  # m of hand travel for |action| = 1, the workspace of an Omega.7: beyond is a stop
SUBSTEPS = 5  # of the arm in one tick
SHORTEST_PLAN = 0.04  # s, of a cubic; two ticks

# An arm: where the hand is and what moves it. `ref` is the plan as executed, that is with motor noise. `sensed` and
# `sensed_v` are where the hand is to its owner's knowledge, and how fast; `base` is by how much its forward model has
# been put right so far.
_PAIRS = (
    "hand",
    "hand_v",
    "muscle",
    "ref",
    "start_v",
    "lead_in",
    "bend",
    "twist",
    "end_v",
    "base",
    "base_v",
    "sensed",
    "sensed_v",
)
ARM_STATE = np.dtype(
    [(name + axis, np.float64) for name in _PAIRS for axis in ("_x", "_y")]
    + [("plan_seconds", np.float64), ("plan_age", np.float64), ("effort", np.float64)]
)


STEADY = (0.0, 0.0, 0.0, 0.0)  # no motor noise


@njit(cache=True)
def rest(arm, person):
    """The hand still at the center, and nothing planned."""
    arm.hand_x = arm.hand_y = arm.hand_v_x = arm.hand_v_y = 0.0
    arm.muscle_x = arm.muscle_y = arm.effort = 0.0
    arm.end_v_x = arm.end_v_y = 0.0
    arm.base_x = arm.base_y = arm.base_v_x = arm.base_v_y = 0.0
    arm.sensed_x = arm.sensed_y = arm.sensed_v_x = arm.sensed_v_y = 0.0
    arm.plan_seconds = arm.plan_age = 0.0
    begin_plan(arm, person, 0.0, 0.0, 0.0, 0.0, 0.1)


@njit(cache=True)
def cubic(away_x, away_y, v_x, v_y, end_v_x, end_v_y, seconds):
    """The motion of least mean squared acceleration over `away` from velocity `v` to `end_v`, both axes.

    x0 + v t + c2 t^2 + c3 t^3 with c2 = (3 (g - x0) - (2 v + g') T) / T^2, c3 = (-2 (g - x0) + (v + g') T) / T^3.

    Returns:
        c2 x, c2 y, c3 x, c3 y.
    """
    return (
        (3.0 * away_x - (2.0 * v_x + end_v_x) * seconds) / seconds**2,
        (3.0 * away_y - (2.0 * v_y + end_v_y) * seconds) / seconds**2,
        (-2.0 * away_x + (v_x + end_v_x) * seconds) / seconds**3,
        (-2.0 * away_y + (v_y + end_v_y) * seconds) / seconds**3,
    )


@njit(cache=True)
def start_of_plan(arm, person):
    """Where a plan made now can begin: x, y, vx, vy of the hand once the muscles follow, until then moved as planned.

    What is commanded now moves the hand only after their lag; a practiced person plans from there.
    """
    lag = person.muscle_lag
    now_x, now_y = _planned_velocity(arm, person, arm.plan_age)
    then_x, then_y = _planned_velocity(arm, person, arm.plan_age + lag)
    v_x, v_y = arm.sensed_v_x + then_x - now_x, arm.sensed_v_y + then_y - now_y
    x = arm.sensed_x + 0.5 * lag * (arm.sensed_v_x + v_x)
    y = arm.sensed_y + 0.5 * lag * (arm.sensed_v_y + v_y)
    return x, y, v_x, v_y


@njit(cache=True)
def begin_plan(arm, person, goal_x, goal_y, end_v_x, end_v_y, seconds):
    """Plan to be at `goal` in `seconds` at velocity `end_v`, from where the hand is once the muscles follow."""
    lag = person.muscle_lag
    x, y, v_x, v_y = start_of_plan(arm, person)
    arm.lead_in_x = (v_x - arm.sensed_v_x) / lag
    arm.lead_in_y = (v_y - arm.sensed_v_y) / lag
    seconds = max(seconds - lag, SHORTEST_PLAN)
    arm.bend_x, arm.bend_y, arm.twist_x, arm.twist_y = cubic(
        goal_x - x, goal_y - y, v_x, v_y, end_v_x, end_v_y, seconds
    )
    arm.ref_x, arm.ref_y = arm.sensed_x, arm.sensed_y
    arm.start_v_x, arm.start_v_y, arm.end_v_x, arm.end_v_y = v_x, v_y, end_v_x, end_v_y
    arm.plan_seconds, arm.plan_age = seconds, -lag


@njit(cache=True)
def hardest_acceleration(away_x, away_y, v_x, v_y, end_v_x, end_v_y, seconds):
    """The largest acceleration in m/s2 that the cubic needs: at one of its ends."""
    bend_x, bend_y, twist_x, twist_y = cubic(away_x, away_y, v_x, v_y, end_v_x, end_v_y, seconds)
    first = 2.0 * hypot(bend_x, bend_y)
    last = hypot(2.0 * bend_x + 6.0 * twist_x * seconds, 2.0 * bend_y + 6.0 * twist_y * seconds)
    return max(first, last)


@njit(cache=True)
def _planned_velocity(arm, person, age):
    if age < 0.0:
        return arm.start_v_x + arm.lead_in_x * age, arm.start_v_y + arm.lead_in_y * age
    if age < arm.plan_seconds:
        return (
            arm.start_v_x + 2.0 * arm.bend_x * age + 3.0 * arm.twist_x * age * age,
            arm.start_v_y + 2.0 * arm.bend_y * age + 3.0 * arm.twist_y * age * age,
        )
    left = exp(-max(age - arm.plan_seconds - person.carry_through, 0.0) / person.slow_down)
    return arm.end_v_x * left, arm.end_v_y * left


@njit(cache=True)
def _planned_acceleration(arm, person, age):
    if age < 0.0:
        return arm.lead_in_x, arm.lead_in_y
    if age < arm.plan_seconds:
        return 2.0 * arm.bend_x + 6.0 * arm.twist_x * age, 2.0 * arm.bend_y + 6.0 * arm.twist_y * age
    late = age - arm.plan_seconds - person.carry_through
    left = -exp(-late / person.slow_down) / person.slow_down if late > 0.0 else 0.0
    return arm.end_v_x * left, arm.end_v_y * left


@njit(cache=True)
def unexpected(arm, model, out):
    """Write how far the hand is, and moves, from where its forward model is: (4,) m and m/s."""
    out[0], out[1] = arm.hand_x - model.hand_x + model.base_x, arm.hand_y - model.hand_y + model.base_y
    out[2], out[3] = arm.hand_v_x - model.hand_v_x + model.base_v_x, arm.hand_v_y - model.hand_v_y + model.base_v_y


@njit(cache=True)
def estimate_state(arm, model, late):
    """Know where the hand is: what one commanded is known at once, the rest only as `late` (4,) as it is felt.

    The model is a copy of the arm that hears every command and knows nothing of noise and forces (Wolpert et al. 1995).
    """
    arm.sensed_x, arm.sensed_y = model.hand_x - model.base_x + late[0], model.hand_y - model.base_y + late[1]
    arm.sensed_v_x = model.hand_v_x - model.base_v_x + late[2]
    arm.sensed_v_y = model.hand_v_y - model.base_v_y + late[3]


@njit(cache=True)
def reset_forward_model(model, arm):
    """Have the forward model begin the arm's new plan, from where its owner takes the hand to be."""
    model.base_x += arm.sensed_x - model.hand_x
    model.base_y += arm.sensed_y - model.hand_y
    model.base_v_x += arm.sensed_v_x - model.hand_v_x
    model.base_v_y += arm.sensed_v_y - model.hand_v_y
    model.hand_x, model.hand_y, model.hand_v_x, model.hand_v_y = (
        arm.sensed_x,
        arm.sensed_y,
        arm.sensed_v_x,
        arm.sensed_v_y,
    )
    model.ref_x, model.ref_y, model.plan_seconds, model.plan_age = arm.ref_x, arm.ref_y, arm.plan_seconds, arm.plan_age
    model.lead_in_x, model.lead_in_y, model.start_v_x, model.start_v_y = (
        arm.lead_in_x,
        arm.lead_in_y,
        arm.start_v_x,
        arm.start_v_y,
    )
    model.bend_x, model.bend_y, model.twist_x, model.twist_y = arm.bend_x, arm.bend_y, arm.twist_x, arm.twist_y
    model.end_v_x, model.end_v_y = arm.end_v_x, arm.end_v_y


@njit(cache=True)
def draw_motor_noise(person, mind, dt, rng, index):
    """Hold the motor noise for a while, then draw it anew: shares of speed along and across the motion; a tremor."""
    mind.noise_left -= dt
    if mind.noise_left < 0.5 * dt:
        mind.noise_left += person.noise_held
        mind.noise_along = person.noise_along * standard_normal(rng, index)
        mind.noise_across = person.noise_across * standard_normal(rng, index)
        mind.tremor_x = person.tremor * standard_normal(rng, index)
        mind.tremor_y = person.tremor * standard_normal(rng, index)


@njit(cache=True)
def move_arm(arm, person, noise, stiffness, push_x, push_y, force_x, force_y, dt):
    """Move the hand by `dt`.

        (M_h + M_dev) x'' = a + F_v + K_h (r_exec - x) + B_h (r'_exec - x') + b_dev (r' - x') + F_HG
        tau_m a' = -a + (M_h + M_dev) r''(t + tau_m)

    The command runs ahead of the plan by the muscle's own lag, which a practiced motor system has learned.

    Args:
        noise: of the plan's velocity, four numbers: along and across it as shares of its size, then x and y in m/s.
        stiffness: K_h, N/m; its damping B_h grows with its root.
        push_x, push_y: F_v, what the person adds on purpose, N.
        force_x, force_y: F_HG, the force of the device on the hand, N.
    """
    mass = person.arm_mass + person.device_mass
    damping = person.damping_time * sqrt(person.stiffness * stiffness)
    arm.plan_age += dt
    plan_x, plan_y = _planned_velocity(arm, person, arm.plan_age)
    along, across, tremor_x, tremor_y = noise
    exec_x = plan_x + plan_x * along - plan_y * across + tremor_x
    exec_y = plan_y + plan_y * along + plan_x * across + tremor_y
    arm.ref_x += exec_x * dt
    arm.ref_y += exec_y * dt
    want_x, want_y = _planned_acceleration(arm, person, arm.plan_age + person.muscle_lag)
    gain = 1.0 - exp(-dt / person.muscle_lag)
    arm.muscle_x += gain * (mass * want_x - arm.muscle_x)
    arm.muscle_y += gain * (mass * want_y - arm.muscle_y)
    own_x = arm.muscle_x + push_x + stiffness * (arm.ref_x - arm.hand_x) + damping * (exec_x - arm.hand_v_x)
    own_y = arm.muscle_y + push_y + stiffness * (arm.ref_y - arm.hand_y) + damping * (exec_y - arm.hand_v_y)
    arm.effort = hypot(own_x, own_y)
    arm.hand_v_x += dt * (own_x + person.device_damping * (plan_x - arm.hand_v_x) + force_x) / mass
    arm.hand_v_y += dt * (own_y + person.device_damping * (plan_y - arm.hand_v_y) + force_y) / mass
    arm.hand_x += dt * arm.hand_v_x
    arm.hand_y += dt * arm.hand_v_y
    if abs(arm.hand_x) > HAND_REACH:
        arm.hand_x, arm.hand_v_x = (HAND_REACH if arm.hand_x > 0.0 else -HAND_REACH), 0.0
    if abs(arm.hand_y) > HAND_REACH:
        arm.hand_y, arm.hand_v_y = (HAND_REACH if arm.hand_y > 0.0 else -HAND_REACH), 0.0
