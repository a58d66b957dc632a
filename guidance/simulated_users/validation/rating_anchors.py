"""Anchors of the rating proxies: four forces, fixed before any condition runs, that give the signals their units.

    oracle: a spring toward the person's own, private goal
    replayed: the force that the oracle exerts at the same time on another person, in another game
    random: of the size of the replayed one, in a direction that changes every 0.3 s
    anti: the oracle's force reversed

They use the private goal, which no guidance may. Each is played at `GRADES` of the guidance's own spring, so that their
range is that of the guidance's forces.

They are ordered from the best to the worst, and neighbors differ in one thing: `replayed` is the yoked control of
`oracle`, the same force without the person's goal; `random` lacks its course, too; `anti` opposes the goal. A proxy
that does not reproduce this order is withdrawn, see `failures`. `support` follows it by its definition; `outcome` and
`deviation` do not have to.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from guidance.forces.conditions import Spring
from guidance.forces.equations import spring_force
from guidance.simulated_users.advisors import Advisors
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.ratings import RATINGS, SIGNALS, SIGNED, expected_points
from guidance.simulated_users.users import SimulatedUsers

ANCHORS = ("oracle", "replayed", "random", "anti")  # from the best to the worst
GRADES = (0.25, 0.5, 0.75, 1.0)  # of the spring's stiffness and of its largest force
RANDOM_HOLD_TIME = 0.3  # s
STANDARD_ERRORS = 2.0  # an order is reversed within the noise by at most so many
TABLE = TableSpec()

# The anchor under which each signal is large; at its last grade it gives the unit.
UNIT_ANCHORS = {
    "outcome": "anti",
    "force": "anti",
    "support": "oracle",
    "unsupported": "anti",
    "deviation": "anti",
    "jerk": "random",
}


def oracle_force(users: SimulatedUsers, spring: Spring) -> np.ndarray:
    """(n, 2) N toward each person's own goal."""
    hand, goal = torch.from_numpy(users.hand), torch.from_numpy(users.goal)
    return spring_force(hand, goal, spring.stiffness, spring.limit).numpy()


class AnchorForces:
    """The forces of n games for each of `grades` and `ANCHORS` that are played side by side, in this order.

    Args:
        spring: that of grade 1.
        people: of each of these groups, two at least: a force is replayed to another person.
    """

    def __init__(self, spring: Spring, grades: Sequence[float], people: int, seed: int) -> None:
        if people < 2:
            raise ValueError(f"people = {people} must be at least 2: a force is replayed to another person")
        self._spring, self._shape = spring, (len(grades), len(ANCHORS), people, 2)
        self._grades = np.array(grades)[:, None, None, None]
        self._rng, self._hold = np.random.default_rng(seed), max(1, round(RANDOM_HOLD_TIME / TABLE.tick))
        self._ticks, self._direction = 0, np.empty((len(grades), people, 2))

    def __call__(self, users: SimulatedUsers) -> np.ndarray:
        """(games, 2) N, for the next tick."""
        if self._ticks % self._hold == 0:
            angle = self._rng.uniform(-np.pi, np.pi, self._direction.shape[:2])
            self._direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        self._ticks += 1
        force = self._grades * oracle_force(users, self._spring).reshape(self._shape)
        oracle, replayed, random, anti = (force[:, anchor] for anchor in range(len(ANCHORS)))
        replayed[:] = np.roll(oracle, 1, axis=1)
        random[:] = np.linalg.norm(replayed, axis=-1, keepdims=True) * self._direction
        anti *= -1.0
        return force.reshape(-1, 2)


def play(
    people: np.ndarray,
    streams: np.ndarray,
    force_of: Callable[[SimulatedUsers], np.ndarray],
    *,
    variant: str,
    seconds: float,
    advisors: Advisors | None = None,
) -> SimulatedUsers:
    """Play one game of `seconds` per person (left) against a copy of the same person (right).

    Args:
        people: (n,) of `USER_PARAMETERS`.
        streams: (n,) uint64, the generators of people, copies and serves; equal ones begin equal games.
        force_of: the people -> (n, 2) force in N for the next tick.

    Returns:
        The people after the game.
    """
    n, no_force = len(people), np.zeros((len(people), 2))
    users, copies = (
        SimulatedUsers(people, streams ^ np.uint64(player), TABLE, variant, advisors) for player in (LEFT, RIGHT)
    )
    tables = World(n, TABLE)
    tables.rng[:] = streams
    tables.new_rounds()
    left, right, actions = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros((n, 2, 2))
    for _ in range(round(seconds / TABLE.tick)):
        actions[:, LEFT] = users.step(tables.observe(LEFT, left), force_of(users))
        actions[:, RIGHT] = copies.step(tables.observe(RIGHT, right), no_force)
        tables.step(actions)
        scored = tables.goals != 0
        if scored.any():
            tables.new_rounds(scored)
            for players in (users, copies):
                players.new_round(scored)
    return users


