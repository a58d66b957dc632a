"""The protocol of section 4.2, the same whoever sits at the device.

An unscored game without guidance, user adaptation from it, then one game per condition in counterbalanced order:
30 s to get used to it, 7 rounds, up to three more while the game is under two minutes, then the ratings.

Games are played side by side, one table each. Each game has its own streams of random numbers, which follow from the
seed, the user and the condition: which other conditions are in the run does not change them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol as Interface

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from airhockey_marl.match import Player
from airhockey_marl.table import LEFT, PUCK, RIGHT, Table
from airhockey_marl.tables import Tables
from guidance.conditions import Condition, Guided
from guidance.metrics import Moments, disagreement, new_sheets, record, results
from guidance.models import Guide, Models
from guidance.users import Mentors, Users

NO_CONDITION = 99  # in the seeds, the unscored game counts as a condition of its own
LETTERS = "abcdefghi"


class Participants(Interface):
    """n people at their devices, simulated or real: all that a game asks of them."""

    @property
    def action(self) -> np.ndarray: ...  # (n, 2) where the hand is, over its reach

    def new_round(self, which: np.ndarray) -> None: ...

    def new_game(self, which: np.ndarray) -> None: ...

    def step(self, state: np.ndarray, force: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Protocol:
    """How long a game is (section 4.2).

    Attributes:
        familiarisation: s of unscored play before each game.
        rounds: rounds of a game.
        extra_rounds: at most so many more, while the game is shorter than `min_seconds`.
        min_seconds: s.
        round_seconds: s after which a round without a goal ends undecided.
    """

    familiarisation: float
    rounds: int
    extra_rounds: int
    min_seconds: float
    round_seconds: float

    def __post_init__(self) -> None:
        for name, least in (("familiarisation", 0), ("rounds", 1), ("extra_rounds", 0), ("min_seconds", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"study.{name} = {getattr(self, name)} must be at least {least}")
        if not self.round_seconds > 0:
            raise ValueError(f"study.round_seconds = {self.round_seconds} must be above 0")


@dataclass
class Games:
    """What n games side by side have brought.

    Attributes:
        results: the objective metrics, (n,) each.
        rounds, seconds: (n,) rounds played, and s of scored play.
        weights: mean and SD (n,) of each weight within each game.
        demonstrations: per game the scored observations (ticks, 12) and actions (ticks, 2), if they were asked for.
    """

    results: dict[str, np.ndarray]
    rounds: np.ndarray
    seconds: np.ndarray
    weights: dict[str, np.ndarray]
    demonstrations: list[tuple[Tensor, Tensor]]


Forces = Callable[[np.ndarray, np.ndarray], Guided]  # states (n, 12), actions (n, 2) -> forces and weights


def no_force(state: np.ndarray, action: np.ndarray) -> Guided:
    """NHG for everyone."""
    return Guided(torch.zeros(action.shape, dtype=torch.float64))


def streams(seed: int, users: Sequence[int], condition: int, purpose: int) -> np.ndarray:
    """(users,) uint64: a stream for each user's game in a condition; purpose 0 is the person, 1 the table."""
    keys = [np.random.SeedSequence([seed, user, condition, purpose]) for user in users]
    return np.array([key.generate_state(1, np.uint64)[0] for key in keys], dtype=np.uint64)


