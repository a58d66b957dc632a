"""Play air hockey yourself, and feel the nine guidances.

    airhockey play                                 mouse, against generation 55
    airhockey play opponent=60 device=gamepad      another opponent, another hand
    airhockey play condition=oahg_ut overlay=true  begin with a guidance, and see what the models say

1 to 9 choose one of the conditions (a) to (i), a makes the user model yours, h shows all keys. Writes into its run
folder: for every stretch of play under one condition a table with a row per tick (`..._beh.tsv`) and what describes it
(`.json`). `airhockey watch run=<that folder>` shows them again.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import InputError, command, report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.registry import construct
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import greedy_player
from guidance.display.window import NARROWEST, Window
from guidance.forces.conditions import ADAPTED, Condition
from guidance.haptics.clock import WallClock
from guidance.haptics.open_device import check_device, device_session
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.seat import Quit, RealTimePlayer, leaving_when_told
from guidance.sessions.recording import Game, Recording
from guidance.simulated_users import Population, SimulatedUsers, load_advisors, sample_people
from guidance.simulated_users.force_response import check_variant
from guidance.study.games import GameRunner, MetricsRecorder
from guidance.study.models import Models
from guidance.study.protocol import CALIBRATION_GAME, Protocol, spawn_rng_states
from guidance.study.provenance import load_conditions, load_models
from guidance.study.tick_log import COLUMNS, TickLog, demonstration, scene_facts, tapped_guidance

KEYS = {  # those that choose a condition come before them
    "a": "make the user model yours, from what you have played without guidance",
    "o": "show where the models would go (mean and STD)",
    "page up, page down": "a stronger, a weaker opponent",
    "space": "pause",
    "h": "these keys",
    "f": "full screen",
    "r": "after a safety stop: feel forces again",
    "esc": "leave",
}
LEAST_DEMONSTRATION = 500  # ticks: half a minute adapts as well as eight, and 10 s are something
NOTE_SECONDS = 3.0
STEP = 5  # generations from one opponent to the next


class Play:
    """A game without end, in stretches under one condition and against one opponent.

    Args:
        conditions: by the key that chooses them.
        seat: of the person.
        folder: where the stretches are written.
    """

    def __init__(
        self,
        conditions: dict[str, Condition],
        models: Models,
        opponents: League,
        opponent: int,
        lookahead_seconds: float,
        round_seconds: float,
        seat: RealTimePlayer,
        serves: np.ndarray,
        folder: Path,
    ) -> None:
        self.conditions, self.models, self.opponents, self.seat = conditions, models, opponents, seat
        self.lookahead_seconds, self.round_seconds, self.folder = lookahead_seconds, round_seconds, folder
        self.opponent = range(len(opponents))[opponent]
        self.rink = GameRunner(seat, greedy_player(opponents.player(self.opponent)), TableSpec(), serves)
        self.adapted: TensorDict | None = None
        self.unguided: list[tuple[Tensor, Tensor]] = []
        self.games: dict[str, Game] = {}
        self.labels: dict[str, str] = {}
        self.ticks, self._note_left = 0, 0.0

    def run(self, condition: Condition, seconds: float | None = None) -> None:
        """Play, beginning with a condition, until the person leaves or so much time was played."""
        self._begin(condition)
        ticks = None if seconds is None else max(1, round(seconds / self.log.tick_seconds))
        try:
            self.rink.new_games()
            while ticks is None or self.ticks < ticks:
                self.tick()
        except Quit:
            pass
        finally:
            self._end()

    @torch.no_grad()
    def tick(self) -> None:
        """Play one tick, and do what was pressed during it."""
        tick = self.rink.tick(self.guide)
        self.scoring.add(tick)
        self.ticks += 1
        self._round_ticks += 1
        out_of_time = self._round_ticks * self.log.tick_seconds >= self.round_seconds
        ended = (tick.goals != 0) | out_of_time
        self._rounds += int(ended[0])
        self._show(self.log(tick, True, bool(ended[0])))
        pressed = list(self.seat.taken())
        chosen = [key for key in pressed if key in self.conditions]
        for key in [key for key in pressed if key not in chosen[:-1]]:  # of two at once the later
            self.press(key)
        if ended[0]:
            self._round_ticks = 0
            self._save()
            self._say("out of time" if out_of_time else "goal!" if tick.goals[0] > 0 else "goal against you", 0.0)
            self.rink.new_rounds(ended)

    def press(self, key: str) -> None:
        """Do what a key asks for."""
        if key in self.conditions:
            self.choose(self.conditions[key])
        elif key == "a":
            self.adapt()
        elif key in ("page up", "page down"):
            self.meet(self.opponent + (STEP if key == "page up" else -STEP))

    def choose(self, condition: Condition) -> None:
        """Go on under another condition."""
        if ADAPTED in condition.guidance.models() and self.adapted is None:
            self._say(f"{condition.label} needs a model of you: play without guidance (1), then press a")
        elif condition.name != self.condition.name:
            self._end()
            self._begin(condition)

    def meet(self, opponent: int) -> None:
        """Go on against another generation, the nearest that there is."""
        opponent = min(max(opponent, 0), len(self.opponents) - 1)
        if opponent != self.opponent:
            self._end()
            self.opponent, self.rink.opponent = opponent, greedy_player(self.opponents.player(opponent))
            self._begin(self.condition)
        self._say(f"generation {opponent} of {len(self.opponents) - 1}")

    def adapt(self) -> None:
        """User adaptation (UA, Eq. 1): make the user model the person's own, from all their play without guidance."""
        self._save()
        ticks = sum(len(seen) for seen, _ in self.unguided)
        if ticks < LEAST_DEMONSTRATION:
            missing = (LEAST_DEMONSTRATION - ticks) * self.log.tick_seconds
            self._say(f"play without guidance (1) for {missing:.0f} s more")
            return
        self.adapted = self.models.adapted_to([tuple(map(torch.cat, zip(*self.unguided, strict=True)))])
        condition = self.condition
        self._end()
        self._begin(condition)
        self._say(f"the user model is yours now, from {ticks * self.log.tick_seconds:.0f} s of play")

    def summary(self) -> pd.DataFrame:
        """What came of each stretch, a row each."""
        rows = {self.labels[name]: game.results for name, game in self.games.items()}
        return pd.DataFrame.from_dict(rows, orient="index")

    def _unguided(self) -> bool:
        return not self.condition.guidance.models()

    def _begin(self, condition: Condition) -> None:
        self.condition, table = condition, self.rink.tables.table
        self.guide, overheard = tapped_guidance(condition, self.models, self.adapted, self.lookahead_seconds)
        self.log = TickLog(overheard, table.tick, self.seat.hand)
        self.scoring = MetricsRecorder(self.rink)
        self._round_ticks, self._rounds, nth = 0, 0, len(self.games) + 1
        name = f"{nth:02d}{condition.name.replace('_', '')}"
        self.labels[name] = f"{nth:02d} {condition.label}, generation {self.opponent}"
        facts = scene_facts(condition, "you", f"generation {self.opponent}", self.adapted is not None)
        stem = self.folder / f"task-airhockey_acq-{name}"
        self.recording = Recording.begin(stem, name, nth, COLUMNS, facts, self.games)
        self.seat.moment.title = f"{condition.label}, generation {self.opponent}"

    def _save(self) -> None:
        rows = self.log.take()
        self.recording.append(rows)
        if rows and self._unguided():
            self.unguided.append(demonstration(pd.DataFrame(rows)))

    def _end(self) -> None:
        """Write down the stretch that is over; its score begins anew."""
        self._save()
        measured = {**self.scoring.results(), **self.scoring.weights()}
        numbers = {name: float(values[0]) for name, values in measured.items()}
        self.recording.finish(numbers | {"rounds": self._rounds, "duration_s": self.log.time})

    def _show(self, row: dict[str, float]) -> None:
        moment, overheard = self.seat.moment, self.log.overheard
        moment.optimal, moment.predicted = overheard.optimal, overheard.predicted
        names = {"w_unc_optimal": "W_unc optimal", "w_unc_predicted": "W_unc predicted", "w_sim": "W_sim"}
        moment.weights = {text: row[name] for name, text in names.items() if row[name] == row[name]}
        moment.won, moment.lost, moment.seconds = int(row["won"]), int(row["lost"]), row["time_s"]
        self._note_left -= self.log.tick_seconds
        if self._note_left <= 0:
            moment.note = ""

    def _say(self, note: str, seconds: float = NOTE_SECONDS) -> None:
        self.seat.moment.note, self._note_left = note, seconds


