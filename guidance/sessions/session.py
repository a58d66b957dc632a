"""The session of one person (section 4.2), from the consent to the last rating.

Each finished step is on the disk before the next begins, so an interrupted session resumes at its first open step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from string import ascii_lowercase
from typing import Protocol as Interface

import numpy as np
from tensordict import TensorDict

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.players.players import Player
from guidance.display.pages import Items, Page
from guidance.forces.conditions import Condition
from guidance.forces.lookahead import Lookahead
from guidance.haptics.screen import DisplayState
from guidance.haptics.seat import RealTimePlayer
from guidance.sessions.game import UNSCORED, read_ticks
from guidance.sessions.participant import Participant
from guidance.sessions.recording import Recording
from guidance.sessions.tick_log import COLUMNS, TickLog, demonstration, scene_facts, tapped_guidance
from guidance.study.games import GameRunner, GameStep, play_games
from guidance.study.models import Models
from guidance.study.protocol import CALIBRATION_GAME, Protocol, RandomStream, counterbalanced_order, spawn_rng_states

SKIP = "s"
OUTCOMES = {1: "notes.goal", -1: "notes.goal_against", 0: "notes.undecided"}  # of a round: goal -> text


class ExperimenterUI(Interface):
    """Pages and questionnaires for the person, and notes of the experimenter; see `guidance.display.window.Window`."""

    def page(self, page: Page) -> str: ...

    def ask(self, items: Items) -> dict[str, int]: ...

    def write_down(self, page: Page) -> str: ...


@dataclass(frozen=True)
class SessionPlan:
    """What is the same for all participants of a study.

    Attributes:
        conditions: the nine conditions, ordered by letter.
        models: the optimal action model and the user model.
        opponent, opponent_label: the right player, and its name.
        protocol, lookahead: as in a study with simulated people.
        participants: number of people for whom the order is counterbalanced.
        seed: of the order and the serves.
        consent: text shown before everything else.
        questions, scale: the items after a game, and the meanings of 1 and 7.
        texts: all other texts, see `conf/questions/en.yaml`, by their dotted names below `texts`.
        interview: whether the experimenter notes what the person says about a game.
        device: name of the device.
    """

    conditions: Sequence[Condition]
    models: Models
    opponent: Player
    opponent_label: str
    protocol: Protocol
    lookahead: Lookahead
    participants: int
    seed: int
    consent: str
    questions: Mapping[str, str]
    scale: tuple[str, str]
    texts: Mapping[str, str]
    interview: bool
    device: str


class Session:
    """Runs the session of one person.

    Args:
        plan: of the study.
        participant: the person and their records.
        player: the person at the device.
        ui: for pages, questionnaires and notes.
        mark: called with the name of each event.
        on_row: called with the row of each tick, see `COLUMNS`.
        on_game: called with the number of a game before it begins, see `guidance.study.study`.

    Attributes:
        adapted: parameters of the user model, adapted to the person; None before the first game.
        order: the conditions in the person's order.
    """

    def __init__(
        self,
        plan: SessionPlan,
        participant: Participant,
        player: RealTimePlayer,
        ui: ExperimenterUI,
        mark: Callable[[str], None] = lambda event: None,
        on_row: Callable[[Mapping[str, float]], None] = lambda row: None,
        on_game: Callable[[int], None] = lambda game: None,
    ) -> None:
        self.plan, self.participant, self.player, self.ui = plan, participant, player, ui
        self.mark, self.on_row, self.on_game = mark, on_row, on_game
        player.mark = mark
        self.adapted: TensorDict | None = None
        places = counterbalanced_order(plan.participants, len(plan.conditions), plan.seed)[participant.place]
        self.order = [plan.conditions[i] for i in np.argsort(places)]

    def run(self) -> bool:
        """Run the open steps; returns whether the person takes part."""
        if not self._consented():
            return False
        text, number_of_games = self.plan.texts, len(self.order)
        if UNSCORED not in self.participant.games:
            self._practice()
            title = text["first_game.title"]
            self._announce(title, text["first_game.text"])
            unguided = next(condition for condition in self.plan.conditions if not condition.guidance.models())
            self._play(unguided, UNSCORED, 0, CALIBRATION_GAME, title)
        ticks = read_ticks(self.participant.games[UNSCORED].file, COLUMNS)
        self.adapted = self.plan.models.adapted_to([demonstration(ticks)])
        for number, condition in enumerate(self.order, 1):
            game = self.participant.games.get(condition.name)
            title = text["next_game.title"].format(number=number, games=number_of_games)
            if game is None:
                self._announce(title, text["next_game.text"])
                self._play(condition, condition.name, number, ascii_lowercase.index(condition.letter), title)
            if self.participant.games[condition.name].ratings is None:
                self._rate(condition.name, title)
        self._read(text["end.title"], text["end.text"], {"return": text["end.leave"]})
        return True

    def _consented(self) -> bool:
        text = self.plan.texts
        if self.participant.consent is None:
            keys = {"y": text["consent.agree"], "n": text["consent.decline"]}
            if self._read(text["consent.title"], self.plan.consent, keys) != "y":
                return False
            self.participant.give_consent(self.plan.consent)
            self.mark("consent")
        return True

    def _read(self, title: str, text: str, keys: Mapping[str, str]) -> str:
        return self.ui.page(Page(title, text, keys, self.plan.texts))

    def _announce(self, title: str, text: str) -> None:
        """Show what game comes next, and how long it is."""
        protocol, texts = self.plan.protocol, self.plan.texts
        least, most = protocol.rounds, protocol.rounds + protocol.extra_rounds
        rounds = f"{least}" if least == most else f"{least}–{most}"
        paragraphs = [text, texts["every_game.rounds"].format(rounds=rounds)]
        if protocol.familiarization:
            seconds = f"{protocol.familiarization:g}"
            paragraphs.insert(1, texts["every_game.familiarization"].format(seconds=seconds))
        self._read(title, "\n\n".join(paragraphs), {"return": texts["every_game.begin"]})

    def _practice(self) -> None:
        """A game without guidance that is not recorded and ends by a key."""
        text = self.plan.texts
        keys = {"return": text["practice.begin"], SKIP: text["practice.skip"]}
        if self._read(text["practice.title"], text["practice.text"], keys) == SKIP:
            return
        player, table = self.player, TableSpec()
        self.on_game(CALIBRATION_GAME)
        runner = GameRunner(
            player, self.plan.opponent, table, self._serves(CALIBRATION_GAME, RandomStream.PRACTICE_TABLE)
        )
        player.display = DisplayState(title=text["practice.running"])
        player.actions = {"return": text["practice.end"]}
        runner.new_games()
        won = lost = 0
        self.mark("practice")
        while "return" not in player.take_keys():
            tick = runner.tick()
            won, lost = won + int(tick.goals[0] > 0), lost + int(tick.goals[0] < 0)
            player.display.won, player.display.lost = won, lost
            player.display.seconds += table.tick
            if tick.goals[0]:
                runner.new_rounds(tick.goals != 0)
        player.actions = {}

    def _serves(self, game: int, stream: RandomStream = RandomStream.TABLE) -> np.ndarray:
        return spawn_rng_states(self.plan.seed, [self.participant.place], game, stream)

    def _play(self, condition: Condition, name: str, position: int, game: int, title: str) -> None:
        """Play one game by the protocol, and save it round by round."""
        plan, player, table = self.plan, self.player, TableSpec()
        adapted = self.adapted if name != UNSCORED else None
        forces, tap = tapped_guidance(condition, plan.models, adapted, plan.lookahead)
        log = TickLog(tap, table.tick, player.hand)
        facts = scene_facts(condition, self.participant.label, plan.opponent_label, adapted is not None)
        facts |= {"device": plan.device, "questions": dict(plan.questions), "scale": list(plan.scale)}
        self.on_game(game)
        with self.participant.begin_game(name, position, COLUMNS, facts) as recording:
            self.mark(f"begin {name}")
            player.display = DisplayState(title=title)

            on_tick = partial(self._watch, log, recording)
            try:
                result = play_games(
                    player, plan.opponent, forces, plan.protocol, table, self._serves(game), on_tick=on_tick
                )
            except BaseException:
                self.mark(f"interrupted {name}")
                raise
            results = result.results | result.weights | result.counts
            results |= {"rounds": result.rounds, "duration_s": result.seconds}
            numbers = {key: float(values[0]) for key, values in results.items()}
            if not condition.guidance.models():
                numbers["mean_disagreement"] = float("nan")  # without a force it is undefined (section 5.2)
            recording.finish(
                numbers, {"late_ticks": player.late_ticks, "pauses": player.pauses, "faults": player.faults}
            )
        self.mark(f"end {name}")

    def _watch(self, log: TickLog, recording: Recording, tick: GameStep, scored: bool, ended: np.ndarray) -> None:
        """Show the score, and save each round when it ends."""
        is_start = scored and not log.scored
        row = log(tick, scored, bool(ended[0]))
        self.on_row(row)
        display = self.player.display
        display.won, display.lost, display.seconds = log.won, log.lost, row["time_s"]
        text, remaining = self.plan.texts, self.plan.protocol.familiarization - row["time_s"]
        is_near = not scored and 0 < remaining < 4
        display.note = text["notes.begins"].format(seconds=ceil(remaining)) if is_near else ""
        if is_start:
            self.mark("scored")
        if row["goal"]:
            self.mark("goal" if row["goal"] > 0 else "goal against")
        if ended[0]:
            display.note = text[OUTCOMES[int(row["goal"])]]
            recording.append(log.take())

    def _rate(self, name: str, title: str) -> None:
        text, (low, high) = self.plan.texts, self.plan.scale
        items = Items(text["items.title"].format(game=title), self.plan.questions, low, high, text)
        ratings = self.ui.ask(items)
        self.participant.save_ratings(name, ratings)
        self.mark(f"rated {name}")
        if self.plan.interview:
            page = Page(text["interview.title"].format(game=title), text["interview.text"], {}, text)
            self.participant.save_ratings(name, ratings, self.ui.write_down(page))
