"""The left seat in real time: a person with a hand at a device, and a screen before them.

`RealTimePlayer` is what a game asks of its participants, for one person; a game does not know whether people are computed or sit
there. A tick begins with a look at the table and at the hand, the force is on its way some milliseconds later, and is
held until the next tick is due; in between the screen is drawn.
"""

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import inf
from typing import Protocol

import numpy as np

from guidance.forces.conditions import Prediction
from guidance.haptics.clock import Clock
from guidance.haptics.devices import Pair
from guidance.simulated_users import SimulatedUsers
from guidance.simulated_users.arm import HAND_REACH

SERVO_STEP = 0.001  # s: what a virtual device's time is counted in
PATIENCE = 0.05  # s that a picture waits at most
NO_FORCE = (0.0, 0.0)


class Quit(BaseException):
    """The person wants to go. As KeyboardInterrupt, nothing takes it for an error, wherever it comes."""


@contextmanager
def leaving_when_told() -> Iterator[None]:
    """In this block, SIGTERM and SIGINT are the person's wish to go: the game is saved, and the device let go of."""

    def leave(signum: int, frame: object) -> None:
        raise Quit

    before = {number: signal.signal(number, leave) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class HapticHand(Protocol):
    """A hand at a device, behind the safety layer; see `guidance.haptics.servo`."""

    @property
    def position(self) -> Pair: ...  # (2,) m from the center of the workspace

    @property
    def force(self) -> Pair: ...  # (2,) N, what it feels

    @property
    def held(self) -> bool: ...  # whether it is at the device

    @property
    def fault(self) -> str | None: ...  # why it feels nothing any more, until `release`

    def push(self, force: Pair, held: bool = True) -> None: ...

    def advance(self, milliseconds: int, state: np.ndarray) -> None: ...

    def rest(self) -> None: ...

    def release(self) -> bool: ...

    def close(self) -> None: ...


@dataclass
class DisplayState:
    """What there is to show of a game.

    Attributes:
        state, last: (12,) the table as seen from the left seat, now and a tick ago; None before a game.
        share: of a tick, that has passed since `state`.
        hand: (2,) where the hand is, over its reach.
        force: (2,) N, what it feels.
        optimal, predicted: what the models say, (1, 2) each, if it may be shown.
        weights: the weights that went into the force, by what they are called.
        won, lost, seconds: how it stands.
        title, note: what is going on; `note` for a while only.
    """

    state: np.ndarray | None = None
    last: np.ndarray | None = None
    share: float = 0.0
    hand: np.ndarray = field(default_factory=lambda: np.zeros(2))
    force: np.ndarray = field(default_factory=lambda: np.zeros(2))
    optimal: Prediction | None = None
    predicted: Prediction | None = None
    weights: dict[str, float] = field(default_factory=dict)
    won: int = 0
    lost: int = 0
    seconds: float = 0.0
    title: str = ""
    note: str = ""


class Screen(Protocol):
    """What the person looks at, and whose keys they press.

    Attributes:
        next_frame: when the next picture is due, s of the clock.
        cost: s that a picture takes.
        attentive: whether it is the person's, who has not turned to something else.
    """

    next_frame: float
    cost: float

    @property
    def attentive(self) -> bool: ...

    def poll(self) -> None:
        """Take note of where the pointer is and of what was pressed."""
        ...

    def frame(self, moment: DisplayState) -> list[str]:
        """Show a moment; returns the keys pressed since the last one.

        Raises:
            Leave: the person wants to go.
        """
        ...


class NullDisplay:
    """No screen."""

    next_frame, cost, attentive = inf, 0.0, True

    def poll(self) -> None:
        pass

    def frame(self, moment: DisplayState) -> list[str]:
        return []


class RealTimePlayer:
    """One person, as `guidance.study.games.Participants` has them.

    Args:
        tick_seconds: of the game.
        breath: s of rest between rounds.
        person: who sits there, if it is a simulated person.

    Attributes:
        moment: what the screen shows; the game's owner writes scores, titles and targets into it.
        mark: is told when the game is paused and goes on, and of faults.
        keys: pressed, and not taken yet.
        latencies: s from the look at table and hand to the force, of every tick.
        late, pauses, faults: in this game: ticks that began more than a tick too late, which nothing makes up for;
            pauses, but for the breaths; and what the faults were.
    """

    def __init__(
        self,
        hand: HapticHand,
        screen: Screen,
        clock: Clock,
        tick_seconds: float,
        breath: float = 1.0,
        person: SimulatedUsers | None = None,
    ) -> None:
        self.hand, self.screen, self.clock, self.person = hand, screen, clock, person
        self.tick_seconds, self.breath = tick_seconds, breath
        self._steps = round(tick_seconds / SERVO_STEP)
        self.mark: Callable[[str], None] = lambda what: None
        self.moment, self.keys, self.latencies = DisplayState(), [], []
        self.late, self.pauses, self.faults = 0, 0, []
        self._due = self._looked = clock.now()
        self._first, self._nothing = True, np.zeros(12)

    @property
    def action(self) -> np.ndarray:
        """(1, 2) where the hand is, over its reach."""
        return np.clip(np.array(self.hand.position) / HAND_REACH, -1.0, 1.0)[None]

    def new_game(self, which: np.ndarray) -> None:
        """Begin a game, after a breath; its forces start softly, whatever was before."""
        self.late, self.pauses, self.faults = 0, 0, []
        self.moment.state = self.moment.last = None
        self.hand.rest()
        self._breathe(grip=False)
        if self.person is not None:
            self.person.new_game(which)

    def new_round(self, which: np.ndarray) -> None:
        """Begin a round where `which` (1,) says so, after a breath."""
        if which[0]:
            self._breathe(grip=True)
            if self.person is not None:
                self.person.new_round(which)

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Let the hand feel `force` (1, 2) N until the next tick is due; returns the action (1, 2) then.

        Raises:
            Leave: the person wants to go.
        """
        hand, clock, moment, screen = self.hand, self.clock, self.moment, self.screen
        hand.push((float(force[0, 0]), float(force[0, 1])), screen.attentive)
        self.latencies.append(clock.now() - self._looked)
        moment.last = state[0].copy() if self._first else moment.state
        moment.state, self._first, done, left = state[0].copy(), False, 0, None
        begun, self._due = self._due, self._due + self.tick_seconds
        while (now := clock.now()) < self._due:
            passed = min(int((now - begun) / SERVO_STEP), self._steps)
            hand.advance(passed - done, state[0])
            done = max(passed, done)
            # a picture must not make a tick late; but where none would ever fit, seeing something comes first
            fits = self._due - now > screen.cost or now - screen.next_frame > PATIENCE
            if now >= screen.next_frame and fits:
                moment.share = (now - begun) / self.tick_seconds
                if self._picture() or not screen.attentive:
                    left = self.action
                    self.pause()
                    begun = self._due - self.tick_seconds
            else:
                later = screen.next_frame if screen.next_frame > now else self._due
                clock.wait(min(later, self._due) - now)
        screen.poll()
        hand.advance(self._steps - done, state[0])
        if hand.fault is not None:  # a game about a force does not go on without it
            left = self.action if left is None else left
            self.pause()
        if clock.now() - self._due > self.tick_seconds:
            self.late, self._due = self.late + 1, clock.now()
        self._looked = clock.now()
        return self.action if left is None else left  # what the hand does in a pause is no action

    def pause(self) -> None:
        """Rest without a force until the person presses space; after a fault, only once it is released.

        Raises:
            Leave: the person wants to go.
            RuntimeError: a fault, and no screen to say so.
        """
        self.pauses += 1
        self.mark("pause")
        self._rest(inf, "paused: space to go on", grip=False)
        self.mark("go on")

    def _breathe(self, grip: bool) -> None:
        """Rest between rounds or games; space makes a pause of it."""
        if self.breath > 0 and self._rest(self.breath, self.moment.note, grip):
            self.pause()
        self._first = True

    def _rest(self, seconds: float, note: str, grip: bool) -> bool:
        """Let time stand still for so long; whether it was ended by space.

        Args:
            grip: the hand stays at the device, and the next force need not start softly.
        """
        clock, screen, hand, begun, done = self.clock, self.screen, self.hand, self.clock.now(), 0
        self.moment.note, note, spaced = note, self.moment.note, False
        while (now := clock.now()) < begun + seconds or hand.fault is not None:
            if screen.next_frame == inf and hand.fault is not None:
                raise RuntimeError(f"no force: {hand.fault}")
            hand.push(NO_FORCE, grip and screen.attentive)
            if self.person is None:  # for whom time stands still
                passed = int((now - begun) / SERVO_STEP)
                hand.advance(passed - done, self._nothing)
                done = passed
            if now >= screen.next_frame and self._picture() and screen.attentive and hand.fault is None:
                spaced = True
                break
            until = begun + seconds if begun + seconds > now else inf
            clock.wait(min(screen.next_frame, until, now + self.tick_seconds) - now)
        self.moment.note = note
        self._due = self._looked = clock.now()
        return spaced

    def _picture(self) -> bool:
        """Show the moment; True if the person wants to pause, or to go on."""
        moment, fault = self.moment, self.hand.fault
        moment.hand, moment.force = self.action[0], np.array(self.hand.force)
        if fault and (not self.faults or self.faults[-1] != fault):
            self.faults.append(fault)
            self.mark(f"fault: {fault}")
        said = moment.note
        if fault:
            moment.note = f"no force: {fault}; r, then space"
        elif not self.hand.held and not moment.note:
            moment.note = "take hold of the device"
        pressed = self.screen.frame(moment)
        moment.note = said
        if fault and "r" in pressed:
            self.hand.release()
        self.keys += [key for key in pressed if key != "space"]
        return "space" in pressed

    def taken(self) -> Iterable[str]:
        """The keys that were pressed, each once."""
        keys, self.keys = self.keys, []
        return keys
