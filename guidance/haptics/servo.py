"""The servo of a virtual device, in this process and in the device's own time."""

from typing import TYPE_CHECKING

from guidance.haptics.devices import Pair, VirtualDevice
from guidance.haptics.hand import HapticHand
from guidance.haptics.safety import NO_FORCE, SafetyLimits
from guidance.haptics.servo_loop import PERIOD, ServoLoop

if TYPE_CHECKING:
    import numpy as np


class InProcessServo(HapticHand):
    """Runs the servo in steps of 1 ms by `advance`; deterministic, given the pushes and the device."""

    def __init__(self, device: VirtualDevice, limits: SafetyLimits) -> None:
        super().__init__()
        self.device, self._loop = device, ServoLoop(device, limits)

    def advance(self, milliseconds: int, state: "np.ndarray") -> None:
        if self._is_closed:
            raise ValueError("the servo is closed")
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

    def rest(self) -> None:
        self._loop.rest()

    def release(self) -> bool:
        return not self._is_closed and self._loop.safety.release()

    def _push(self, x: float, y: float, is_held: bool) -> None:
        self._loop.push(x, y, is_held)

    def _fault(self) -> str | None:
        return self._loop.safety.fault

    def _close(self) -> None:
        self._loop.force = NO_FORCE
        self.device.close()
