"""Games of section 4.2, side by side, whoever sits at the device: unscored play, rounds, extra rounds, metrics.

Each game has its own streams of random numbers and is played as if it were alone: which others are on at the same time
does not change a bit of it, and one that is over costs nothing more.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple
from typing import Protocol as Interface

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from airhockey_marl.experiment.validation import check_arrays, check_rows
from airhockey_marl.players.players import Player
from guidance.forces.conditions import GuidanceOutput
from guidance.study.metrics import RunningMoments, disagreement, metric_values, new_counters, record
from guidance.study.protocol import Protocol, ProtocolState


class Participants(Interface):
    """n people at their devices, simulated or real: all that a game asks of them."""

    @property
    def action(self) -> np.ndarray: ...  # (n, 2) where the hand is, over its reach

    def new_round(self, which: np.ndarray) -> None: ...  # (n,) bool

    def new_game(self, which: np.ndarray) -> None: ...

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray) -> np.ndarray: ...


Forces = Callable[[np.ndarray, np.ndarray, np.ndarray], GuidanceOutput]
"""States (n, 12), actions (n, 2) and k games -> their forces and weights."""


def no_force(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
    """NHG for everyone."""
    return GuidanceOutput(torch.zeros(len(games), 2, dtype=torch.float64))


class GameStep(NamedTuple):
    """What one tick of n games was; its arrays are written anew by the next one.

    Attributes:
        games: (k,) those that were played.
        state: (n, 12) what the participants saw at its beginning, as `tables.observe` writes it.
        before, action: (n, 2) where the hand was at its beginning and at its end, over its reach.
        guided: the forces (k, 2) of the games that were played, and their weights.
        goals: (n,) +1 the participant scored, -1 the opponent.
    """

    games: np.ndarray
    state: np.ndarray
    before: np.ndarray
    action: np.ndarray
    guided: GuidanceOutput
    goals: np.ndarray


class GameRunner:
    """n tables with a participant at each left seat and one opponent at all the right ones.

    Args:
        serves: (n,) uint64, the tables' random numbers.

    Attributes:
        force: (n, 2) N, what each hand felt last.
        puck_before: (n, 4) the pucks before the last tick.
    """

    def __init__(self, participants: Participants, opponent: Player, table: TableSpec, serves: np.ndarray) -> None:
        check_arrays("u", serves=(serves, "n"))
        n = len(serves)
        self.participants, self.opponent, self.tables = participants, opponent, World(n, table)
        self.tables.rng[:] = serves
        self.everyone, self._all = np.ones(n, dtype=bool), np.arange(n)
        self._seen, self._seen_by_opponent = np.empty((n, 12)), np.empty((n, 12), dtype=np.float32)
        self.force, self._actions = np.zeros((n, 2)), np.zeros((n, 2, 2))

    def new_games(self) -> None:
        """Begin everybody's game."""
        self.tables.new_rounds()
        self.participants.new_game(self.everyone)

    def new_rounds(self, which: np.ndarray) -> None:
        """Begin a round at the tables of a mask (n,)."""
        self.tables.new_rounds(which)
        self.participants.new_round(which)

    def tick(self, forces: Forces = no_force, games: np.ndarray | None = None) -> GameStep:
        """Play one tick at the tables `games` (k,), at all of them if None."""
        if games is None:
            games = self._all
        else:
            check_rows("games", games, len(self._all))
        tables, actions = self.tables, self._actions
        tables.observe(LEFT, self._seen)
        self.puck_before = tables.bodies[:, PUCK].copy()
        before = self.participants.action.copy()
        guided = forces(self._seen, before, games)
        self.force[games] = guided.force.numpy()
        actions[:, LEFT] = self.participants.step(self._seen, self.force, games)
        tables.observe(RIGHT, self._seen_by_opponent)
        actions[games, RIGHT] = self.opponent(torch.from_numpy(self._seen_by_opponent[games])).numpy()
        tables.step(actions, indices=games)
        return GameStep(games, self._seen, before, actions[:, LEFT], guided, tables.goals)


class MetricsRecorder:
    """The objective metrics of the games on a rink, and the moments of their weights, kept tick by tick."""

    def __init__(self, rink: GameRunner) -> None:
        n = len(rink.everyone)
        self.rink, self._sheets = rink, new_counters(n)
        self._weights = {name: RunningMoments(n) for name in GuidanceOutput._fields[1:]}

    def add(self, tick: GameStep) -> None:
        """Enter the tick that the rink has just played."""
        rink, tables = self.rink, self.rink.tables
        disagreed = disagreement(rink.force, tick.action - tick.before)
        pucks = rink.puck_before, tables.bodies[:, PUCK]
        record(self._sheets, tick.games, *pucks, tables.touched, tables.served, tick.goals, disagreed, tables.table)
        for name, moments in self._weights.items():
            if getattr(tick.guided, name) is not None:
                moments.add(tick.games, getattr(tick.guided, name).numpy())

    def results(self) -> dict[str, np.ndarray]:
        """The objective metrics so far, (n,) each."""
        return metric_values(self._sheets)

    def weights(self) -> dict[str, np.ndarray]:
        """Mean and SD (n,) of each weight so far."""
        both = {name: moments.result() for name, moments in self._weights.items()}
        return {f"{name}_{part}": values[i] for name, values in both.items() for i, part in enumerate(("mean", "sd"))}


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


@torch.no_grad()
def play_games(
    participants: Participants,
    opponent: Player,
    forces: Forces,
    protocol: Protocol,
    table: TableSpec,
    serves: np.ndarray,
    keep_demonstrations: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    watching: Callable[[GameStep, bool, np.ndarray], None] = lambda tick, scored, ended: None,
) -> Games:
    """Play one game at each of n tables; participants sit at the left seat.

    Args:
        opponent: plays the right seat of all tables.
        forces: the guidance of each game.
        serves: (n,) uint64, the tables' random numbers.
        keep_demonstrations: keep what was seen and done in scored play.
        progress: is told the share of the rounds that are over.
        watching: is shown every tick, whether it is scored, and the mask (n,) of the rounds that end with it.
    """
    n = len(serves)
    rink, schedule = GameRunner(participants, opponent, table, serves), ProtocolState(n, protocol, table.tick)
    rink.new_games()
    scoring = MetricsRecorder(rink)
    trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    while len(games := schedule.playing):
        if schedule.begins():
            rink.new_games()
        tick = rink.tick(forces, games)
        if schedule.scored:
            scoring.add(tick)
            if keep_demonstrations:
                trail.append((games, tick.state[games].astype(np.float32), tick.action[games].astype(np.float32)))
        scored, ended = schedule.scored, schedule.tick(tick.goals)
        watching(tick, scored, ended)
        if ended.any():
            rink.new_rounds(ended)
            progress(float(np.minimum(schedule.rounds / protocol.rounds, 1).mean()))

    return Games(
        results=scoring.results(),
        rounds=schedule.rounds,
        seconds=schedule.ticks * table.tick,
        weights=scoring.weights(),
        demonstrations=_by_game(trail, n),
    )


def _by_game(trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]], n: int) -> list[tuple[Tensor, Tensor]]:
    if not trail:
        return []
    games, seen, done = (np.concatenate(part) for part in zip(*trail, strict=True))
    order, ends = np.argsort(games, kind="stable"), np.cumsum(np.bincount(games, minlength=n))[:-1]
    parts = (np.split(part[order], ends) for part in (seen, done))
    return [(torch.from_numpy(x), torch.from_numpy(y)) for x, y in zip(*parts, strict=True)]
