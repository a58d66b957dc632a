"""Free play at a window: a person switches between guidances and opponents, and every stretch of play is recorded."""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import greedy_player
from guidance.display.scene import WEIGHT_LABELS
from guidance.forces.conditions import ADAPTED, Condition
from guidance.forces.lookahead import Lookahead
from guidance.haptics.screen import Quit
from guidance.haptics.seat import RealTimePlayer
from guidance.sessions.game import Game
from guidance.sessions.recording import Recording
from guidance.sessions.session import OUTCOMES
from guidance.sessions.tick_log import COLUMNS, TickLog, demonstration, scene_facts, tapped_guidance
from guidance.study.games import GameRunner, MetricsRecorder
from guidance.study.models import Models
from guidance.user_model.data import MIN_DEMONSTRATION_TICKS

NOTE_SECONDS = 3.0  # s for which a note is shown
OPPONENT_STEP = 5  # generations between two opponents of page up and page down


class FreePlay:
    """An endless game, recorded in one file per stretch under one condition and against one opponent.

    Args:
        conditions: key -> condition.
        models: the optimal action model and the user model.
        opponents: league of possible opponents.
        opponent: generation of the first opponent.
        lookahead: of the guidance.
        round_seconds: s, maximum duration of a round.
        player: the person at the device.
        serves: (1,) uint64, random number state of the serves.
        folder: of the recordings.
    """

    def __init__(
        self,
        conditions: dict[str, Condition],
        models: Models,
        opponents: League,
        opponent: int,
        lookahead: Lookahead,
        round_seconds: float,
        player: RealTimePlayer,
        serves: np.ndarray,
        folder: Path,
    ) -> None:
        self.conditions, self.models, self.opponents, self.player = conditions, models, opponents, player
        self.lookahead, self.round_seconds, self.folder = lookahead, round_seconds, folder
        self.opponent = range(len(opponents))[opponent]
        self.runner = GameRunner(player, greedy_player(opponents.player(self.opponent)), TableSpec(), serves)
        self.adapted: TensorDict | None = None
        self.demonstrations: list[tuple[Tensor, Tensor]] = []
        self.games: dict[str, Game] = {}
        self._conditions: list[str] = []  # of the games
        self.ticks, self._note_seconds = 0, 0.0

    def run(self, condition: Condition, seconds: float | None = None) -> None:
        """Play, starting with a condition, until the person quits or `seconds` were played."""
        self._begin(condition)
        ticks = None if seconds is None else max(1, round(seconds / self.log.tick_seconds))
        try:
            self.runner.new_games()
            while ticks is None or self.ticks < ticks:
                self.tick()
        except Quit:
            pass
        finally:
            self._end()

    @torch.no_grad()
    def tick(self) -> None:
        """Play one tick, then process the keys pressed during it."""
        tick = self.runner.tick(self.forces)
        self.metrics.add(tick)
        self.ticks += 1
        self._round_ticks += 1
        out_of_time = self._round_ticks * self.log.tick_seconds >= self.round_seconds
        is_end = (tick.goals != 0) | out_of_time
        self._rounds += int(is_end[0])
        self._show(self.log(tick, True, bool(is_end[0])))
        pressed = self.player.take_keys()
        choices = [key for key in pressed if key in self.conditions]
        for key in [key for key in pressed if key not in choices[:-1]]:  # of several choices the last
            self.press(key)
        if is_end[0]:
            self._round_ticks = 0
            self._save()
            self._note(self.player.texts[OUTCOMES[int(tick.goals[0])]], 0.0)
            self.runner.new_rounds(is_end)

    def press(self, key: str) -> None:
        """Process a key."""
        if key in self.conditions:
            self.choose(self.conditions[key])
        elif key == "a":
            self.adapt()
        elif key in ("page up", "page down"):
            self.change_opponent(self.opponent + (OPPONENT_STEP if key == "page up" else -OPPONENT_STEP))

    def choose(self, condition: Condition) -> None:
        """Continue under another condition."""
        if ADAPTED in condition.guidance.models() and self.adapted is None:
            self._note(f"{condition.label} needs a model of you: play without guidance (1), then press a")
        elif condition.name != self.condition.name:
            self._end()
            self._begin(condition)

    def change_opponent(self, opponent: int) -> None:
        """Continue against another generation, clipped to the existing ones."""
        opponent = min(max(opponent, 0), len(self.opponents) - 1)
        if opponent != self.opponent:
            self._end()
            self.opponent, self.runner.opponent = opponent, greedy_player(self.opponents.player(opponent))
            self._begin(self.condition)
        self._note(f"generation {opponent} of {len(self.opponents) - 1}")

    def adapt(self) -> None:
        """User adaptation (UA, Eq. 1): adapt the user model to all play of the person without guidance."""
        self._save()
        ticks = sum(len(observation) for observation, _ in self.demonstrations)
        if ticks < MIN_DEMONSTRATION_TICKS:
            missing = (MIN_DEMONSTRATION_TICKS - ticks) * self.log.tick_seconds
            self._note(f"play without guidance (1) for {missing:.0f} s more")
            return
        self.adapted = self.models.adapted_to([tuple(map(torch.cat, zip(*self.demonstrations, strict=True)))])
        condition = self.condition
        self._end()
        self._begin(condition)
        self._note(f"the user model is yours now, from {ticks * self.log.tick_seconds:.0f} s of play")

    def summary(self) -> pd.DataFrame:
        """The results, a row per stretch."""
        games = self.games.values()
        labels = [f"{game.position:02d} {game.facts['title']}, {game.facts['opponent']}" for game in games]
        return pd.DataFrame([game.results for game in games], index=labels)

    def counts(self) -> pd.DataFrame:
        """The columns of `counts.csv`, a row per stretch."""
        games = zip(self._conditions, self.games.values(), strict=True)
        rows = [{"user": "you", "condition": name, "position": game.position, **game.counts} for name, game in games]
        return pd.DataFrame(rows)

    def _begin(self, condition: Condition) -> None:
        self.condition, table = condition, self.runner.tables.table
        self.forces, tap = tapped_guidance(condition, self.models, self.adapted, self.lookahead)
        self.log = TickLog(tap, table.tick, self.player.hand)
        self.metrics = MetricsRecorder(self.runner)
        self._round_ticks, self._rounds, number = 0, 0, len(self.games) + 1
        name = f"{number:02d}{condition.name.replace('_', '')}"
        facts = scene_facts(condition, "you", f"generation {self.opponent}", self.adapted is not None)
        stem = self.folder / f"task-airhockey_acq-{name}"
        self.recording = Recording(stem, name, number, COLUMNS, facts, self.games)
        self.player.display.title = f"{condition.label}, generation {self.opponent}"

    def _save(self) -> None:
        rows = self.log.take()
        self.recording.append(rows)
        if rows and not self.condition.guidance.models():
            self.demonstrations.append(demonstration(pd.DataFrame(rows)))

    def _end(self) -> None:
        """Save the results of the current stretch."""
        self._save()
        results = {**self.metrics.results(), **self.metrics.weights(), **self.metrics.counts(self._rounds)}
        numbers = {name: float(values[0]) for name, values in results.items()}
        self.recording.finish(numbers | {"rounds": self._rounds, "duration_s": self.log.time})
        self._conditions.append(self.condition.name)

    def _show(self, row: dict[str, float]) -> None:
        display, tap = self.player.display, self.log.tap
        display.optimal, display.predicted = tap.optimal, tap.predicted
        display.weights = {text: row[name] for name, text in WEIGHT_LABELS.items() if row[name] == row[name]}
        display.won, display.lost, display.seconds = int(row["won"]), int(row["lost"]), row["time_s"]
        self._note_seconds -= self.log.tick_seconds
        if self._note_seconds <= 0:
            display.note = ""

    def _note(self, note: str, seconds: float = NOTE_SECONDS) -> None:
        self.player.display.note, self._note_seconds = note, seconds
