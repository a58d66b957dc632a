"""Force Dimension's haptic devices, such as the Omega.7 (12 N, 0.075 m to every side), by the maker's own SDK.

The SDK's frame, for someone who sits before the device: x toward oneself, y to one's right, z up (its examples look at
it from +x, z up). The game's: x toward the opponent, y to one's left. So x and y change their signs, and z is held at
its plane by a spring and a damper, because the game is flat.

The plane's spring is the device's own: it does not pass the safety layer, which knows two axes. It has a clip of its
own, rises and falls softly with the grip, is gone when the device is relaxed, and the whole force has a clip as well.
"""

import time
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from io import StringIO
from math import hypot, isfinite
from types import ModuleType

from guidance.haptics.devices import DeviceError, Pair

VELOCITY_MS = 10  # the window in which the SDK estimates the velocity; its delay is half of it
GRIP_STEPS, LET_GO_STEPS = 500, 20  # calls of `set_force` in which the plane's spring rises and falls
WATCHDOG_UNITS, WATCHDOG_UNIT = 200, 125e-6  # the firmware drops the force after 25 ms without another one
WARM_UP = 0.5  # s, for the first velocity
TIMEOUT = 7  # dhdErrorGetLast: too few positions in the window of the velocity


def load_sdk() -> ModuleType:
    """The SDK's binding, `forcedimension_core.dhd`.

    Raises:
        DeviceError: the binding or the SDK is not installed; says what to install.
    """
    try:
        with redirect_stderr(StringIO()):  # the error says it all
            from forcedimension_core import dhd
    except ModuleNotFoundError as error:
        raise DeviceError(f"{error.name} is missing: pip install forcedimension-core==1.0.0") from error
    except ImportError as error:
        raise DeviceError(
            "the Force Dimension SDK (libdrd) of version 3.16 or later is missing: install it from forcedimension.com "
            f"and set the environment variable FDSDK to its folder ({error})"
        ) from error
    return dhd


