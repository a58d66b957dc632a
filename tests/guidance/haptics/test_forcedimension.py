"""Force Dimension's devices: the real binding, on a library whose C functions write down how they are called."""

import builtins
import math
import sys
import time
from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace

import pytest

from guidance.haptics.devices import DeviceError, forcedimension
from guidance.haptics.devices.forcedimension import GRIP_STEPS, ForceDimension
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import InProcessServo

BINDING = "forcedimension_core"
TIME_GUARD, SATURATED, TIMEOUT = 1, 2, 7


class Sdk:
    """The C functions of an Omega.7's SDK: a hand that a test puts somewhere, and a record of the calls."""

    def __init__(self):
        self.at, self.moving, self.button, self.gripper = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1, True
        self.calls, self.answers, self.raises, self.error, self.reason = [], {}, {}, 1, b"the cable is out"

    def _did(self, name, *arguments):
        self.calls.append((name, *arguments))
        if name in self.raises:
            raise self.raises[name]
        return self.answers.get(name, 0)

    def did(self, name):
        return [call[1:] for call in self.calls if call[0] == name]

    @property
    def forces(self):
        return [call[:3] for call in self.did("dhdSetForce")]

    def dhdOpen(self):
        return self._did("dhdOpen")

    def dhdOpenID(self, index):
        return self._did("dhdOpenID", index)

    def dhdGetPosition(self, x, y, z, device):
        x.value, y.value, z.value = self.at
        return self._did("dhdGetPosition", device)

    def dhdGetLinearVelocity(self, x, y, z, device):
        x.value, y.value, z.value = self.moving
        return self._did("dhdGetLinearVelocity", device)

    def dhdGetButton(self, index, device):
        return self.answers.get("dhdGetButton", self.button)

    def dhdHasGripper(self, device):
        return self.gripper

    def dhdGetSystemName(self, device):
        return b"omega.7"

    def dhdErrorGetLastStr(self):
        return self.reason

    def dhdErrorGetLast(self):
        return self.error


for name in (
    *("dhdSetForce", "dhdEnableForce", "dhdSetGravityCompensation", "dhdConfigLinearVelocity", "dhdSetMaxForce"),
    *("dhdEmulateButton", "dhdStop", "dhdClose", "dhdSetWatchdog", "dhdEnableExpertMode", "dhdDisableExpertMode"),
):
    setattr(Sdk, name, lambda self, *arguments, name=name: self._did(name, *arguments))


def forget():
    for name in [name for name in sys.modules if name.split(".")[0] == BINDING]:
        del sys.modules[name]


@pytest.fixture
def sdk(monkeypatch):
    """A fresh import of the binding, on the fake library; anything that is not faked answers with what is no number."""
    if find_spec(BINDING) is None:
        pytest.skip(f"{BINDING} is not installed")
    forget()
    monkeypatch.setenv("__fdsdkpy_unittest__", "True")
    runtime = import_module(f"{BINDING}.runtime")
    fake = Sdk()
    import_module(f"{BINDING}.dhd")  # sets the argument types of what is replaced now
    for name in dir(fake):
        if name.startswith("dhd"):
            setattr(runtime._libdhd, name, getattr(fake, name))
    yield fake
    forget()


@pytest.fixture
def clock(monkeypatch):
    """The device's clock, which a test moves."""
    now = SimpleNamespace(time=100.0)
    monkeypatch.setattr(
        forcedimension, "time", SimpleNamespace(perf_counter=lambda: now.time, sleep=lambda seconds: tick(seconds))
    )

    def tick(seconds):
        now.time += seconds

    now.tick = tick
    return now


@pytest.fixture
def device(sdk, clock):
    return ForceDimension(plane_stiffness=0.0, plane_damping=0.0)


def step(device, force=(0.0, 0.0)):
    """What the servo does in a step."""
    out = device.position, device.velocity, device.is_held
    device.set_force(force)
    return out


# opening


def test_opening_prepares_the_device_and_enables_forces_at_zero(sdk, clock):
    device = ForceDimension(max_force=5.0)
    assert device.name == "omega.7" and device.watchdog
    assert sdk.did("dhdSetGravityCompensation") == [(True, 0)]
    assert sdk.did("dhdEmulateButton") == [(True, 0)]
    assert sdk.did("dhdEnableForce") == [(True, 0)]
    assert sdk.did("dhdSetMaxForce") == [(5.0, 0)]
    assert sdk.did("dhdSetWatchdog") == [(200, 0)]  # of 125 us: 25 ms
    names = [call[0] for call in sdk.calls]
    assert names[0] == "dhdOpen"
    assert names.index("dhdSetForce") < names.index("dhdEnableForce") and set(sdk.forces) == {(0.0, 0.0, 0.0)}
    assert names.index("dhdEnableExpertMode") < names.index("dhdSetWatchdog") < names.index("dhdDisableExpertMode")


