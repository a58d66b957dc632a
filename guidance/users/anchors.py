"""What the signals behind the rating proxies are worth under three forces that are fixed before any condition runs.

    oracle-intent: a spring toward the person's own, private goal
    random-direction: as strong at every moment, in a direction that changes every 0.3 s
    anti-intent: the oracle's force reversed

They look into the person, which no guidance may; they are the measuring rod, not a condition.
"""

from collections.abc import Callable

import numpy as np

from airhockey_marl.table import LEFT, RIGHT, Table
from airhockey_marl.tables import Tables
from guidance.users.mentors import Mentors
from guidance.users.people import Users
from guidance.users.rating import SIGNALS
from guidance.users.sampling import personal_streams

ANCHORS = ("oracle", "random", "anti")
ANCHOR_STIFFNESS = 50.0  # N/m
ANCHOR_STRONGEST = 3.0  # N
RANDOM_HELD = 0.3  # s

# Which anchor gives each signal its unit.
SCALED_BY = {
    "conflict": "anti",
    "unsupported": "anti",
    "supportive_power": "oracle",
    "deviation": "anti",
    "effort": "anti",
    "jerk": "random",
    "surprise": "random",
    "hindsight": "oracle",
}


def anchor_force(users: Users, anchor: str, angle: np.ndarray) -> np.ndarray:
    """(n, 2) N for one tick; `angle` (n,) rad is the direction of the random anchor."""
    force = ANCHOR_STIFFNESS * (users.goal - users.hand)
    size = np.hypot(force[:, 0], force[:, 1])
    strength = np.minimum(size, ANCHOR_STRONGEST)
    if anchor == "random":
        return strength[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    force *= (strength / np.maximum(size, 1e-12))[:, None]
    return force if anchor == "oracle" else -force


def play_anchor(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    anchor: str,
    table: Table | None = None,
    seconds: float = 120.0,
    seed: int = 0,
    variant: str = "V1",
    mentors: Mentors | None = None,
) -> Users:
    """One game of `seconds` of everyone (left seat) under one anchor force against `opponent` (right seat).

    Args:
        people: (n,) of dtype `PERSON`.
        opponent: (n, 12) float64 egocentric states -> (n, 2) actions.
        anchor: one of `ANCHORS`, or "none".

    Returns:
        The people after the game; their `signals` and `ratings` are what is wanted.

    Raises:
        ValueError: an unknown anchor, or no time to play.
    """
    if anchor not in (*ANCHORS, "none"):
        raise ValueError(f"anchor = {anchor!r} must be one of {', '.join(ANCHORS)}, none")
    if not seconds > 0:
        raise ValueError(f"seconds = {seconds} must be above 0")
    n = len(people)
    tables = Tables(n, table)
    tables.seed(seed)
    tables.new_rounds()
    users = Users(people, personal_streams(n, seed), tables.table, variant, mentors)
    rng = np.random.default_rng([seed, ANCHORS.index(anchor) if anchor in ANCHORS else len(ANCHORS)])
    left, right, actions = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros((n, 2, 2))
    force, angle = np.zeros((n, 2)), np.zeros(n)
    held = max(1, round(RANDOM_HELD / tables.table.tick))
    for tick in range(round(seconds / tables.table.tick)):
        if tick % held == 0:
            angle = rng.uniform(-np.pi, np.pi, n)
        if anchor != "none":
            force = anchor_force(users, anchor, angle)
        actions[:, LEFT] = users.step(tables.observe(LEFT, left), force)
        actions[:, RIGHT] = opponent(tables.observe(RIGHT, right))
        tables.step(actions)
        over = tables.goals != 0
        if over.any():
            tables.new_rounds(over)
            users.new_round(over)
    return users


def anchor_scales(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    table: Table | None = None,
    seconds: float = 120.0,
    seed: int = 0,
    mentors: Mentors | None = None,
) -> dict[str, float]:
    """The unit of each signal: its mean over people (variant V1) under its anchor, as in `SCALED_BY`.

    Returns:
        Per name of `rating.SIGNALS` a plain float, in that signal's unit.

    Raises:
        ValueError: an anchor gives a signal no positive value, so it cannot be a unit; play longer.
    """
    played = {name: play_anchor(people, opponent, name, table, seconds, seed, mentors=mentors) for name in ANCHORS}
    means = {name: users.signals.mean(axis=0) for name, users in played.items()}
    scales = {signal: float(means[SCALED_BY[signal]][column]) for column, signal in enumerate(SIGNALS)}
    for signal, value in scales.items():
        if not value > 0:
            raise ValueError(f"anchor scale of {signal} = {value} must be above 0")
    return scales