class ForceDimension:
    """A `Device` at which a hand moves in a plane.

    The dead man's switch is button 0; on a device with a gripper, such as the Omega.7, that is the closed gripper. A
    device that has neither counts as never held.

    Args:
        index: of the device among those connected; None for the first that is free.
        center: (3,) m in the SDK's frame, where the game's center and plane are.
        plane_stiffness: N/m, of the spring that holds the plane.
        plane_damping: N s/m, of its damper. Both must suit the device and 1 kHz: too much, and it hums.
        plane_force: N, the clip of both together.
        most: N, the clip of the norm of the whole force; the SDK is told it as well.

    Attributes:
        name: what the SDK calls the device.
        watchdog: the firmware drops the force if the program hangs; not every device can.

    Raises:
        ValueError: a number is out of range.
        DeviceError: the binding, the SDK or the device is missing, or it refuses.
    """

    def __init__(
        self,
        index: int | None = None,
        center: tuple[float, float, float] = (0.0, 0.0, 0.0),
        plane_stiffness: float = 600.0,
        plane_damping: float = 3.0,
        plane_force: float = 4.0,
        most: float = 6.0,
    ) -> None:
        for name, value in (
            ("plane_stiffness", plane_stiffness),
            ("plane_damping", plane_damping),
            ("plane_force", plane_force),
            ("most", most),
        ):
            if not (isfinite(value) and value >= 0) or (name == "most" and value == 0):
                raise ValueError(f"{name} = {value} must be a number {'above' if name == 'most' else 'of at least'} 0")
        if len(center) != 3 or not all(map(isfinite, center)):
            raise ValueError(f"center = {center} must be three numbers, in m")
        self._center = tuple(map(float, center))
        self._stiffness, self._damping, self._plane_force, self._most = (
            plane_stiffness,
            plane_damping,
            plane_force,
            most,
        )
        self._at, self._moving = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._came, self._at_time, self._grip, self._held = [0.0, 0.0, 0.0], 0.0, 0.0, False
        self._dhd = load_sdk()
        self._id = self._dhd.open() if index is None else self._dhd.openID(index)
        if self._id < 0:
            raise DeviceError(
                f"no Force Dimension device could be opened ({self._dhd.errorGetLastStr()}): it must be connected, "
                "powered, calibrated and in nobody else's use, and you must be allowed to use it"
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
        self._do(dhd.setMaxForce, self._most)
        if dhd.hasGripper(self._id):
            self._do(dhd.emulateButton, True)
        self._do(dhd.setForce, (0.0, 0.0, 0.0))
        self._do(dhd.enableForce, True)
        ends = time.perf_counter() + WARM_UP
        self._do(dhd.getPosition, self._at)
        while dhd.getLinearVelocity(self._moving, self._id) < 0:
            if time.perf_counter() > ends:
                raise DeviceError(f"getLinearVelocity failed: {dhd.errorGetLastStr()}")
            time.sleep(0.001)
            self._do(dhd.getPosition, self._at)
        self._at_time = self._forced = time.perf_counter()
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
        """Call the SDK; what it returns above 0 (the time guard, a saturated motor) is no error."""
        if function(*arguments, self._id) < 0:
            raise DeviceError(f"{function.__name__} failed: {self._dhd.errorGetLastStr()}")

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center.

        Raises:
            DeviceError: it cannot be read.
        """
        was, was_time = tuple(self._at), self._at_time
        self._do(self._dhd.getPosition, self._at)
        self._at_time = time.perf_counter()
        passed = max(self._at_time - was_time, 1e-6)
        self._came = [(now - then) / passed for now, then in zip(self._at, was, strict=True)]
        return self._center[0] - self._at[0], self._center[1] - self._at[1]

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's when its position was read last.

        Raises:
            DeviceError: it cannot be read.
        """
        dhd = self._dhd
        if dhd.getLinearVelocity(self._moving, self._id) < 0:
            # after a pause longer than its window the SDK has too few positions: take the last two
            if dhd.errorGetLast() != TIMEOUT:
                raise DeviceError(f"getLinearVelocity failed: {dhd.errorGetLastStr()}")
            self._moving[:] = self._came
        return -self._moving[0], -self._moving[1]

    @property
    def held(self) -> bool:
        """Whether the button is pressed or the gripper closed; not if there is none."""
        self._held = self._dhd.getButton(0, self._id) == 1
        return self._held

    def set_force(self, force: Pair) -> None:
        """Have this force (2,) in N act, and the plane's with it, until another is set.

        Raises:
            DeviceError: it cannot be set, or so much time has passed that the firmware has dropped the last one.
        """
        if self.watchdog and time.perf_counter() - self._forced > WATCHDOG_UNITS * WATCHDOG_UNIT:
            pause = time.perf_counter() - self._forced
            raise DeviceError(f"no force was set for {1000 * pause:.0f} ms, so the device's watchdog has dropped it")
        self._grip += 1 / GRIP_STEPS if self._held else -1 / LET_GO_STEPS
        self._grip = min(max(self._grip, 0.0), 1.0)
        up = self._stiffness * (self._center[2] - self._at[2]) - self._damping * self._moving[2]
        x, y, z = -force[0], -force[1], self._grip * min(max(up, -self._plane_force), self._plane_force)
        norm = hypot(x, y, z)
        if not isfinite(norm):
            raise DeviceError(f"force = {force} N with {z} N to the plane must be finite")
        share = self._most / norm if norm > self._most else 1.0
        self._do(self._dhd.setForce, (share * x, share * y, share * z))
        self._forced = time.perf_counter()

    def relax(self) -> None:
        """Have no force act at all, not the plane's either. Forces that the watchdog has dropped may then act again.

        Raises:
            DeviceError: it cannot be set.
        """
        self._grip = 0.0
        self._do(self._dhd.setForce, (0.0, 0.0, 0.0))
        if self.watchdog and time.perf_counter() - self._forced > WATCHDOG_UNITS * WATCHDOG_UNIT:
            self._do(self._dhd.enableForce, True)
        self._forced = time.perf_counter()

    def close(self) -> None:
        """No force, brakes, and let go of the device, each even if the one before fails.

        Raises:
            DeviceError: one of them failed.
        """
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