def anchor_signals(
    people: np.ndarray, spring: Spring, grades: Sequence[float] = GRADES, *, seed: int = 0, **game
) -> np.ndarray:
    """The signals (grades, anchors, n, 6) of a game under each force, see `play`; all with the same serves and noise.

    Args:
        people: (n,) of `USER_PARAMETERS`, two at least.
        spring: the guidance's.
    """
    games, n = len(grades) * len(ANCHORS), len(people)
    forces = AnchorForces(spring, grades, n, seed)
    users = play(np.tile(people, games), np.tile(personal_streams(n, seed), games), forces, **game)
    return users.signals.reshape(len(grades), len(ANCHORS), n, len(SIGNALS))


def signal_units(signals: np.ndarray) -> dict[str, float]:
    """The unit of each of `SIGNALS`, see `UNIT_ANCHORS`: the size of its mean over people, from `anchor_signals`.

    Raises:
        ValueError: an anchor does not have the sign that it must have; play longer, or with more people.
    """
    ends, units = signals[-1].mean(axis=1), {}
    for column, name in enumerate(SIGNALS):
        value = float(ends[ANCHORS.index(UNIT_ANCHORS[name]), column]) * (-1.0 if name == SIGNED else 1.0)
        if not value > 0.0:
            raise ValueError(f"unit of {name} = {value} must be above 0, under the force {UNIT_ANCHORS[name]}")
        units[name] = value
    return units


def _rises(values: np.ndarray) -> bool:
    """Whether the mean of differences (n,) is above 0 by more than the noise."""
    return bool(values.mean() > STANDARD_ERRORS * values.std(ddof=1) / np.sqrt(len(values)))


def failures(points: np.ndarray) -> list[str]:
    """What is wrong with the order of one rating under the anchor forces; nothing if the proxy may be used.

    With people as units, by more than `STANDARD_ERRORS` of the paired difference: at no grade may a worse force be
    rated above its better neighbor; the best must be rated above the worst at the last grade; no stronger `anti` may
    be rated above the next weaker one, and the weakest must be rated above the strongest.

    Args:
        points: (grades, anchors, n) expected points.
    """
    found = []
    for grade in range(len(points)):
        for better, worse in pairwise(range(len(ANCHORS))):
            if _rises(points[grade, worse] - points[grade, better]):
                found.append(f"{ANCHORS[worse]} above {ANCHORS[better]} at grade {grade + 1}")
    if not _rises(points[-1, 0] - points[-1, -1]):
        found.append(f"{ANCHORS[0]} not above {ANCHORS[-1]}")
    for grade in range(1, len(points)):
        if _rises(points[grade, -1] - points[grade - 1, -1]):
            found.append(f"{ANCHORS[-1]} better at grade {grade + 1} than at {grade}")
    if not _rises(points[0, -1] - points[-1, -1]):
        found.append(f"weakest {ANCHORS[-1]} not above the strongest")
    return found


class AnchorResults(NamedTuple):
    """What the anchor forces say about the proxies, to be frozen before a study.

    Attributes:
        units: of each signal, from the primary variant.
        failures: per variant and rating, see `failures`.
        table: a row per variant, grade and anchor: the mean and standard error of each rating's expected points, and
            the mean of each signal.
    """

    units: dict[str, float]
    failures: dict[str, dict[str, list[str]]]
    table: pd.DataFrame

    def withdrawn(self, variant: str) -> list[str]:
        """The ratings that fail under a variant."""
        return [name for name, found in self.failures[variant].items() if found]

    def full_strength(self) -> pd.DataFrame:
        """The ratings of `table` at the last grade."""
        return self.table.loc[self.table["grade"] == self.table["grade"].max(), ["variant", "anchor", *RATINGS]]

    def as_yaml(self, primary: str) -> str:
        """`scales` and `withdrawn` of `conf/users`."""
        lines = [f"  {name}: {unit:.4g}  # {UNIT_ANCHORS[name]}" for name, unit in self.units.items()]
        return "\n".join(["scales:", *lines, f"withdrawn: [{', '.join(self.withdrawn(primary))}]"]) + "\n"


def anchor_results(signals: Mapping[str, np.ndarray], primary: str, grades: Sequence[float] = GRADES) -> AnchorResults:
    """Units from the variant `primary`, and the ratings under all variants; `signals` are from `anchor_signals`."""
    units = {name: float(f"{unit:.4g}") for name, unit in signal_units(signals[primary]).items()}  # as written down
    points = {variant: expected_points(values, units) for variant, values in signals.items()}
    rows = []
    for variant, values in points.items():
        for grade, anchor in np.ndindex(values.shape[:2]):
            own = values[grade, anchor]
            row = {"variant": variant, "grade": grades[grade], "anchor": ANCHORS[anchor]}
            row |= dict(zip(RATINGS, own.mean(axis=0), strict=True))
            errors = own.std(axis=0, ddof=1) / np.sqrt(len(own))
            row |= {f"{name}_se": error for name, error in zip(RATINGS, errors, strict=True)}
            rows.append(row | dict(zip(SIGNALS, signals[variant][grade, anchor].mean(axis=0), strict=True)))
    found = {
        variant: {name: failures(values[..., column]) for column, name in enumerate(RATINGS)}
        for variant, values in points.items()
    }
    return AnchorResults(units, found, pd.DataFrame(rows))
