"""Devices that a hand holds and a force can push: all that the servo asks of one.

Of the hand: m from the center of the workspace, x toward the opponent, y to one's left, as on the table.
"""

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # the servo starts at once, without numpy
    import numpy as np

Pair = tuple[float, float]


class DeviceError(OSError):
    """A device cannot be opened, or does not do what it is told."""


class Device(Protocol):
    """A hand's place, and a force on it. Whatever goes wrong in it is an exception."""

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center."""

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's."""

    @property
    def held(self) -> bool:
        """The dead man's switch: whether the hand is at the device."""

    def set_force(self, force: Pair) -> None:
        """Have this force (2,) in N act on the hand until another is set."""

    def relax(self) -> None:
        """Have no force act at all, nor any that the device adds by itself; until `set_force`."""

    def close(self) -> None:
        """No force, and let go of the device. Closing twice is closing once."""


class VirtualDevice(Device, Protocol):
    """A device for which time passes only when it is told so."""

    def advance(self, seconds: float, state: "np.ndarray") -> None:
        """Let time pass.

        Args:
            seconds: s, whole servo steps of 1 ms.
            state: (12,) float64, the game as the person sees it, see `tables.observe`.
        """
