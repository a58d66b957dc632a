"""Haptic devices by Force Dimension, such as the Omega.7 (12 N, reach of 0.075 m per axis), through the maker's SDK.

The SDK's frame, for a person in front of the device: x toward the person, y to the right, z up (its examples look at
it from +x, z up). The game's frame: x toward the opponent, y to the left. Hence x and y change sign. The game is flat,
so a spring and a damper hold z at the plane.

The device adds the force of the plane itself; it does not pass the safety layer, which has two axes. It has a clip of
its own, ramps up and down with the grip, and is zero when the device is relaxed; the total force is clipped as well.
"""

import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from io import StringIO
from math import hypot, isfinite
from types import ModuleType

from airhockey_marl.experiment.validation import check_numbers
from guidance.haptics.devices import DeviceError, Pair

VELOCITY_MS = 10  # ms, window of the SDK's velocity estimate, whose delay is half of it
GRIP_STEPS, RELEASE_STEPS = 500, 20  # calls of `set_force` over which the force of the plane ramps up and down
WATCHDOG_UNITS, WATCHDOG_UNIT = 200, 125e-6  # the firmware drops a force after 25 ms
WARM_UP = 0.5  # s, for the first velocity
TIMEOUT = 7  # of dhdErrorGetLast: too few positions in the velocity window


def load_sdk() -> ModuleType:
    """Import the SDK's binding, `forcedimension_core.dhd`.

    Raises:
        DeviceError: the binding or the SDK is not installed; names what to install.
    """
    try:
        with redirect_stderr(StringIO()):  # the binding prints what its error says
            from forcedimension_core import dhd
    except ModuleNotFoundError as error:
        remedy = "pip install 'airhockey-haptics[forcedimension]'"
        if sys.version_info >= (3, 13):
            remedy = "it has no release for this Python, take Python 3.11 or 3.12"
        raise DeviceError(f"{error.name} is missing: {remedy}") from error
    except ImportError as error:
        raise DeviceError(
            "the Force Dimension SDK (libdrd) of version 3.16 or later is missing: install it from forcedimension.com "
            f"and set the environment variable FDSDK to its folder ({error})"
        ) from error
    return dhd


