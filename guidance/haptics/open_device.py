"""Which hand a configuration asks for: the devices by name, each behind the safety layer."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import InputError, require_counts, require_numbers
from guidance.haptics.devices import DeviceError
from guidance.haptics.devices.gamepad import Gamepad, open_gamepad
from guidance.haptics.devices.mouse import Mouse
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.seat import HapticHand
from guidance.haptics.servo import InProcessServo, ServoProcess
from guidance.simulated_users import SimulatedUsers
from guidance.simulated_users.arm import HAND_REACH

KINDS = ("mouse", "gamepad", "simulated", "forcedimension")


@dataclass(frozen=True)
class OpenDevice:
    """A hand, and what a window has to tell it.

    Attributes:
        pointed: takes the action (2,) under the pointer.
        unplugged: takes the number of a gamepad that is gone.
    """

    hand: HapticHand
    pointed: Callable[[np.ndarray], None] = lambda action: None
    unplugged: Callable[[int], None] = lambda number: None


def check_device(device: DictConfig) -> None:
    """Refuse a configuration of a device that no device has.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    kind = device.get("kind") if device is not None else None
    if kind not in KINDS:
        raise InputError(f"device.kind = {kind} must be one of {', '.join(KINDS)}")
    cfg = OmegaConf.create({"device": device})
    if kind in ("mouse", "gamepad"):
        require_numbers(cfg, "device.fastest")
    if kind == "gamepad":
        require_counts(cfg, "device.index", least=0)
        require_numbers(cfg, "device.dead_zone", least=0.0, at_most=0.9)


@contextmanager
def device_session(
    device: DictConfig, limits: SafetyLimits, person: SimulatedUsers | None = None
) -> Iterator[OpenDevice]:
    """Open a hand, see `open_hand`, and let go of it whatever happens.

    Raises:
        InputError: the device is not there, cannot be opened, or refuses its configuration.
    """
    try:
        held = open_hand(device, limits, person)
    except (ValueError, DeviceError) as error:
        raise InputError(f"device: {error}") from error
    try:
        yield held
    finally:
        held.hand.close()


def open_hand(device: DictConfig, limits: SafetyLimits, person: SimulatedUsers | None = None) -> OpenDevice:
    """Open a device and put the safety layer before it.

    Args:
        device: of `conf/device`.
        person: who holds it, if it is a simulated person.

    Raises:
        ValueError: the device refuses its configuration.
        DeviceError: it is not there or cannot be opened.
    """
    options = {key: value for key, value in OmegaConf.to_container(device).items() if key != "kind"}
    if device.kind == "mouse":
        mouse = Mouse(**options)
        return OpenDevice(InProcessServo(mouse, limits), pointed=lambda action: mouse.point(*(HAND_REACH * action)))
    if device.kind == "gamepad":
        pad = Gamepad(open_gamepad(options.pop("index")), limits.force, **options)
        return OpenDevice(InProcessServo(pad, limits), unplugged=pad.unplugged)
    if device.kind == "simulated":
        return OpenDevice(InProcessServo(Simulated(person), limits))
    return OpenDevice(ServoProcess(("guidance.haptics.devices.forcedimension", "ForceDimension", options), limits))
