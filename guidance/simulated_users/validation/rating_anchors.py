"""Anchors of the rating proxies: four forces, fixed before any condition runs, that give the signals their units.

    oracle: a spring toward the person's own, private goal
    replayed: the oracle's force on another person in another game, so of the same size and time course
    random: of the size of the oracle's, in a direction that changes every 0.3 s
    anti: the oracle's force reversed

They use the private goal, which no guidance may. They are ordered from the best to the worst: a proxy that does not
reproduce this order is withdrawn (`known_order`).
"""

from collections.abc import Callable, Mapping

import numpy as np

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from guidance.simulated_users.advisors import Advisors
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.ratings import RATINGS, SIGNALS
from guidance.simulated_users.users import SimulatedUsers

ANCHORS = ("oracle", "replayed", "random", "anti")  # from the best to the worst
ANCHOR_STIFFNESS = 50.0  # N/m
ANCHOR_MAX_FORCE = 3.0  # N
RANDOM_HOLD_TIME = 0.3  # s
TABLE = TableSpec()

# The anchor that gives each signal its unit.
UNIT_ANCHORS = {
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
    """(n, 2) N toward each person's own goal."""
    force = ANCHOR_STIFFNESS * (users.goal - users.hand)
    size = np.hypot(force[:, 0], force[:, 1])
    return force * (np.minimum(size, ANCHOR_MAX_FORCE) / np.maximum(size, 1e-12))[:, None]


def play_anchor(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    anchor: str,
    seconds: float = 120.0,
    seed: int = 0,
    advisors: Advisors | None = None,
) -> SimulatedUsers:
    """Play one game of `seconds` per person (left) against `opponent` (right) under an anchor force.

    Args:
        people: (n,) of `USER_PARAMETERS`; two at least for "replayed".
        opponent: (n, 12) float64 egocentric states -> (n, 2) actions.
        anchor: one of `ANCHORS`, or "none".

    Returns:
        The people after the game, with their `signals` and `ratings`.
    """
    rng, n = np.random.default_rng([seed, (*ANCHORS, "none").index(anchor)]), len(people)
    hold, angle = max(1, round(RANDOM_HOLD_TIME / TABLE.tick)), np.zeros(n)
    replay: list[np.ndarray] = []

    def record(users: SimulatedUsers, tick: int) -> np.ndarray:
        force = oracle_force(users)
        replay.append(np.roll(force, 1, axis=0))  # for the next person
        return force

    def anchor_force(users: SimulatedUsers, tick: int) -> np.ndarray:
        nonlocal angle
        if tick % hold == 0:
            angle = rng.uniform(-np.pi, np.pi, n)
        if anchor == "none":
            return np.zeros((n, 2))
        if anchor == "replayed":
            return replay[tick]
        force = oracle_force(users)
        if anchor == "random":
            return np.hypot(force[:, :1], force[:, 1:]) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return force if anchor == "oracle" else -force

    def play(force_of: Callable[[SimulatedUsers, int], np.ndarray], seed: int) -> SimulatedUsers:
        users, tables = SimulatedUsers(people, personal_streams(n, seed), TABLE, advisors=advisors), World(n, TABLE)
        tables.seed(seed)
        tables.new_rounds()
        left, right, actions = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros((n, 2, 2))
        for tick in range(round(seconds / TABLE.tick)):
            force = force_of(users, tick)
            actions[:, LEFT] = users.step(tables.observe(LEFT, left), force)
            actions[:, RIGHT] = opponent(tables.observe(RIGHT, right))
            tables.step(actions)
            scored = tables.goals != 0
            if scored.any():
                tables.new_rounds(scored)
                users.new_round(scored)
        return users

    if anchor == "replayed":
        play(record, seed + 1)
    return play(anchor_force, seed)


def known_order(z_scores: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Whether each rating falls, on average over people, from `oracle` over `replayed` and `random` to `anti`.

    Args:
        z_scores: per anchor those of `ratings.rating_z_scores` (n, 4).
    """
    means = np.stack([z_scores[anchor].mean(axis=0) for anchor in ANCHORS])
    return dict(zip(RATINGS, (np.diff(means, axis=0) <= 0).all(axis=0).tolist(), strict=True))


def anchor_scales(
    people: np.ndarray,
    opponent: Callable[[np.ndarray], np.ndarray],
    seconds: float = 120.0,
    seed: int = 0,
    advisors: Advisors | None = None,
) -> dict[str, float]:
    """The unit of each signal: its mean over people (variant comply_or_resist) under its anchor, see `UNIT_ANCHORS`.

    Returns:
        Per name of `ratings.SIGNALS` a plain float, in that signal's unit.

    Raises:
        ValueError: a signal is not positive under its anchor, so cannot be a unit; play longer.
    """
    games = {name: play_anchor(people, opponent, name, seconds, seed, advisors) for name in ANCHORS}
    means = {name: users.signals.mean(axis=0) for name, users in games.items()}
    scales = {signal: float(means[UNIT_ANCHORS[signal]][column]) for column, signal in enumerate(SIGNALS)}
    for signal, value in scales.items():
        if not value > 0:
            raise ValueError(f"anchor scale of {signal} = {value} must be above 0")
    return scales