class ForceDimension:
    """A `Device` whose hand moves in a plane.

    The dead man's switch is button 0; on a device with a gripper, such as the Omega.7, it is the closed gripper. A
    device with neither is never held.

    Args:
        index: of the device among the connected ones; None for the first available one.
        center: (3,) m in the SDK's frame, center of the game and of its plane.
        plane_stiffness: N/m, of the spring that holds the plane.
        plane_damping: N s/m, of its damper. Both must suit the device at 1 kHz: if they are too high, it hums.
        plane_force: N, clip of the force of spring and damper.
        max_force: N, clip of the norm of the total force, which the SDK enforces as well.

    Attributes:
        name: of the device, as the SDK reports it.
        watchdog: whether the firmware drops the force if the program hangs, which not every device can.

    Raises:
        ValueError: a number is out of range.
        DeviceError: the binding, the SDK or the device is missing, or the device fails.
    """

    def __init__(
        self,
        index: int | None = None,
        center: tuple[float, float, float] = (0.0, 0.0, 0.0),
        plane_stiffness: float = 600.0,
        plane_damping: float = 3.0,
        plane_force: float = 4.0,
        max_force: float = 6.0,
    ) -> None:
        check_numbers(0.0, plane_stiffness=plane_stiffness, plane_damping=plane_damping, plane_force=plane_force)
        check_numbers(above=0.0, max_force=max_force)
        if len(center) != 3 or not all(map(isfinite, center)):
            raise ValueError(f"center = {center} must be three numbers, in m")
        self._center = tuple(map(float, center))
        self._stiffness, self._damping = plane_stiffness, plane_damping
        self._plane_force, self._max_force = plane_force, max_force
        self._position, self._velocity = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._difference_velocity, self._position_time = [0.0, 0.0, 0.0], 0.0
        self._grip, self._is_held = 0.0, False
        self._dhd = load_sdk()
        self._id = self._dhd.open() if index is None else self._dhd.openID(index)
        if self._id < 0:
            raise DeviceError(
                f"no Force Dimension device could be opened ({self._dhd.errorGetLastStr()}): it must be connected, "
                "powered, calibrated and not in use, and you must have permission to use it"
            )
        self._open = True
        try:
            self._prepare()
        except BaseException:
            with suppress(DeviceError):
                self.close()
            raise

    def _prepare(self) -> None:
        dhd = self._dhd
        self.name = dhd.getSystemName(self._id) or "a device without a name"
        self._do(dhd.setGravityCompensation, True)
        self._do(dhd.configLinearVelocity, VELOCITY_MS)
        self._do(dhd.setMaxForce, self._max_force)
        if dhd.hasGripper(self._id):
            self._do(dhd.emulateButton, True)
        self._do(dhd.setForce, (0.0, 0.0, 0.0))
        self._do(dhd.enableForce, True)
        ends = time.perf_counter() + WARM_UP
        self._do(dhd.getPosition, self._position)
        while dhd.getLinearVelocity(self._velocity, self._id) < 0:
            if time.perf_counter() > ends:
                raise DeviceError(f"getLinearVelocity failed: {dhd.errorGetLastStr()}")
            time.sleep(0.001)
            self._do(dhd.getPosition, self._position)
        self._position_time = self._force_time = time.perf_counter()
        self.watchdog = self._set_watchdog()
        self._do(dhd.setForce, (0.0, 0.0, 0.0))

    def _set_watchdog(self) -> bool:
        expert = self._dhd.expert
        if expert.enableExpertMode() < 0:
            return False
        able = expert.setWatchdog(WATCHDOG_UNITS, self._id) >= 0
        expert.disableExpertMode()
        return able

    def _do(self, function: Callable[..., int], *arguments: object) -> None:
        """Call the SDK; results above 0 (time guard, saturated motor) are no errors."""
        if function(*arguments, self._id) < 0:
            raise DeviceError(f"{function.__name__} failed: {self._dhd.errorGetLastStr()}")

    @property
    def position(self) -> Pair:
        last, last_time = tuple(self._position), self._position_time
        self._do(self._dhd.getPosition, self._position)
        self._position_time = time.perf_counter()
        passed = max(self._position_time - last_time, 1e-6)
        self._difference_velocity = [(now - then) / passed for now, then in zip(self._position, last, strict=True)]
        return self._center[0] - self._position[0], self._center[1] - self._position[1]

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, of the hand when its position was last read."""
        dhd = self._dhd
        if dhd.getLinearVelocity(self._velocity, self._id) < 0:
            # after a pause longer than its window, the SDK has too few positions: use the last two
            if dhd.errorGetLast() != TIMEOUT:
                raise DeviceError(f"getLinearVelocity failed: {dhd.errorGetLastStr()}")
            self._velocity[:] = self._difference_velocity
        return -self._velocity[0], -self._velocity[1]

    @property
    def is_held(self) -> bool:
        """Whether the button is pressed or the gripper closed; False if there is neither."""
        self._is_held = self._dhd.getButton(0, self._id) == 1
        return self._is_held

    def set_force(self, force: Pair) -> None:
        """Apply this force, (2,) N, and that of the plane until another is set.

        Raises:
            DeviceError: it cannot be set, or the firmware has dropped the last force because it was too long ago.
        """
        if self.watchdog and time.perf_counter() - self._force_time > WATCHDOG_UNITS * WATCHDOG_UNIT:
            pause = time.perf_counter() - self._force_time
            raise DeviceError(f"no force was set for {1000 * pause:.0f} ms, so the device's watchdog has dropped it")
        self._grip += 1 / GRIP_STEPS if self._is_held else -1 / RELEASE_STEPS
        self._grip = min(max(self._grip, 0.0), 1.0)
        up = self._stiffness * (self._center[2] - self._position[2]) - self._damping * self._velocity[2]
        x, y, z = -force[0], -force[1], self._grip * min(max(up, -self._plane_force), self._plane_force)
        norm = hypot(x, y, z)
        if not isfinite(norm):
            raise DeviceError(f"force = {force} N with {z} N to the plane must be finite")
        scale = self._max_force / norm if norm > self._max_force else 1.0
        self._do(self._dhd.setForce, (scale * x, scale * y, scale * z))
        self._force_time = time.perf_counter()

    def relax(self) -> None:
        """Apply no force at all, not even that of the plane, and re-enable forces that the watchdog has dropped."""
        self._grip = 0.0
        self._do(self._dhd.setForce, (0.0, 0.0, 0.0))
        if self.watchdog and time.perf_counter() - self._force_time > WATCHDOG_UNITS * WATCHDOG_UNIT:
            self._do(self._dhd.enableForce, True)
        self._force_time = time.perf_counter()

    def close(self) -> None:
        """Drop the force, brake and release the device; each step runs even if the one before fails."""
        if not self._open:
            return
        self._open, dhd, failed = False, self._dhd, []
        for function, arguments in ((dhd.setForce, [(0.0, 0.0, 0.0)]), (dhd.stop, []), (dhd.close, [])):
            try:
                self._do(function, *arguments)
            except DeviceError as error:
                failed.append(str(error))
            except Exception as error:
                failed.append(f"{function.__name__} failed: {error}")
        if failed:
            raise DeviceError("; ".join(failed))
