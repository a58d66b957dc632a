"""Response to the force at the hand, after the tactile delay.

Three variants, always reported together because the literature disagrees (`Variant`). `person` is a record of
`USER_PARAMETERS`, `state` one of `USER_STATE`; meters of the hand, newtons, seconds.
"""

from enum import IntEnum
from math import exp, hypot

from numba import njit


class Variant(IntEnum):
    """Model of the response to a force.

    passive: only the arm's mechanics respond, and what has been learned.
    comply_or_resist: conflict stiffens the arm and is pushed back; a supporting force replaces own effort.
    goal_sharing: comply_or_resist, and the force is read as a partner's goal, which moves the own goal as far as the
        partner is trusted.
    """

    passive = 0
    comply_or_resist = 1
    goal_sharing = 2


def check_variant(name: str) -> None:
    """Raise if `name` is not the name of a `Variant`."""
    if name not in Variant.__members__:
        raise ValueError(f"users.variant = {name!r} must be one of {', '.join(Variant.__members__)}")


@njit(cache=True)
def agreement(person, force_x, force_y, offset_x, offset_y):
    """Split a force into support and conflict, N each, given the offset of the own goal from the hand.

    At the goal no force can help: all of it conflicts.
    """
    size = hypot(force_x, force_y)
    distance = hypot(offset_x, offset_y)
    if size == 0.0:
        return 0.0, 0.0
    certainty = distance / (distance + person.goal_radius)
    cosine = (force_x * offset_x + force_y * offset_y) / (size * distance) if distance > 0.0 else 0.0
    return certainty * max(0.0, cosine) * size, (certainty * max(0.0, -cosine) + 1.0 - certainty) * size


@njit(cache=True)
def respond_to_force(person, state, hand, force, surprise, expected, adapts, variant, tick):
    """Update co-contraction and voluntary push, for one tick of `tick` seconds.

    Args:
        hand: (x, y) m.
        force: (x, y) N, as felt.
        surprise: (x, y) N, the part of it that was not expected; all of it in people who do not adapt.
        expected: (x, y) N, the force for which the push is to make up in advance.
        adapts: whether the person adapts. Then stiffness rises with every surprise and falls as the force is learned
            (Burdet et al. 2001, Franklin et al. 2008), and own effort gives way to support only gradually (Emken et
            al. 2007).
    """
    if variant == Variant.passive and not adapts:
        return
    share = 0.0
    if variant != Variant.passive:
        offset_x, offset_y = state.goal_x - hand[0], state.goal_y - hand[1]
        support, conflict = agreement(person, surprise[0], surprise[1], offset_x, offset_y)
        size = hypot(surprise[0], surprise[1])
        tension, slacking = conflict, person.slacking
        if adapts:
            update_slacking(person, state, force, offset_x, offset_y, tick)
            tension, slacking = size, person.slacking * state.slacking
        tension = min(tension / person.saturating_conflict, 1.0)
        state.co_contraction += (1.0 - exp(-tick / person.co_contraction_time)) * (tension - state.co_contraction)
        share = (person.resistance * conflict + slacking * support) / size if size > 0.0 else 0.0
    rate = 1.0 - exp(-tick / person.muscle_lag)
    state.push_x += rate * (-expected[0] - share * surprise[0] - state.push_x)
    state.push_y += rate * (-expected[1] - share * surprise[1] - state.push_y)


@njit(cache=True)
def update_slacking(person, state, force, offset_x, offset_y, tick):
    """Move the level of slacking toward the share of the felt force that supports."""
    support, _ = agreement(person, force[0], force[1], offset_x, offset_y)
    size = hypot(force[0], force[1])
    supported = support / size if size > 0.0 else 0.0
    state.slacking += (1.0 - exp(-tick / person.slacking_time)) * (supported - state.slacking)


@njit(cache=True)
def current_stiffness(person, state):
    """K_h in N/m: relaxed stiffness, raised by co-contraction up to its bound."""
    return person.stiffness * min(1.0 + person.stiffening_gain * state.co_contraction, person.max_stiffness_ratio)


@njit(cache=True)
def update_trust(person, state, partner_x, partner_y, hand_x, hand_y, tick):
    """Move trust toward 1 the nearer the hand is to the partner's goal of `partner_lead_time` ago."""
    error = hypot(partner_x - hand_x, partner_y - hand_y) / person.sharing_range
    state.trust += (1.0 - exp(-tick / person.trust_time)) * (1.0 / (1.0 + error * error) - state.trust)


@njit(cache=True)
def shared_goal(person, state, hand_x, hand_y, force_x, force_y):
    """The own goal (x, y) in m, drawn toward the goal that a spring of `partner_stiffness` would have."""
    goal_x, goal_y = state.goal_x, state.goal_y
    if force_x == 0.0 and force_y == 0.0:
        return goal_x, goal_y
    offset_x = hand_x + force_x / person.partner_stiffness - goal_x
    offset_y = hand_y + force_y / person.partner_stiffness - goal_y
    distance = (offset_x * offset_x + offset_y * offset_y) / (2.0 * person.sharing_range * person.sharing_range)
    weight = person.sharing_weight * state.trust * exp(-distance)
    return goal_x + weight * offset_x, goal_y + weight * offset_y