def test_one_of_several_devices_is_opened_by_its_index(sdk, clock):
    sdk.answers["dhdOpenID"] = 4
    device = ForceDimension(index=2)
    assert sdk.did("dhdOpenID") == [(2,)] and not sdk.did("dhdOpen")
    step(device)
    device.close()
    for name in ("dhdSetForce", "dhdGetPosition", "dhdStop", "dhdClose", "dhdEnableForce"):
        assert {call[-1] for call in sdk.did(name)} == {4}, name


def test_a_device_that_is_not_there_is_an_error(sdk):
    sdk.answers["dhdOpen"], sdk.reason = -1, b"no device found"
    with pytest.raises(DeviceError, match=r"could be opened \(no device found\): it must be connected"):
        ForceDimension()
    assert [call[0] for call in sdk.calls] == ["dhdOpen"]


@pytest.mark.parametrize(
    "name",
    ["SetGravityCompensation", "ConfigLinearVelocity", "SetMaxForce", "EmulateButton", "EnableForce", "GetPosition"],
)
def test_a_device_that_refuses_while_it_is_prepared_is_stopped_and_closed(sdk, name):
    sdk.answers[f"dhd{name}"] = -1
    with pytest.raises(DeviceError, match=f"(?i)^{name} failed: the cable is out$"):
        ForceDimension()
    assert [call[0] for call in sdk.calls[-3:]] == ["dhdSetForce", "dhdStop", "dhdClose"]


def test_a_velocity_that_never_comes_is_an_error(sdk, clock):
    sdk.answers["dhdGetLinearVelocity"], sdk.reason = -1, b"timeout"
    with pytest.raises(DeviceError, match=r"^getLinearVelocity failed: timeout$"):
        ForceDimension()
    assert len(sdk.did("dhdGetPosition")) > 100 and sdk.calls[-1][0] == "dhdClose"


def test_a_device_without_a_watchdog_goes_without(sdk, clock):
    sdk.answers["dhdSetWatchdog"] = -1
    device = ForceDimension()
    assert not device.watchdog
    clock.tick(1.0)
    step(device)


def test_a_missing_binding_says_what_to_install(monkeypatch):
    forget()
    real = builtins.__import__

    def without(name, *rest):
        if name.split(".")[0] == BINDING:
            raise ModuleNotFoundError(f"No module named {BINDING!r}", name=BINDING)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        DeviceError, match=rf"^{BINDING} is missing: pip install 'airhockey-haptics\[forcedimension\]'$"
    ):
        ForceDimension()


@pytest.mark.skipif(find_spec(BINDING) is None, reason=f"{BINDING} is not installed")
def test_a_missing_sdk_says_what_to_install(monkeypatch):
    monkeypatch.setenv("__fdsdkpy_unittest_runtime__", "True")  # the binding then finds no library
    forget()
    try:
        with pytest.raises(
            DeviceError, match=r"^the Force Dimension SDK .* is missing: install .* FDSDK to its folder"
        ):
            ForceDimension()
    finally:
        forget()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("plane_stiffness", -1.0),
        ("plane_damping", math.nan),
        ("plane_force", math.inf),
        ("max_force", 0.0),
        ("max_force", -1),
    ],
)
def test_bad_numbers_are_refused_by_name_before_anything_is_opened(name, value):
    with pytest.raises(ValueError, match=rf"^{name} = {value} must be a finite number"):
        ForceDimension(**{name: value})
    with pytest.raises(ValueError, match=r"^center = \(0, 0\) must be three numbers"):
        ForceDimension(center=(0, 0))


# the hand


def test_the_axes_of_the_hand(device, sdk):
    # its x is toward oneself, its y to one's right; the game's x is away from oneself, its y to one's left
    sdk.at, sdk.moving = (0.03, -0.02, 0.5), (-0.4, 0.1, 9.0)
    position, velocity, held = step(device)
    assert position == (-0.03, 0.02) and velocity == (0.4, -0.1) and held is True


def test_the_center_is_where_it_is_said_to_be(sdk, clock):
    device = ForceDimension(center=(0.01, -0.02, 0.03), plane_stiffness=100.0, plane_damping=0.0)
    sdk.at = (0.01, -0.02, 0.03)
    assert step(device)[0] == (0.0, 0.0)
    for _ in range(GRIP_STEPS):
        step(device)
    assert sdk.forces[-1] == pytest.approx((0.0, 0.0, 0.0))
    sdk.at = (0.02, 0.0, 0.0)
    assert step(device)[0] == pytest.approx((-0.01, -0.02))
    assert sdk.forces[-1] == pytest.approx((0.0, 0.0, 3.0))


