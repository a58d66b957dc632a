"""Devices by name: settings are checked, and another package adds its own."""

from dataclasses import dataclass

import pytest

from guidance.haptics.devices.pointer import Mouse
from guidance.haptics.open_device import DEVICES, OpenDevice, device_session
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import InProcessServo


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "omega"}, "device.kind = 'omega' must be one of mouse, gamepad, forcedimension, simulated"),
        ({"kind": "mouse", "max_speed": 0}, "device.max_speed = 0 must be a finite number above 0"),
        ({"kind": "mouse", "speed": 1.0}, "device.speed: no such setting, must be one of max_speed"),
        ({"kind": "gamepad", "index": -1}, "device.index = -1 must be a whole number of at least 0"),
        (
            {"kind": "gamepad", "dead_zone": 1.0},
            "device.dead_zone = 1.0 must be a finite number of at least 0 and at most 0.9",
        ),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError) as raised:
        DEVICES.build(settings, "device")
    assert str(raised.value).startswith(message)


def test_a_registered_device_is_opened_by_name_and_closed(monkeypatch):
    monkeypatch.setattr(DEVICES, "_entries", dict(DEVICES))

    @DEVICES.register("mymouse")
    @dataclass(frozen=True)
    class MyMouseConfig:
        speed: float = 1.0

        def open(self, limits, person):
            return OpenDevice(InProcessServo(Mouse(max_speed=self.speed), limits))

    with device_session(DEVICES.build({"kind": "mymouse", "speed": 2.0}, "device"), SafetyLimits()) as opened:
        assert opened.hand.device.max_speed == 2.0 and opened.hand.fault is None
    assert opened.hand.fault == "the servo is closed"
