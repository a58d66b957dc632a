"""Interface of a hand at a device behind the safety layer."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from guidance.haptics.devices import Hand, Pair

if TYPE_CHECKING:  # the servo process starts without numpy
    import numpy as np


CLOSED = "the servo is closed"  # a fault


class HapticHand(Hand):
    """A hand at a device behind the safety layer; see `guidance.haptics.servo` and `guidance.haptics.servo_process`."""

    @property
    @abstractmethod
    def force(self) -> Pair:
        """(2,) N, the force that acts on the hand."""

    @property
    @abstractmethod
    def fault(self) -> str | None:
        """Reason why there is no force until `release`; None without a fault."""

    @abstractmethod
    def push(self, force: Sequence[float], is_held: bool = True) -> None:
        """Request a force on the hand.

        Args:
            force: (2,) N.
            is_held: False for no force, whatever the device reports.
        """

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

    @abstractmethod
    def close(self) -> None:
        """Drop the force and release the device. A second call does nothing."""
