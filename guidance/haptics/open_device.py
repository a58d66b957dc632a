"""The devices that a configuration can name, each opened behind the safety layer.

Another package adds a device by registering its settings: a dataclass with a method `open`, see `DeviceConfig`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from airhockey_marl.experiment.command import InputError
from airhockey_marl.experiment.registry import Registry
from airhockey_marl.experiment.validation import check_counts, check_numbers, labeled
from guidance.haptics.devices import DeviceError
from guidance.haptics.devices.gamepad import Gamepad, open_gamepad
from guidance.haptics.devices.pointer import MAX_SPEED, Mouse
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.hand import HapticHand
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import InProcessServo
from guidance.haptics.servo_process import ServoProcess
from guidance.simulated_users import SimulatedUsers
from guidance.simulated_users.arm import HAND_REACH


@dataclass(frozen=True)
class OpenDevice:
    """A hand at an open device, and its handlers of a window's events.

    Attributes:
        on_pointer: called with the action (2,) under the pointer.
        on_disconnect: called with the number of a gamepad that is disconnected.
    """

    hand: HapticHand
    on_pointer: Callable[[np.ndarray], None] = lambda action: None
    on_disconnect: Callable[[int], None] = lambda number: None


class DeviceConfig(Protocol):
    """The settings of a device: the fields of a dataclass, which checks them."""

    def open(self, limits: SafetyLimits, person: SimulatedUsers | None) -> OpenDevice:
        """Open the device behind the safety layer; `person` holds it if it is the simulated device."""
        ...


DEVICES: Registry[type[DeviceConfig]] = Registry(
    "device", dict.fromkeys(("mouse", "gamepad", "forcedimension", "simulated"), __name__), group="device", key="kind"
)


@DEVICES.register("mouse")
@dataclass(frozen=True)
class MouseConfig:
    """A mouse.

    Attributes:
        max_speed: m/s at which the hand follows the pointer.
    """

    max_speed: float = MAX_SPEED

    def __post_init__(self) -> None:
        check_numbers(above=0.0, **labeled(self, "device", "max_speed"))

    def open(self, limits: SafetyLimits, person: SimulatedUsers | None) -> OpenDevice:
        mouse = Mouse(max_speed=self.max_speed)
        hand = InProcessServo(mouse, limits)
        return OpenDevice(hand, on_pointer=lambda action: mouse.point(*(HAND_REACH * action)))


@DEVICES.register("gamepad")
@dataclass(frozen=True)
class GamepadConfig:
    """A gamepad.

    Attributes:
        index: of the gamepad among the connected ones, from 0.
        dead_zone: fraction of the stick's travel around its center that counts as the center.
        max_speed: m/s at which the hand follows the stick.
    """

    index: int = 0
    dead_zone: float = 0.12
    max_speed: float = MAX_SPEED

    def __post_init__(self) -> None:
        check_counts(0, **labeled(self, "device", "index"))
        check_numbers(0.0, at_most=0.9, **labeled(self, "device", "dead_zone"))
        check_numbers(above=0.0, **labeled(self, "device", "max_speed"))

    def open(self, limits: SafetyLimits, person: SimulatedUsers | None) -> OpenDevice:
        pad = Gamepad(open_gamepad(self.index), limits.force, self.dead_zone, max_speed=self.max_speed)
        return OpenDevice(InProcessServo(pad, limits), on_disconnect=pad.disconnect)


@DEVICES.register("simulated")
@dataclass(frozen=True)
class SimulatedConfig:
    """A simulated person."""

    def open(self, limits: SafetyLimits, person: SimulatedUsers | None) -> OpenDevice:
        return OpenDevice(InProcessServo(Simulated(person), limits))


@DEVICES.register("forcedimension")
@dataclass(frozen=True)
class ForceDimensionConfig:
    """A device by Force Dimension; its process checks the values, see `guidance.haptics.devices.forcedimension`."""

    index: int | None = None
    center: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    plane_stiffness: float = 600.0
    plane_damping: float = 3.0
    plane_force: float = 4.0
    max_force: float = 6.0

    def open(self, limits: SafetyLimits, person: SimulatedUsers | None) -> OpenDevice:
        factory = "guidance.haptics.devices.forcedimension", "ForceDimension", dict(vars(self))
        return OpenDevice(ServoProcess(factory, limits))


@contextmanager
def device_session(
    config: DeviceConfig, limits: SafetyLimits, person: SimulatedUsers | None = None
) -> Iterator[OpenDevice]:
    """Open a device, and close it whatever happens.

    Args:
        person: the simulated person at the device `simulated`.

    Raises:
        InputError: the device is not there or cannot be opened, or rejects its settings.
    """
    try:
        device = config.open(limits, person)
    except (ValueError, DeviceError) as error:
        raise InputError(f"device: {error}") from error
    try:
        yield device
    finally:
        device.hand.close()
