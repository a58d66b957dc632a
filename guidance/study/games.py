"""Games of section 4.2 side by side, with simulated or real participants: familiarization, rounds, metrics.

Each game has random number streams of its own, so its results are bit-identical whichever other games are played at the
same time. A finished game takes no more time.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from typing import Protocol as Interface

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec
from airhockey_marl.envs.world import World
from airhockey_marl.players.players import Player
from guidance.forces.conditions import GuidanceOutput
from guidance.study.metrics import (
    EXTRA_METRICS,
    METRIC_COUNTERS,
    RunningMoments,
    count_values,
    disagreement,
    metric_values,
    record,
)
from guidance.study.protocol import Protocol, ProtocolState


class Participants(Interface):
    """n simulated or real people at their devices."""

    @property
    def action(self) -> np.ndarray: ...  # (n, 2) hand position over its reach

    def new_round(self, mask: np.ndarray) -> None: ...  # (n,) bool

    def new_game(self, mask: np.ndarray) -> None: ...

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray) -> np.ndarray: ...


Forces = Callable[[np.ndarray, np.ndarray, np.ndarray], GuidanceOutput]
"""States (n, 12), actions (n, 2) and k games -> their forces and weights."""


def no_force(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
    """No force in any game (NHG)."""
    return GuidanceOutput(torch.zeros(len(games), 2, dtype=torch.float64))


class GameStep(NamedTuple):
    """One tick of n games; the next tick overwrites its arrays.

    Attributes:
        games: (k,) the games that were played.
        state: (n, 12) the state at its beginning, as `World.observe` writes it for the left side.
        before, action: (n, 2) hand position over its reach, at its beginning and at its end.
        guidance: the forces (k, 2) of the games that were played, and their weights.
        goals: (n,) +1 if the participant scored, -1 if the opponent did.
    """

    games: np.ndarray
    state: np.ndarray
    before: np.ndarray
    action: np.ndarray
    guidance: GuidanceOutput
    goals: np.ndarray


class GameRunner:
    """n tables with participants at the left and one opponent at the right of all of them.

    Args:
        serves: (n,) uint64, the states of the tables' random number streams.

    Attributes:
        force: (n, 2) the last force on each hand, N.
        puck_before: (n, 4) the pucks at the beginning of the last tick.
    """

    def __init__(self, participants: Participants, opponent: Player, table: TableSpec, serves: np.ndarray) -> None:
        n = len(serves)
        self.participants, self.opponent, self.tables = participants, opponent, World(n, table)
        self.tables.rng[:] = serves
        self.everyone, self._all = np.ones(n, dtype=bool), np.arange(n)
        self._state, self._opponent_observation = np.empty((n, 12)), np.empty((n, 12), dtype=np.float32)
        self.force, self._actions = np.zeros((n, 2)), np.zeros((n, 2, 2))

    def new_games(self, games: np.ndarray | None = None) -> None:
        """Begin the games (k,), all of them if None."""
        mask = self.everyone if games is None else np.isin(self._all, games)
        self.tables.new_rounds(mask)
        self.participants.new_game(mask)

    def new_rounds(self, mask: np.ndarray) -> None:
        """Begin a round at the tables of a mask (n,)."""
        self.tables.new_rounds(mask)
        self.participants.new_round(mask)

    def tick(self, forces: Forces = no_force, games: np.ndarray | None = None) -> GameStep:
        """Play one tick at the tables `games` (k,), at all of them if None."""
        games = self._all if games is None else games
        tables, actions = self.tables, self._actions
        tables.observe(LEFT, self._state)
        self.puck_before = tables.bodies[:, PUCK].copy()
        before = self.participants.action.copy()
        guidance = forces(self._state, before, games)
        self.force[games] = guidance.force.numpy()
        actions[:, LEFT] = self.participants.step(self._state, self.force, games)
        tables.observe(RIGHT, self._opponent_observation)
        actions[games, RIGHT] = self.opponent(torch.from_numpy(self._opponent_observation[games])).numpy()
        tables.step(actions, indices=games)
        return GameStep(games, self._state, before, actions[:, LEFT], guidance, tables.goals)


class MetricsRecorder:
    """Accumulates the objective metrics of games and the moments of their guidance weights.

    Args:
        extra: names of `EXTRA_METRICS` that are measured too.
    """

    def __init__(self, runner: GameRunner, extra: Sequence[str] = ()) -> None:
        n = len(runner.everyone)
        self._extra = {name: EXTRA_METRICS.find(name, "metrics")(n, runner.tables.table) for name in extra}
        self.runner, self._counters = runner, np.zeros(n, dtype=METRIC_COUNTERS)
        self._weights = {name: RunningMoments(n) for name in GuidanceOutput._fields[1:]}

    def add(self, tick: GameStep) -> None:
        """Add the last tick of the runner."""
        runner, tables = self.runner, self.runner.tables
        conflict = disagreement(runner.force, tick.action - tick.before)
        pucks = runner.puck_before, tables.bodies[:, PUCK]
        record(self._counters, tick.games, *pucks, tables.touched, tables.served, tick.goals, conflict, tables.table)
        for name, moments in self._weights.items():
            if getattr(tick.guidance, name) is not None:
                moments.add(tick.games, getattr(tick.guidance, name).numpy())
        for metric in self._extra.values():
            metric.add(tick)

    def results(self) -> dict[str, np.ndarray]:
        """The objective metrics so far, (n,) each."""
        return metric_values(self._counters) | {name: metric.values() for name, metric in self._extra.items()}

    def counts(self, rounds: np.ndarray) -> dict[str, np.ndarray]:
        """See `guidance.study.metrics.count_values`; `rounds` (n,) are those so far."""
        return count_values(self._counters, rounds)

    def weights(self) -> dict[str, np.ndarray]:
        """Mean and SD (n,) of each weight so far."""
        both = {name: moments.result() for name, moments in self._weights.items()}
        return {f"{name}_{part}": values[i] for name, values in both.items() for i, part in enumerate(("mean", "sd"))}


@dataclass
class Games:
    """The results of n games.

    Attributes:
        results: the objective metrics, (n,) each.
        rounds, seconds: (n,) rounds, and s of scored play.
        weights: mean and SD (n,) of each weight within each game.
        counts: see `guidance.study.metrics.count_values`.
        demonstrations: per game the observations (ticks, 12) and actions (ticks, 2) of scored play, if kept.
    """

    results: dict[str, np.ndarray]
    rounds: np.ndarray
    seconds: np.ndarray
    weights: dict[str, np.ndarray]
    counts: dict[str, np.ndarray]
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
    on_tick: Callable[[GameStep, bool, np.ndarray], None] = lambda tick, scored, ended: None,
    extra_metrics: Sequence[str] = (),
    waves: Iterable[np.ndarray] | None = None,
) -> Games:
    """Play one game at each of n tables, participants at the left.

    Args:
        opponent: plays at the right of all tables.
        forces: the guidance.
        serves: (n,) uint64, the states of the tables' random number streams.
        keep_demonstrations: keep the observations and actions of scored play.
        progress: called with the share of the rounds that are over.
        on_tick: called with every tick, whether it is scored, and the mask (n,) of the rounds that end with it.
        extra_metrics: names of `EXTRA_METRICS` that are measured beside the paper's four.
        waves: games (k,) int64 each, ascending: those of a wave are played side by side, wave after wave, each game in
            one of them; a wave is asked for when the one before is over. All games at once if None.
    """
    n = len(serves)
    runner, state = GameRunner(participants, opponent, table, serves), ProtocolState(n, protocol, table.tick)
    metrics = MetricsRecorder(runner, extra_metrics)
    trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    for wave in [np.arange(n)] if waves is None else waves:
        state.begin(wave)
        runner.new_games(wave)
        while len(games := state.playing):
            if state.begin_scoring():
                runner.new_games(wave)
            tick = runner.tick(forces, games)
            if state.scored:
                metrics.add(tick)
                if keep_demonstrations:
                    trail.append((games, tick.state[games].astype(np.float32), tick.action[games].astype(np.float32)))
            scored, ended = state.scored, state.tick(tick.goals)
            on_tick(tick, scored, ended)
            if ended.any():
                runner.new_rounds(ended)
                progress(float(np.minimum(state.rounds / protocol.rounds, 1).mean()))

    return Games(
        results=metrics.results(),
        rounds=state.rounds,
        seconds=state.ticks * table.tick,
        weights=metrics.weights(),
        counts=metrics.counts(state.rounds),
        demonstrations=_by_game(trail, n),
    )


def _by_game(trail: list[tuple[np.ndarray, np.ndarray, np.ndarray]], n: int) -> list[tuple[Tensor, Tensor]]:
    if not trail:
        return []
    games, states, actions = (np.concatenate(part) for part in zip(*trail, strict=True))
    order, ends = np.argsort(games, kind="stable"), np.cumsum(np.bincount(games, minlength=n))[:-1]
    parts = (np.split(part[order], ends) for part in (states, actions))
    return [(torch.from_numpy(x), torch.from_numpy(y)) for x, y in zip(*parts, strict=True)]