@pytest.mark.parametrize(("button", "held"), [(1, True), (0, False), (-1, False)])
@pytest.mark.parametrize("gripper", [True, False])
def test_the_button_is_the_dead_mans_switch_and_a_missing_one_is_not_held(sdk, clock, button, held, gripper):
    sdk.button, sdk.gripper = button, gripper
    assert step(ForceDimension())[2] is held
    assert bool(sdk.did("dhdEmulateButton")) == gripper


@pytest.mark.parametrize("name", ["GetPosition", "GetLinearVelocity", "SetForce"])
def test_every_error_is_raised_with_the_sdks_own_words(device, sdk, name):
    sdk.answers[f"dhd{name}"] = -1
    with pytest.raises(DeviceError, match=f"(?i)^{name} failed: the cable is out$") as raised:
        step(device)
    assert isinstance(raised.value, OSError)


@pytest.mark.parametrize("code", [TIME_GUARD, SATURATED])
def test_the_time_guard_and_a_saturated_motor_are_no_errors(device, sdk, code):
    sdk.answers.update({"dhdGetPosition": code, "dhdSetForce": code})
    step(device, (1.0, 0.0))
    assert sdk.forces[-1] == (-1.0, 0.0, 0.0)


def test_a_velocity_without_positions_enough_is_that_of_the_last_two(device, sdk, clock):
    step(device)
    sdk.at, sdk.moving = (0.02, -0.01, 0.0), (9.0, 9.0, 9.0)
    sdk.answers["dhdGetLinearVelocity"], sdk.error = -1, TIMEOUT
    clock.tick(0.02)
    assert step(device)[1] == pytest.approx((-1.0, 0.5))


# the force


def test_the_axes_of_the_force(device, sdk):
    device.set_force((2.0, -1.0))  # toward the opponent, to one's right
    assert sdk.did("dhdSetForce")[-1] == (-2.0, 1.0, 0.0, 0)


def test_a_force_and_the_hand_have_the_same_axes(device, sdk):
    # work is done on a hand that moves along the force, in either frame
    sdk.moving = (0.3, -0.2, 0.0)
    _, velocity, _ = step(device, (1.5, 0.7))
    assert 1.5 * velocity[0] + 0.7 * velocity[1] == pytest.approx(
        sum(f * v for f, v in zip(sdk.forces[-1], sdk.moving, strict=True))
    )


def test_the_plane_is_held_by_a_spring_and_a_damper_that_rise_with_the_grip(sdk, clock):
    device = ForceDimension(plane_stiffness=100.0, plane_damping=2.0, plane_force=4.0)
    sdk.at, sdk.moving = (0.0, 0.0, 0.02), (0.0, 0.0, 0.5)
    up = [step(device) and sdk.forces[-1][2] for _ in range(GRIP_STEPS + 50)]
    assert up[: GRIP_STEPS - 1] == pytest.approx([-3.0 * index / GRIP_STEPS for index in range(1, GRIP_STEPS)])
    assert up[GRIP_STEPS:] == pytest.approx([-3.0] * 50)  # 2 N of the spring and 1 N of the damper
    sdk.button = 0
    up = [step(device) and sdk.forces[-1][2] for _ in range(25)]
    assert up[:20] == pytest.approx([-3.0 * (19 - index) / 20 for index in range(20)]) and not any(up[20:])


def test_the_plane_has_a_clip_of_its_own_and_all_of_it_another(sdk, clock):
    device = ForceDimension(plane_stiffness=1000.0, plane_damping=0.0, plane_force=4.0, max_force=4.5)
    sdk.at = (0.0, 0.0, -0.05)
    for _ in range(GRIP_STEPS):
        step(device)
    assert sdk.forces[-1] == pytest.approx((0.0, 0.0, 4.0))
    step(device, (0.0, 3.0))
    assert math.hypot(*sdk.forces[-1]) == pytest.approx(4.5)
    assert sdk.forces[-1] == pytest.approx((0.0, -3.0 * 0.9, 4.0 * 0.9))


@pytest.mark.parametrize("bad", ["force", "hand"])
def test_what_is_no_number_never_reaches_the_motors(sdk, clock, bad):
    device = ForceDimension()
    step(device)
    before = len(sdk.forces)
    if bad == "hand":
        sdk.moving = (0.0, 0.0, math.nan)
    with pytest.raises(DeviceError, match="must be finite"):
        step(device, (math.nan if bad == "force" else 0.0, 1.0))
    assert len(sdk.forces) == before