@torch.no_grad()
def play_games(
    participants: Participants,
    opponent: Player,
    forces: Forces,
    protocol: Protocol,
    table: Table,
    table_streams: np.ndarray,
    keep_demonstrations: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Games:
    """Play one game at each of n tables; participants sit at the left seat.

    Args:
        opponent: plays the right seat of all tables.
        forces: the guidance of each row.
        table_streams: (n,) uint64, the serves' random numbers.
        keep_demonstrations: keep what was seen and done in scored play.
        progress: is told the share of the rounds that are over.
    """
    n = len(table_streams)
    tables = Tables(n, table)
    tables.rng[:] = table_streams
    everyone = np.ones(n, dtype=bool)
    tables.new_rounds()
    participants.new_game(everyone)

    sheets, weights = new_sheets(n), {name: Moments(n) for name in Guided._fields[1:]}
    scored, over = ~everyone, ~everyone
    ticks, round_ticks, rounds = np.zeros((3, n), dtype=np.int64)
    seen, seen_by_opponent = np.empty((n, 12)), np.empty((n, 12), dtype=np.float32)
    actions, seconds = np.zeros((n, 2, 2)), table.tick
    trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    familiarisation, tick = round(protocol.familiarisation / seconds), 0

    while not over.all():
        if tick == familiarisation:  # the game proper begins, for everyone at once
            scored = everyone.copy()
            tables.new_rounds()
            participants.new_game(everyone)
            round_ticks[:] = 0
        tick += 1

        tables.observe(LEFT, seen)
        before, puck_before = participants.action.copy(), tables.bodies[:, PUCK].copy()
        guided = forces(seen, before)
        force = guided.force.numpy()
        actions[:, LEFT] = participants.step(seen, force)
        actions[:, RIGHT] = opponent(torch.from_numpy(tables.observe(RIGHT, seen_by_opponent))).numpy()
        tables.step(actions)

        if scored.any():
            disagreed = disagreement(force, actions[:, LEFT] - before)
            after = tables.bodies[:, PUCK]
            record(sheets, scored, puck_before, after, tables.touched, tables.served, tables.goals, disagreed, table)
            for name, moments in weights.items():
                if getattr(guided, name) is not None:
                    values = getattr(guided, name).numpy()
                    moments.add(scored & np.isfinite(values), values)
            if keep_demonstrations:
                trail.append((scored.copy(), seen.astype(np.float32), actions[:, LEFT].astype(np.float32)))
        ticks += scored
        round_ticks += 1
        ended = (tables.goals != 0) | (round_ticks * seconds >= protocol.round_seconds)
        if ended.any():
            rounds += ended & scored
            long_enough = (ticks * seconds >= protocol.min_seconds) | (
                rounds >= protocol.rounds + protocol.extra_rounds
            )
            over |= scored & ended & (rounds >= protocol.rounds) & long_enough
            scored &= ~over
            round_ticks[ended] = 0
            tables.new_rounds(ended)
            participants.new_round(ended)
            progress(float(np.minimum(rounds / protocol.rounds, 1).mean()))

    summaries = {name: moments.result() for name, moments in weights.items()}
    return Games(
        results=results(sheets),
        rounds=rounds,
        seconds=ticks * seconds,
        weights={
            f"{name}_{part}": values[i] for name, values in summaries.items() for i, part in enumerate(("mean", "sd"))
        },
        demonstrations=_by_game(trail, n),
    )


def _by_game(trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]], n: int) -> list[tuple[Tensor, Tensor]]:
    if not trail:
        return []
    scored, seen, done = (np.stack(part) for part in zip(*trail, strict=True))
    return [(torch.from_numpy(seen[scored[:, i], i]), torch.from_numpy(done[scored[:, i], i])) for i in range(n)]


def williams(conditions: int) -> np.ndarray:
    """A Williams design: orders (rows) in which each condition follows each other one equally often.

    Returns:
        (k, conditions) indices; k = conditions if their number is even, twice that if it is odd.
    """
    first = [0]
    for step in range(1, conditions):
        first.append((first[-1] + (step if step % 2 else -step)) % conditions)
    square = (np.array(first) + np.arange(conditions)[:, None]) % conditions
    return square if conditions % 2 == 0 else np.concatenate([square, square[:, ::-1]])


def order_of(users: int, conditions: int, seed: int) -> np.ndarray:
    """(users, conditions) the position, from 1, at which each user plays each condition.

    Users get the rows of a Williams design in random order; it is balanced where their number is a multiple of its.
    """
    design, rng = williams(conditions), np.random.default_rng([seed, users])
    rows = np.concatenate([rng.permutation(len(design)) for _ in range(-(-users // len(design)))])[:users]
    return np.argsort(design[rows], axis=1) + 1


def run_study(
    people: np.ndarray,
    conditions: Sequence[Condition],
    models: Models,
    opponent: Player,
    lookahead_seconds: float,
    protocol: Protocol,
    table: Table,
    variant: str,
    mentors: Mentors,
    rating_scales: dict[str, float],
    seed: int,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> pd.DataFrame:
    """Put simulated people through the whole protocol.

    Args:
        people: (users,) structured array, see `guidance.users`.
        progress: is told what is going on, and the share of it that is done.

    Returns:
        One row per user and condition: the columns of `trials.csv`.
    """
    users = range(len(people))

    def games_of(games: Sequence[int], forces: Forces, what: str, demonstrations: bool = False):
        minds, serves = (np.concatenate([streams(seed, users, g, p) for g in games]) for p in (0, 1))
        participants = Users(np.tile(people, len(games)), minds, table, variant, mentors)
        return participants, play_games(
            participants, opponent, forces, protocol, table, serves, demonstrations, partial(progress, what)
        )

    adapted = None
    if any("adapted" in condition.guidance.models() for condition in conditions):
        _, unscored = games_of([NO_CONDITION], no_force, "unscored game", demonstrations=True)
        adapted = models.adapted_to(unscored.demonstrations)

    guide = Guide(conditions, len(people), models, adapted, lookahead_seconds)
    participants, games = games_of([LETTERS.index(c.letter) for c in conditions], guide, "games")
    columns = {
        **games.results,
        **participants.ratings(rating_scales),
        "rounds": games.rounds,
        "duration_s": games.seconds,
        **games.weights,
    }
    position = order_of(len(people), len(LETTERS), seed)
    rows = []
    for c, condition in enumerate(conditions):
        for u in users:
            row: dict[str, object] = {"user": f"S{u + 1:02d}", "condition": condition.name}
            row["position"] = position[u, LETTERS.index(condition.letter)]
            row |= {name: values[c * len(people) + u] for name, values in columns.items()}
            if condition.letter == "a":
                row["mean_disagreement"] = np.nan  # there is no force to disagree with (section 5.2)
            rows.append(row | {"seed": seed})
    return pd.DataFrame(rows)
