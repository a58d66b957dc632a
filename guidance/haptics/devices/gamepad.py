"""A gamepad: the hand is at the left stick, a force deflects the hand from there, and the pad rumbles in proportion."""

from contextlib import suppress
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from guidance.haptics.devices import DeviceError, Pair
from guidance.haptics.devices.pointer import MAX_SPEED, PointerHand
from guidance.simulated_users.arm import HAND_REACH

if TYPE_CHECKING:
    from pygame.joystick import JoystickType

RIGHT, DOWN = 0, 1  # axes of the left stick, by their positive direction
RUMBLE_MS = 200  # ms, after which a rumble ends by itself if the game stops; it is renewed after half of it
MIN_CHANGE = 0.05  # of the strength of the rumble


def open_gamepad(index: int = 0) -> "JoystickType":
    """Open the gamepad of this index by pygame.

    Raises:
        DeviceError: there is none; says how many there are.
    """
    import pygame

    pygame.joystick.init()
    count = pygame.joystick.get_count()
    if not 0 <= index < count:
        raise DeviceError(f"gamepad = {index} must be the index of a connected gamepad, of which there are {count}")
    return pygame.joystick.Joystick(index)


class Gamepad(PointerHand):
    """A `VirtualDevice` whose hand is at the left stick, see `PointerHand`.

    The table is drawn from the side: the stick's right is toward the opponent, its up is to the player's left. The
    stick moves in a circle and the hand's reach is a square, so the circle is stretched to the square.

    Args:
        joystick: of `open_gamepad`.
        limit: N, the force at which the pad rumbles fully.
        dead_zone: fraction of the stick's travel around its center that counts as the center.
        person, max_speed: see `PointerHand`.
    """

    def __init__(
        self,
        joystick: "JoystickType",
        limit: float,
        dead_zone: float = 0.12,
        person: np.void | None = None,
        max_speed: float = MAX_SPEED,
    ) -> None:
        super().__init__(person, max_speed)
        self._joystick, self._limit, self._dead_zone = joystick, limit, dead_zone
        self._connected, self._rumbling, self._rumbled = True, 0.0, 0.0

    @property
    def is_held(self) -> bool:
        """Whether the pad is connected."""
        return self._connected

    @property
    def position(self) -> Pair:
        if not self._connected:
            raise DeviceError("the gamepad is gone; leave, plug it in, and go on")
        return super().position

    def disconnect(self, instance_id: int) -> None:
        """Handle `pygame.JOYDEVICEREMOVED`; the stick of a removed pad reads as centered."""
        if self._connected and instance_id == self._joystick.get_instance_id():
            self._connected = False

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Simulate the passing of time; the game's state has no effect."""
        if self._connected:
            try:
                if self._joystick.get_init():
                    self._read()
                    self._rumble(seconds)
                else:
                    self._connected = False
            except RuntimeError:  # including pygame.error
                self._connected = False
        self.move(seconds)

    def close(self) -> None:
        """Stop the rumble and release the pad."""
        self.relax()
        if self._connected:
            self._connected = False
            with suppress(RuntimeError):  # pygame may have quit
                self._joystick.stop_rumble()
                self._joystick.quit()

    def _read(self) -> None:
        right, up = self._joystick.get_axis(RIGHT), -self._joystick.get_axis(DOWN)
        radius, longest = hypot(right, up), max(abs(right), abs(up))
        if radius <= self._dead_zone:
            self.point(0.0, 0.0)
            return
        scale = min((radius - self._dead_zone) / (1.0 - self._dead_zone), 1.0) * HAND_REACH
        self.point(right / longest * scale, up / longest * scale)

    def _rumble(self, seconds: float) -> None:
        strength = min(hypot(*self._force) / self._limit, 1.0)
        if strength < MIN_CHANGE:
            strength = 0.0
        self._rumbled += seconds
        changed = abs(strength - self._rumbling) >= MIN_CHANGE or (strength == 0.0) != (self._rumbling == 0.0)
        if changed or (strength > 0.0 and self._rumbled >= RUMBLE_MS / 2000):
            if strength > 0.0:
                self._joystick.rumble(strength, strength, RUMBLE_MS)
            else:
                self._joystick.stop_rumble()
            self._rumbling, self._rumbled = strength, 0.0
