"""How a person answers the force at the hand, after the delay of touch.

Three variants, always reported together, because the literature disagrees:
    passive: only the arm's mechanics respond.
    comply_or_resist: conflict stiffens the arm and is pushed back; supporting force replaces own effort.
    goal_sharing: comply_or_resist, and the force is read as a partner's goal, which moves the own goal as far as the
        partner is trusted.
"""

from enum import IntEnum
from math import exp, hypot

from numba import njit


class Variant(IntEnum):
    """Which of the three models of a person's answer."""

    passive = 0
    comply_or_resist = 1
    goal_sharing = 2


def check_variant(name: str) -> None:
    """Refuse a name that is no variant's.

    Raises:
        ValueError: names the key of the configuration, the value and what is allowed.
    """
    if name not in Variant.__members__:
        raise ValueError(f"users.variant = {name!r} must be one of {', '.join(Variant.__members__)}")


@njit(cache=True)
def agreement(person, force_x, force_y, away_x, away_y):
    """How much of a force helps on the way `away` to the own goal, and how much of it is against it, both in N.

    At the goal itself there is no way to help: all of it conflicts.
    """
    size = hypot(force_x, force_y)
    distance = hypot(away_x, away_y)
    if size == 0.0:
        return 0.0, 0.0
    sure = distance / (distance + person.aim_size)
    cosine = (force_x * away_x + force_y * away_y) / (size * distance) if distance > 0.0 else 0.0
    return sure * max(0.0, cosine) * size, (sure * max(0.0, -cosine) + 1.0 - sure) * size


@njit(cache=True)
def respond_to_force(person, mind, hand_x, hand_y, felt_x, felt_y, variant, tick):
    """Let co-contraction and the deliberate push follow the force felt, for one tick of `tick` seconds.

    Returns:
        The conflict, N.
    """
    support, conflict = agreement(person, felt_x, felt_y, mind.goal_x - hand_x, mind.goal_y - hand_y)
    if variant == Variant.passive:
        return conflict
    tense = min(conflict / person.full_conflict, 1.0)
    mind.co_contraction += (1.0 - exp(-tick / person.stiffening_lag)) * (tense - mind.co_contraction)
    size = hypot(felt_x, felt_y)
    share = (person.resistance * conflict + person.slacking * support) / size if size > 0.0 else 0.0
    follow = 1.0 - exp(-tick / person.muscle_lag)
    mind.push_x += follow * (-share * felt_x - mind.push_x)
    mind.push_y += follow * (-share * felt_y - mind.push_y)
    return conflict


@njit(cache=True)
def stiffness_now(person, mind):
    """K_h in N/m: relaxed stiffness, raised by co-contraction, within bounds."""
    return person.stiffness * min(1.0 + person.stiffening * mind.co_contraction, person.stiffest)


@njit(cache=True)
def learn_trust(person, mind, meant_x, meant_y, hand_x, hand_y, tick):
    """Trust the partner whose goal of a while ago, `meant`, is where the hand is now."""
    off = hypot(meant_x - hand_x, meant_y - hand_y) / person.sharing_range
    mind.trust += (1.0 - exp(-tick / person.trust_memory)) * (1.0 / (1.0 + off * off) - mind.trust)


@njit(cache=True)
def shared_goal(person, mind, hand_x, hand_y, felt_x, felt_y):
    """The own goal, drawn toward the goal a spring of the believed stiffness would have: m of the hand."""
    goal_x, goal_y = mind.goal_x, mind.goal_y
    if felt_x == 0.0 and felt_y == 0.0:
        return goal_x, goal_y
    off_x = hand_x + felt_x / person.believed_stiffness - goal_x
    off_y = hand_y + felt_y / person.believed_stiffness - goal_y
    near = (off_x * off_x + off_y * off_y) / (2.0 * person.sharing_range * person.sharing_range)
    weight = person.sharing * mind.trust * exp(-near)
    return goal_x + weight * off_x, goal_y + weight * off_y
