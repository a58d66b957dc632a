"""The time that a game with a person keeps to."""

import time
from math import inf, nextafter
from typing import Protocol


class Clock(Protocol):
    """Seconds since some moment, and waiting."""

    def now(self) -> float: ...

    def wait(self, seconds: float) -> None: ...


class WallClock:
    """Time as it passes."""

    def now(self) -> float:
        return time.perf_counter()

    def wait(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class SimulatedClock:
    """Time that passes only by waiting, and at once: for participants who are computed."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def wait(self, seconds: float) -> None:
        if seconds > 0:  # the rest of a wait may be less than a rounding: some time passes all the same
            self._now = max(self._now + seconds, nextafter(self._now, inf))
