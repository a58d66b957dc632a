"""The servo, at 1 kHz: from the newest force request to the force that acts on the hand.

The guidance requests a force every 20 ms. In between, the force is interpolated linearly from the previous request to
the newest and passes the safety layer on its way to the device.
"""

from collections.abc import Sequence
from math import inf
from typing import TYPE_CHECKING

from guidance.haptics.devices import Device, Pair, VirtualDevice
from guidance.haptics.hand import CLOSED, HapticHand
from guidance.haptics.safety import NO_FORCE, Safety, SafetyLimits, clip_norm

if TYPE_CHECKING:  # the servo process starts without numpy
    import numpy as np

SERVO_HZ = 1000
PERIOD = 1 / SERVO_HZ
TICK = 0.02  # s between two requests of the guidance


class ServoLoop:
    """The servo's state and step, for simulated and for real time.

    Attributes:
        position, velocity, is_held: of the hand, as read in the last step.
        force: (2,) N, the force that acts on the hand.
    """

    def __init__(self, device: Device, limits: SafetyLimits) -> None:
        self.device, self.safety = device, Safety(limits)
        self.position = self.velocity = self.force = NO_FORCE
        self.is_held = False
        self.rest()

    def push(self, x: float, y: float, is_held: bool) -> None:
        """Request this force in N from now on; zero if it is not finite."""
        self._start = self._interpolate()
        self._end = clip_norm(x, y, self.safety.limits.force)
        self._age, self._is_requested = 0.0, is_held

    def rest(self) -> None:
        """Drop the force until the next push, which then ramps up as if it were the first."""
        self._start = self._end = NO_FORCE
        self._age, self._is_requested = inf, False
        self.safety.rest()
        self._relax()

    def _interpolate(self) -> Pair:
        fraction = min(self._age / TICK, 1.0)
        (from_x, from_y), (to_x, to_y) = self._start, self._end
        return from_x + (to_x - from_x) * fraction, from_y + (to_y - from_y) * fraction

    def step(self, seconds: float) -> None:
        """Read the hand and set its force; `seconds` have passed since the last step.

        The force changes by at most the slew of one period, however late the step is.
        """
        device, safety = self.device, self.safety
        self._age += seconds
        try:
            self.position, self.velocity, self.is_held = device.position, device.velocity, device.is_held
            is_held = self.is_held and self._is_requested
            self.force = safety.filter(self._interpolate(), self._age, self.position, self.velocity, is_held, PERIOD)
            if safety.fault is None:
                device.set_force(self.force)
                return
        except Exception as error:
            self._fail(error)
        self._relax()

    def _relax(self) -> None:
        self.force = NO_FORCE
        try:
            self.device.relax()
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        self.safety.fail(f"the device failed: {message_of(error)}")


class InProcessServo(HapticHand):
    """The servo of a virtual device, in steps of 1 ms by `advance`; deterministic, given the pushes and the device."""

    def __init__(self, device: VirtualDevice, limits: SafetyLimits) -> None:
        self.device, self._loop, self._is_closed = device, ServoLoop(device, limits), False

    def advance(self, milliseconds: int, state: "np.ndarray") -> None:
        if self._is_closed:
            raise ValueError(CLOSED)
        for _ in range(milliseconds):
            self._loop.step(PERIOD)
            self.device.advance(PERIOD, state)

    @property
    def position(self) -> Pair:
        """(2,) m, of the hand relative to the center; the last known one while the device fails."""
        try:
            return self.device.position
        except Exception:  # the next step reports it as a fault
            return self._loop.position

    @property
    def velocity(self) -> Pair:
        return self.device.velocity

    @property
    def is_held(self) -> bool:
        return self.device.is_held

    @property
    def force(self) -> Pair:
        return self._loop.force

    @property
    def fault(self) -> str | None:
        return CLOSED if self._is_closed else self._loop.safety.fault

    def push(self, force: Sequence[float], is_held: bool = True) -> None:
        self._loop.push(float(force[0]), float(force[1]), is_held)

    def rest(self) -> None:
        self._loop.rest()

    def release(self) -> bool:
        return not self._is_closed and self._loop.safety.release()

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed, self._loop.force = True, NO_FORCE
            self.device.close()


def message_of(error: Exception) -> str:
    """The message of an error, or its type if it has none."""
    return str(error) or type(error).__name__