def test_relaxing_drops_the_plane_as_well_and_it_rises_again(sdk, clock):
    device = ForceDimension(plane_stiffness=100.0, plane_damping=0.0)
    sdk.at = (0.0, 0.0, 0.02)
    for _ in range(GRIP_STEPS):
        step(device, (1.0, 0.0))
    device.relax()
    assert sdk.forces[-1] == (0.0, 0.0, 0.0)
    step(device, (1.0, 0.0))
    assert sdk.forces[-1] == pytest.approx((-1.0, 0.0, -2.0 / GRIP_STEPS))


def test_a_pause_in_which_the_watchdog_dropped_the_force_is_an_error_until_it_is_relaxed(device, sdk, clock):
    step(device, (1.0, 0.0))
    clock.tick(0.020)
    step(device, (1.0, 0.0))
    clock.tick(0.030)
    with pytest.raises(DeviceError, match=r"^no force was set for 30 ms, so the device's watchdog has dropped it$"):
        step(device, (1.0, 0.0))
    assert len(sdk.did("dhdEnableForce")) == 1
    device.relax()
    assert len(sdk.did("dhdEnableForce")) == 2 and sdk.forces[-1] == (0.0, 0.0, 0.0)
    device.relax()
    assert len(sdk.did("dhdEnableForce")) == 2
    step(device, (1.0, 0.0))


# the end


def test_closing_zeroes_stops_and_closes_once(device, sdk):
    step(device, (3.0, 0.0))
    device.close()
    assert [call[:1] + call[1:4] for call in sdk.calls[-3:]] == [
        ("dhdSetForce", 0.0, 0.0, 0.0),
        ("dhdStop", 0),
        ("dhdClose", 0),
    ]
    before = len(sdk.calls)
    device.close()
    assert len(sdk.calls) == before


@pytest.mark.parametrize("failing", [("SetForce",), ("Stop",), ("SetForce", "Stop", "Close")])
def test_closing_does_all_of_it_even_if_some_fails(device, sdk, failing):
    for name in failing:
        sdk.answers[f"dhd{name}"] = -1
    words = "; ".join(f"{name} failed: the cable is out" for name in failing)
    with pytest.raises(DeviceError, match=f"(?i)^{words}$"):
        device.close()
    assert [call[0] for call in sdk.calls[-3:]] == ["dhdSetForce", "dhdStop", "dhdClose"]


def test_closing_does_all_of_it_even_if_the_binding_raises(device, sdk):
    sdk.raises["dhdSetForce"] = RuntimeError("odd")
    with pytest.raises(DeviceError, match=r"^setForce failed: odd$"):
        device.close()
    assert [call[0] for call in sdk.calls[-2:]] == ["dhdStop", "dhdClose"]


# under the servo


class Passing(ForceDimension):
    """Time passes for it as the servo says, so that the servo can be run step by step."""

    def advance(self, seconds, state):
        self.clock.tick(seconds)


def test_the_servo_drives_it_through_the_safety_layer(sdk, clock):
    device = Passing(plane_stiffness=200.0, plane_damping=0.0)
    device.clock = clock
    servo = InProcessServo(device, SafetyLimits(soft_start=0.0))
    sdk.at = (-0.05, 0.0, 0.01)
    for _ in range(100):
        servo.push((4.0, 0.0))
        servo.advance(20, None)
    assert sdk.forces[-1] == pytest.approx((-3.0, 0.0, -2.0)) and servo.position == (0.05, 0.0)
    sdk.at = (-0.5, 0.0, 0.01)
    servo.advance(1, None)
    assert sdk.forces[-1] == (0.0, 0.0, 0.0) and "further than 0.12 m" in servo.fault
    sdk.at = (-0.05, 0.0, 0.01)
    servo.advance(1, None)
    assert servo.release()
    sdk.answers["dhdGetPosition"] = -1
    servo.advance(5, None)
    assert servo.fault == "the device failed: getPosition failed: the cable is out"
    assert sdk.forces[-5:] == [(0.0, 0.0, 0.0)] * 5
    servo.close()
    assert sdk.calls[-1][0] == "dhdClose"


def test_a_step_is_quick_enough_for_a_kilohertz(sdk):
    device = ForceDimension()
    device.watchdog = False  # another process may have the processor for longer than it waits
    start = time.process_time()  # of this process alone: other work does not count
    for _ in range(2000):
        step(device, (1.0, 1.0))
    assert (time.process_time() - start) / 2000 < 0.5e-3
