"""Clocks of a game with a person: real and simulated time."""

import time
from math import inf, nextafter
from typing import Protocol


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
