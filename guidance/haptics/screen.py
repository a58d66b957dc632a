"""The screen before a person and the clock of the game: what is shown, keys, quitting, real and simulated time."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import inf, nextafter
from typing import Protocol

import numpy as np

from guidance.forces.conditions import Prediction


class Quit(BaseException):
    """The person quits. Like KeyboardInterrupt not an `Exception`, so no handler of errors catches it."""


@contextmanager
def quit_on_signals() -> Iterator[None]:
    """Raise `Quit` at the first SIGTERM, SIGINT or SIGHUP within the block: games are saved, the device is released.

    Further ones are ignored until the block has ended, so that they do not interrupt that.
    """

    def handle(signum: int, frame: object) -> None:
        for number in previous:
            signal.signal(number, signal.SIG_IGN)
        raise Quit

    names = [name for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)]  # Windows has no SIGHUP
    previous = {number: signal.getsignal(number) for number in (getattr(signal, name) for name in names)}
    try:
        for number in previous:
            signal.signal(number, handle)
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@dataclass
class DisplayState:
    """What a screen shows of a game.

    Attributes:
        state, previous_state: (12,) the game as the left player observes it, now and one tick ago; None before a game.
        tick_fraction: fraction of a tick that has passed since `state`.
        hand: (2,) position of the hand over its reach.
        force: (2,) N, the force that acts on the hand.
        optimal, predicted: outputs of the two models, (1, 2) each, if they may be shown.
        weights: label -> weight of the force.
        won, lost, seconds: score and time.
        title, note: texts; the note is shown for a while.
        next_action: what a pressed key will do once a pause is over.
    """

    state: np.ndarray | None = None
    previous_state: np.ndarray | None = None
    tick_fraction: float = 0.0
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
    next_action: str = ""


class Screen(Protocol):
    """A screen and its keyboard.

    Attributes:
        next_frame: s of the clock, when the next frame is due.
        frame_cost: s, typical duration of drawing a frame.
        has_focus: whether the person is at the game, and not at another window or at the help.
    """

    next_frame: float
    frame_cost: float

    @property
    def has_focus(self) -> bool: ...

    def poll(self) -> None:
        """Process the position of the pointer and the pressed keys."""
        ...

    def frame(self, display: DisplayState) -> list[str]:
        """Draw a frame; returns the keys pressed since the last one.

        Raises:
            Quit: the person quits.
        """
        ...


class NullDisplay:
    """A `Screen` that shows nothing."""

    next_frame, frame_cost, has_focus = inf, 0.0, True

    def poll(self) -> None:
        pass

    def frame(self, display: DisplayState) -> list[str]:
        return []


class Clock(Protocol):
    """Time in seconds from an arbitrary origin, and waiting."""

    def now(self) -> float: ...

    def wait(self, seconds: float) -> None: ...


class WallClock:
    """Real time."""

    def now(self) -> float:
        return time.perf_counter()

    def wait(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class SimulatedClock:
    """Time that passes only by waiting, which returns at once: for simulated participants and tests."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def wait(self, seconds: float) -> None:
        if seconds > 0:  # advances even if `seconds` is less than the resolution of the time
            self._now = max(self._now + seconds, nextafter(self._now, inf))
