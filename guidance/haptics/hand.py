"""Interface of a hand at a device behind the safety layer, and what its two implementations share."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from guidance.haptics.devices import Hand, Pair

if TYPE_CHECKING:  # the servo process starts without numpy
    import numpy as np


class HapticHand(Hand):
    """A hand at a device behind the safety layer; see `guidance.haptics.servo` and `guidance.haptics.servo_process`."""

    def __init__(self) -> None:
        self._is_closed = False

    @property
    @abstractmethod
    def force(self) -> Pair:
        """(2,) N, the force that acts on the hand."""

    @property
    def fault(self) -> str | None:
        """Reason why there is no force until `release`; None without a fault."""
        return "the servo is closed" if self._is_closed else self._fault()

    def push(self, force: Sequence[float], is_held: bool = True) -> None:
        """Request a force on the hand.

        Args:
            force: (2,) N.
            is_held: False for no force, whatever the device reports.
        """
        self._push(float(force[0]), float(force[1]), bool(is_held))

    @abstractmethod
    def advance(self, milliseconds: int, state: "np.ndarray") -> None:
        """Let time pass for a virtual device; does nothing for a real one.

        Args:
            milliseconds: number of servo steps.
            state: (12,) the game as the person observes it.
        """

    @abstractmethod
    def rest(self) -> None:
        """Warm restart: drop the force until the next push, which then ramps up as after opening. A fault remains."""

    @abstractmethod
    def release(self) -> bool:
        """End a fault if its cause is gone; returns whether there is no fault now."""

    def close(self) -> None:
        """Drop the force and release the device. A second call does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._close()

    @abstractmethod
    def _push(self, x: float, y: float, is_held: bool) -> None: ...

    @abstractmethod
    def _fault(self) -> str | None: ...

    @abstractmethod
    def _close(self) -> None: ...
