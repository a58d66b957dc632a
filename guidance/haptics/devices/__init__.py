"""Interface of haptic devices, as the servo uses it.

Positions are in m from the center of the workspace: x toward the opponent, y to the player's left, as on the table.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # the servo process starts without numpy
    import numpy as np

Pair = tuple[float, float]


class DeviceError(OSError):
    """A device cannot be opened, or fails."""


class Hand(Protocol):
    """A hand at a device."""

    @property
    @abstractmethod
    def position(self) -> Pair:
        """(2,) m, of the hand relative to the center."""

    @property
    @abstractmethod
    def velocity(self) -> Pair:
        """(2,) m/s, of the hand."""

    @property
    @abstractmethod
    def is_held(self) -> bool:
        """Dead man's switch: whether the hand is at the device."""


class Device(Hand, Protocol):
    """The position of a hand, and a force on it. Every failure is an exception."""

    def set_force(self, force: Pair) -> None:
        """Apply this force, (2,) N, to the hand until another is set."""

    def relax(self) -> None:
        """Apply no force at all, not even one that the device adds by itself, until `set_force`."""

    def close(self) -> None:
        """Drop the force and release the device. A second call does nothing."""


class VirtualDevice(Device, Protocol):
    """A device whose time passes only by `advance`."""

    def advance(self, seconds: float, state: "np.ndarray") -> None:
        """Simulate the passing of time.

        Args:
            seconds: s, a multiple of the servo step of 1 ms.
            state: (12,) float64, the game as the person observes it.
        """
