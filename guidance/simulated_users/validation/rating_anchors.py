"""What the signals behind the rating proxies are worth under four forces that are fixed before any condition runs.

    oracle: a spring toward the person's own, private goal
    replayed: the oracle's force on somebody else in another game: alike in size and course, and about nothing here
    random: as strong at every moment as the oracle's, in a direction that changes every 0.3 s
    anti: the oracle's force reversed

They look into the person, which no guidance may; they are the measuring rod, not a condition. In this order they get
worse: a proxy that does not say so is withdrawn (`ordered`).
"""

from collections.abc import Callable, Mapping

import numpy as np

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from airhockey_marl.experiment.validation import check_arrays, check_counts, check_numbers
from guidance.simulated_users.advisors import NO_ADVISORS, Advisors
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.ratings import RATINGS, SIGNALS
from guidance.simulated_users.users import SimulatedUsers

ANCHORS = ("oracle", "replayed", "random", "anti")  # from the best to the worst
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


def oracle_force(users: SimulatedUsers) -> np.ndarray:
    """(n, 2) N toward each one's own goal."""
    force = ANCHOR_STIFFNESS * (users.goal - users.hand)
    size = np.hypot(force[:, 0], force[:, 1])
    return force * (np.minimum(size, ANCHOR_STRONGEST) / np.maximum(size, 1e-12))[:, None]


def play_anchor(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    anchor: str,
    table: TableSpec | None = None,
    seconds: float = 120.0,
    seed: int = 0,
    variant: str = "comply_or_resist",
    advisors: Advisors | None = None,
) -> SimulatedUsers:
    """One game of `seconds` of everyone (left seat) under one anchor force against `opponent` (right seat).

    Args:
        people: (n,) of dtype `PERSON`; two at least for "replayed".
        opponent: (n, 12) float64 egocentric states -> (n, 2) actions.
        anchor: one of `ANCHORS`, or "none".

    Returns:
        The people after the game; their `signals` and `ratings` are what is wanted.

    Raises:
        ValueError: an unknown anchor, or no time to play.
    """
    if anchor not in (*ANCHORS, "none"):
        raise ValueError(f"anchor = {anchor!r} must be one of {', '.join(ANCHORS)}, none")
    check_numbers(above=0.0, seconds=seconds)
    check_counts(0, seed=seed)
    table = table or TableSpec()
    rng, n = np.random.default_rng([seed, (*ANCHORS, "none").index(anchor)]), len(people)
    held, angle = max(1, round(RANDOM_HELD / table.tick)), np.zeros(n)
    course: list[np.ndarray] = []

    def push(users: SimulatedUsers, tick: int) -> np.ndarray:
        nonlocal angle
        if tick % held == 0:
            angle = rng.uniform(-np.pi, np.pi, n)
        if anchor == "none":
            return np.zeros((n, 2))
        if anchor == "replayed":
            return course[tick]
        force = oracle_force(users)
        if anchor == "random":
            return np.hypot(force[:, :1], force[:, 1:]) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return force if anchor == "oracle" else -force

    def remember(users: SimulatedUsers, tick: int) -> np.ndarray:
        force = oracle_force(users)
        course.append(np.roll(force, 1, axis=0))  # the neighbor's
        return force

    ticks, how = round(seconds / table.tick), (table, variant, advisors or NO_ADVISORS)
    if anchor == "replayed":
        play_pushed(people, opponent, remember, ticks, seed + 1, *how)
    return play_pushed(people, opponent, push, ticks, seed, *how)


def play_pushed(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    push: Callable[[SimulatedUsers, int], np.ndarray],
    ticks: int,
    seed: int,
    table: TableSpec,
    variant: str,
    advisors: Advisors,
) -> SimulatedUsers:
    """Let everyone play while `push`, told who they are and the number of the tick, says the forces (n, 2) in N."""
    check_counts(0, ticks=ticks, seed=seed)
    n = len(people)
    tables = World(n, table)
    tables.seed(seed)
    tables.new_rounds()
    users = SimulatedUsers(people, personal_streams(n, seed), table, variant, advisors)
    left, right, actions = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros((n, 2, 2))
    for tick in range(ticks):
        force = push(users, tick)
        actions[:, LEFT] = users.step(tables.observe(LEFT, left), force)
        actions[:, RIGHT] = opponent(tables.observe(RIGHT, right))
        tables.step(actions)
        over = tables.goals != 0
        if over.any():
            tables.new_rounds(over)
            users.new_round(over)
    return users


def ordered(appraised: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Whether each rating falls, on average over people, from `oracle` over `replayed` and `random` to `anti`.

    Args:
        appraised: per anchor the z-scores (n, 4) of `rating.appraisals`.
    """
    check_arrays(**{f"appraised.{anchor}": (appraised.get(anchor), f"n {len(RATINGS)}") for anchor in ANCHORS})
    means = np.stack([appraised[anchor].mean(axis=0) for anchor in ANCHORS])
    return dict(zip(RATINGS, (np.diff(means, axis=0) <= 0).all(axis=0).tolist(), strict=True))


def anchor_scales(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    table: TableSpec | None = None,
    seconds: float = 120.0,
    seed: int = 0,
    advisors: Advisors | None = None,
) -> dict[str, float]:
    """The unit of each signal: its mean over people (variant comply_or_resist) under its anchor, as in `SCALED_BY`.

    Returns:
        Per name of `rating.SIGNALS` a plain float, in that signal's unit.

    Raises:
        ValueError: an anchor gives a signal no positive value, so it cannot be a unit; play longer.
    """
    played = {name: play_anchor(people, opponent, name, table, seconds, seed, advisors=advisors) for name in ANCHORS}
    means = {name: users.signals.mean(axis=0) for name, users in played.items()}
    scales = {signal: float(means[SCALED_BY[signal]][column]) for column, signal in enumerate(SIGNALS)}
    for signal, value in scales.items():
        if not value > 0:
            raise ValueError(f"anchor scale of {signal} = {value} must be above 0")
    return scales
