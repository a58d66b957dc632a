"""A gamepad: the left stick points the hand, the force deflects it from there, and the pad rumbles as strongly."""

from contextlib import suppress
from math import hypot
from typing import Protocol

import numpy as np

from guidance.haptics.devices import DeviceError, Pair
from guidance.haptics.devices.pointed import FASTEST, PointedHand
from guidance.simulated_users.arm import HAND_REACH

RIGHT, DOWN = 0, 1  # the left stick's axes, positive that way
RUMBLE_MS = 200  # a rumble ends by itself, should the game stop; it is renewed at half of that
NOTABLE = 0.05  # change of strength


class Joystick(Protocol):
    """What is asked of a `pygame.joystick.Joystick`."""

    def get_init(self) -> bool: ...

    def get_instance_id(self) -> int: ...

    def get_axis(self, axis: int) -> float: ...

    def rumble(self, low: float, high: float, milliseconds: int) -> bool: ...

    def stop_rumble(self) -> None: ...

    def quit(self) -> None: ...


def open_gamepad(index: int = 0) -> Joystick:
    """The gamepad of this index, by pygame.

    Raises:
        DeviceError: there is none; says how many there are.
    """
    import pygame

    pygame.joystick.init()
    count = pygame.joystick.get_count()
    if not 0 <= index < count:
        raise DeviceError(f"gamepad = {index} must be the index of a connected gamepad, of which there are {count}")
    return pygame.joystick.Joystick(index)


class Gamepad(PointedHand):
    """A `VirtualDevice` whose hand is where the left stick points, see `PointedHand`.

    The table is seen from the side, as it is drawn: the stick to the right points at the opponent, up to one's left.
    A stick goes round in a circle and the hand's reach is a square, so the circle is stretched to the square.

    Args:
        joystick: as `open_gamepad` gives it.
        limit: N, a force as strong makes the pad rumble fully.
        dead_zone: share of the stick's way around its middle that counts as the middle.
        person, fastest: see `PointedHand`.

    Raises:
        ValueError: a number is out of range.
    """

    def __init__(
        self,
        joystick: Joystick,
        limit: float,
        dead_zone: float = 0.12,
        person: np.void | None = None,
        fastest: float = FASTEST,
    ) -> None:
        super().__init__(person, fastest)
        if not limit > 0:
            raise ValueError(f"limit = {limit} must be a number above 0, in N")
        if not 0 <= dead_zone < 1:
            raise ValueError(f"dead_zone = {dead_zone} must be a number of at least 0 and below 1")
        self._joystick, self._limit, self._dead_zone = joystick, limit, dead_zone
        self._connected, self._rumbling, self._rumbled = True, 0.0, 0.0

    @property
    def held(self) -> bool:
        """Whether the pad is connected."""
        return self._connected

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center.

        Raises:
            DeviceError: the pad is gone.
        """
        if not self._connected:
            raise DeviceError("the gamepad is gone; leave, plug it in, and go on")
        return super().position

    def unplugged(self, instance_id: int) -> None:
        """Be told that this pad is gone (`pygame.JOYDEVICEREMOVED`): a stick that is gone reads as one let go."""
        if self._connected and instance_id == self._joystick.get_instance_id():
            self._connected = False

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Let time pass; the game does not matter to it."""
        if self._connected:
            try:
                if self._joystick.get_init():
                    self._read()
                    self._rumble(seconds)
                else:
                    self._connected = False
            except RuntimeError:  # pygame.error is one
                self._connected = False
        self.move(seconds)

    def close(self) -> None:
        """Stop the rumble and let go of the pad."""
        self.relax()
        if self._connected:
            self._connected = False
            with suppress(RuntimeError):  # pygame may be over
                self._joystick.stop_rumble()
                self._joystick.quit()

    def _read(self) -> None:
        right, up = self._joystick.get_axis(RIGHT), -self._joystick.get_axis(DOWN)
        away, longer = hypot(right, up), max(abs(right), abs(up))
        if away <= self._dead_zone:
            self.point(0.0, 0.0)
            return
        share = min((away - self._dead_zone) / (1.0 - self._dead_zone), 1.0) * HAND_REACH
        self.point(right / longer * share, up / longer * share)

    def _rumble(self, seconds: float) -> None:
        strength = min(hypot(*self._force) / self._limit, 1.0)
        if strength < NOTABLE:
            strength = 0.0
        self._rumbled += seconds
        changed = abs(strength - self._rumbling) >= NOTABLE or (strength == 0.0) != (self._rumbling == 0.0)
        if changed or (strength > 0.0 and self._rumbled >= RUMBLE_MS / 2000):
            if strength > 0.0:
                self._joystick.rumble(strength, strength, RUMBLE_MS)
            else:
                self._joystick.stop_rumble()
            self._rumbling, self._rumbled = strength, 0.0