@command("play")
def main(cfg: DictConfig) -> None:
    with report_input_errors():
        require_counts(cfg, "frames_per_second", "threads")
        require_counts(cfg, "width", least=NARROWEST)
        require_counts(cfg, "seed", least=0)
        require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)
        require_numbers(cfg, "breath", least=0.0, at_most=10.0)
        if cfg.seconds is not None:
            require_numbers(cfg, "seconds")
        protocol: Protocol = construct(Protocol, cfg.study, "study")
        check_device(cfg.device)
        begin_with: Condition = load_conditions(cfg)[0]
        if ADAPTED in begin_with.guidance.models():
            raise InputError(f"condition = {begin_with.name} needs a model of you: begin with another, and press a")
        cfg.condition = None
        conditions = {str(i + 1): condition for i, condition in enumerate(load_conditions(cfg))}
        models = load_models(cfg)
        opponents = League.load(cfg.models.opponents)
        opponents.player(cfg.opponent)
        limits: SafetyLimits = construct(SafetyLimits, cfg.safety, "safety")
        minds, serves = (spawn_rng_states(cfg.seed, [0], CALIBRATION_GAME, purpose) for purpose in (0, 1))
        person = None
        if cfg.device.kind == "simulated":
            check_variant(cfg.users.variant)
            population: Population = construct(Population, cfg.users.population, "users.population")
            people, mentors = sample_people(1, cfg.seed, population), load_advisors(cfg.users.mentors)
            person = SimulatedUsers(people, minds, TableSpec(), cfg.users.variant, mentors)
    torch.set_num_threads(cfg.threads)
    folder, clock, table = Path(HydraConfig.get().runtime.output_dir), WallClock(), TableSpec()
    keys = {key: f"({condition.letter}) {condition.label}" for key, condition in conditions.items()} | KEYS
    with (
        Window("Air hockey", table, cfg.width, cfg.frames_per_second, clock, keys) as window,
        device_session(cfg.device, limits, person) as held,
    ):
        window.overlay, window.pointed, window.unplugged = cfg.overlay, held.pointed, held.unplugged
        seat = RealTimePlayer(held.hand, window, clock, table.tick, cfg.breath, person)
        how = cfg.guidance.lookahead, protocol.round_seconds
        play = Play(conditions, models, opponents, cfg.opponent, *how, seat, serves, folder)
        with leaving_when_told():
            play.run(begin_with, cfg.seconds)
    shown = play.summary()[["rounds", "win_rate", "mean_smash_speed", "defense_rate", "mean_disagreement"]]
    print(shown.to_string(float_format="%.2f", na_rep="–"))
    print(f"\nagain: airhockey watch run={folder}")


if __name__ == "__main__":
    main()
