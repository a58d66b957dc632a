"""Motor adaptation: the force that a person has learned to expect from the velocity of their hand.

Two memories i, one fast and one slow, learn from the same surprise (Smith, Ghazizadeh & Shadmehr 2006). Each holds a
viscous matrix and a constant force, so that drag, push and curl fields can all be learned:

    expected force = sum_i W_i phi,                  phi = (v_x, v_y, v_0),  W_i (2, 3) in N s/m
    surprise s     = felt force - expected force     at the time of the touch that is felt now
    W_i           += ((kept_i - 1) W_i phi + gained_i s) phi^T / |phi|^2     every tick

So the expectation at the present velocity follows x_i <- a_i x_i + b_i s of that paper, tick by tick instead of
movement by movement; what is not met is neither learned nor forgotten. At the speed v_0 half of the learning goes to
the constant force.

`person` is a record of `USER_PARAMETERS`, `state` one of `USER_STATE`; m/s, N, s.
"""

from numba import njit

FAST, SLOW = 0, 1  # first index of `state.learned`, which is (2, 2, 3): memory, axis of the force, term of phi


def is_on(value: object) -> bool:
    """Whether people adapt, as the key `users.adaptation` says; raises a ValueError unless it is on or off."""
    switch = {"on": True, "true": True, "off": False, "false": False}.get(str(value).lower())
    if switch is None:
        raise ValueError(f"users.adaptation = {value!r} must be on or off")
    return switch


@njit(cache=True)
def rates(retention, learning_rate, movement_time, tick):
    """Shares that a memory keeps of itself and gains of the surprise in a tick.

    They compose to x <- retention x + learning_rate s over a movement with the same surprise s.
    """
    kept = retention ** (tick / movement_time)
    time = (1.0 - kept) / (1.0 - retention) if retention < 1.0 else tick / movement_time
    return kept, learning_rate * time


@njit(cache=True)
def recall(person, state, memory, v_x, v_y):
    """Force (x, y) in N that one memory expects at a velocity of the hand."""
    learned = state.learned[memory]
    v_0 = person.reference_speed
    return (
        learned[0, 0] * v_x + learned[0, 1] * v_y + learned[0, 2] * v_0,
        learned[1, 0] * v_x + learned[1, 1] * v_y + learned[1, 2] * v_0,
    )


@njit(cache=True)
def expected_force(person, state, v_x, v_y):
    """Force (x, y) in N that the person expects at a velocity of the hand."""
    fast_x, fast_y = recall(person, state, FAST, v_x, v_y)
    slow_x, slow_y = recall(person, state, SLOW, v_x, v_y)
    return fast_x + slow_x, fast_y + slow_y


@njit(cache=True)
def learn(person, state, v_x, v_y, force_x, force_y, tick):
    """Learn from a force in N that was felt at a velocity of the hand, for one tick; returns the surprise (x, y)."""
    expected_x, expected_y = expected_force(person, state, v_x, v_y)
    surprise_x, surprise_y = force_x - expected_x, force_y - expected_y
    v_0 = person.reference_speed
    norm = v_x * v_x + v_y * v_y + v_0 * v_0
    for memory in range(2):
        retention = person.fast_retention if memory == FAST else person.slow_retention
        learning_rate = person.fast_learning_rate if memory == FAST else person.slow_learning_rate
        kept, gained = rates(retention, learning_rate, person.movement_time, tick)
        own_x, own_y = recall(person, state, memory, v_x, v_y)
        step_x = ((kept - 1.0) * own_x + gained * surprise_x) / norm
        step_y = ((kept - 1.0) * own_y + gained * surprise_y) / norm
        learned = state.learned[memory]
        learned[0, 0] += step_x * v_x
        learned[0, 1] += step_x * v_y
        learned[0, 2] += step_x * v_0
        learned[1, 0] += step_y * v_x
        learned[1, 1] += step_y * v_y
        learned[1, 2] += step_y * v_0
    return surprise_x, surprise_y
