"""The servo: its steps in simulated time, and its process in real time, also when either process dies."""

import math
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from guidance.haptics.devices import DeviceError
from guidance.haptics.devices.pointer import Mouse
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import PERIOD, SERVO_HZ, TICK, InProcessServo
from guidance.haptics.servo_process import ServoProcess
from guidance.haptics.shared_record import SharedRecord
from guidance.simulated_users import SimulatedUsers, personal_streams, sample_people
from tests import ROOT
from tests.guidance.haptics.fake_device import Logged, Refused

AT_ONCE = SafetyLimits(soft_start=0.0, slew=3000.0)  # the full force within a step
QUICK = SafetyLimits(soft_start=0.0)
SEEN = np.zeros(12)


class Hand:
    """A virtual device whose hand a test moves, and which records its forces."""

    def __init__(self):
        self.position = self.velocity = (0.0, 0.0)
        self.is_held, self.forces, self.passed, self.broken, self.ends = True, [], 0.0, None, 0

    def set_force(self, force):
        if self.broken == "set":
            raise Refused("no answer from the motor")
        self.forces.append(force)

    def relax(self):
        if self.broken is not None:
            raise Refused("no answer at all")
        self.forces.append("relaxed")

    def close(self):
        self.ends += 1

    def advance(self, seconds, state):
        self.passed += seconds
        self.state = state


class Unreadable(Hand):
    """Its position cannot be read while it is broken."""

    @property
    def position(self):
        if self.broken == "read":
            raise Refused("")
        return (0.0, 0.0)

    @position.setter
    def position(self, value):
        pass


def in_process(limits=AT_ONCE, device=None):
    device = device or Hand()
    return device, InProcessServo(device, limits)


# its steps


def test_the_force_goes_in_a_line_from_the_last_to_the_newest_in_a_tick():
    device, servo = in_process()
    servo.push((1.0, -2.0))
    servo.advance(20, SEEN)
    servo.push((2.0, 0.0))
    servo.advance(20, SEEN)
    forces = np.array(device.forces[1:])
    share = np.arange(1, 21)[:, None] / 20
    np.testing.assert_allclose(forces[:20], share * (1.0, -2.0), atol=1e-12)
    np.testing.assert_allclose(forces[20:], (1.0, -2.0) + share * (1.0, 2.0), atol=1e-12)
    assert device.forces[0] == "relaxed"  # to begin with
    assert servo.force == (2.0, 0.0)


def test_a_force_that_comes_early_goes_on_from_where_the_line_is():
    device, servo = in_process()
    servo.push((2.0, 0.0))
    servo.advance(10, SEEN)
    servo.push((0.0, 0.0))
    servo.advance(20, SEEN)
    np.testing.assert_allclose([x for x, _ in device.forces[1:]], [*np.arange(1, 11) / 10, *np.arange(19, -1, -1) / 20])


def test_the_force_is_held_until_it_is_stale_and_then_ramps_down():
    device, servo = in_process(QUICK)
    servo.push((3.0, 0.0))
    servo.advance(100, SEEN)
    forces = [x for x, _ in device.forces[1:]]
    assert forces[19:39] == pytest.approx([3.0] * 20)
    assert np.diff(forces[39:58]) == pytest.approx(-QUICK.slew * PERIOD)
    assert forces[65:] == [0.0] * 35
    assert servo.fault is None


def test_there_is_no_force_before_a_request():
    device, servo = in_process()
    servo.advance(100, SEEN)
    assert device.forces[1:] == [(0.0, 0.0)] * 100


@pytest.mark.parametrize("bad", [(math.nan, 1.0), (1.0, math.inf), (-math.inf, math.nan)])
def test_a_force_that_is_not_finite_is_zero_and_forgotten(bad):
    _, servo = in_process()
    servo.push((1.0, 1.0))
    servo.advance(20, SEEN)
    servo.push(bad)
    servo.advance(20, SEEN)
    assert servo.force == (0.0, 0.0)
    servo.push((1.0, 1.0))
    servo.advance(20, SEEN)
    assert servo.force == (1.0, 1.0)


def test_a_huge_force_is_clipped_before_the_line_is_drawn():
    device, servo = in_process()
    for sign in (1.7e308, -1.7e308):
        servo.push((sign, 0.0))
        servo.advance(20, SEEN)
    np.testing.assert_allclose([x for x, _ in device.forces[21:]], 3.0 - 0.3 * np.arange(1, 21), atol=1e-12)


@pytest.mark.parametrize("who", ["device", "caller"])
def test_either_dead_mans_switch_ends_the_force(who):
    device, servo = in_process(QUICK)
    for _ in range(5):
        servo.push((3.0, 0.0))
        servo.advance(20, SEEN)
    assert servo.force == (3.0, 0.0) and servo.is_held
    device.is_held = who != "device"
    for _ in range(5):
        servo.push((3.0, 0.0), is_held=who != "caller")
        servo.advance(20, SEEN)
    assert servo.force == (0.0, 0.0) and servo.fault is None
    assert servo.is_held == (who != "device")


def test_a_fault_relaxes_the_device_until_it_is_released():
    device, servo = in_process()
    servo.push((3.0, 0.0))
    servo.advance(20, SEEN)
    device.position = (1.0, 0.0)
    servo.push((3.0, 0.0))
    servo.advance(20, SEEN)
    assert device.forces[-20:] == ["relaxed"] * 20 and servo.force == (0.0, 0.0)
    assert "further" in servo.fault and not servo.release()
    device.position = (0.0, 0.0)
    servo.advance(1, SEEN)
    assert servo.release() and servo.fault is None
    servo.push((3.0, 0.0))
    servo.advance(20, SEEN)
    assert servo.force == (3.0, 0.0)


@pytest.mark.parametrize(
    ("broken", "words"),
    [("set", "the device failed: no answer from the motor"), ("read", "the device failed: Refused")],
)
def test_a_device_that_fails_is_a_fault_and_no_exception(broken, words):
    device, servo = in_process(device=Unreadable())
    servo.push((3.0, 0.0))
    servo.advance(20, SEEN)
    device.broken = broken
    servo.advance(5, SEEN)
    assert servo.force == (0.0, 0.0) and servo.fault == words
    assert not servo.release()
    device.broken = None
    servo.advance(5, SEEN)
    assert device.forces[-5:] == ["relaxed"] * 5 and servo.fault
    assert servo.release()


def test_a_device_that_is_broken_from_the_start_is_a_fault():
    device = Hand()
    device.broken = "set"
    servo = InProcessServo(device, AT_ONCE)
    assert servo.fault == "the device failed: no answer at all"


def test_closing_in_process_closes_the_device_once():
    device, servo = in_process()
    servo.push((3.0, 0.0))
    servo.advance(20, SEEN)
    servo.close()
    servo.close()
    assert device.ends == 1 and servo.force == (0.0, 0.0)
    assert servo.fault == "the servo is closed" and not servo.release()
    with pytest.raises(ValueError, match=r"^the servo is closed$"):
        servo.advance(1, SEEN)


def test_the_servo_in_process_is_deterministic():
    def play(device):
        servo, rng, trail = InProcessServo(device, SafetyLimits()), np.random.default_rng(3), []
        for _ in range(60):
            if isinstance(device, Mouse):
                device.point(*rng.uniform(-0.075, 0.075, 2))
            servo.push(rng.uniform(-3, 3, 2))
            for _ in range(4):
                servo.advance(5, SEEN)
                trail.append((*servo.position, *servo.velocity, *servo.force))
        assert servo.fault is None
        return np.array(trail)

    def person():
        return SimulatedUsers(sample_people(1, 4), personal_streams(1, 4))

    for device in (Mouse, lambda: Simulated(person())):
        first, second = play(device()), play(device())
        assert np.array_equal(first, second)
        assert np.ptp(first, axis=0).min() > 0


def test_state_and_time_reach_the_virtual_device():
    device, servo = in_process()
    servo.advance(7, state := np.arange(12.0))
    assert device.passed == pytest.approx(0.007) and device.state is state


def test_a_simulated_person_in_the_servo_feels_the_force():
    people = [SimulatedUsers(sample_people(1, 4), personal_streams(1, 4)) for _ in range(2)]
    servos = [InProcessServo(Simulated(users), QUICK) for users in people]
    for _ in range(50):
        for servo, force in zip(servos, ((2.0, 0.0), (0.0, 0.0)), strict=True):
            servo.push(force)
            servo.advance(20, SEEN)
    assert servos[0].position[0] > servos[1].position[0] + 0.003


# a record in shared memory


def test_a_record_that_is_half_written_is_not_read():
    import multiprocessing

    slot = SharedRecord("=q2d", multiprocessing.get_context("spawn"), 1, 2.0, 3.0)
    assert slot.read() == (1, 2.0, 3.0)
    before = slot._raw.raw
    slot.write(2, -5.0, 7.0)
    after = slot._raw.raw
    for cut in range(1, len(before)):
        for torn in (after[:cut] + before[cut:], before[:cut] + after[cut:]):
            if torn not in (before, after):
                slot._raw.raw = torn
                assert slot.read() is None, cut


# its process


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log.txt"


@pytest.fixture
def begin(log):
    begun = []

    def begin(limits=AT_ONCE, **keywords):
        begun.append(
            ServoProcess(("tests.guidance.haptics.fake_device", "Logged", {"path": str(log), **keywords}), limits)
        )
        return begun[-1]

    yield begin
    for servo in begun:
        servo.close()


PATIENCE = 30.0  # s: a loaded machine is slow, and no test depends on how slow


def wait_for(condition, interval=0.005):
    end = time.monotonic() + PATIENCE
    while not (result := condition()) and time.monotonic() < end:
        time.sleep(interval)
    return result


def feed(servo, force, condition, is_held=True):
    """Push a force until a condition holds; returns whether it does."""

    def push():
        servo.push(force, is_held)
        return condition()

    return wait_for(push, TICK)


def feels(servo, *force):
    return lambda: servo.force == force


def lines(log):
    return Path(log).read_text().splitlines()


def forces(log):
    return np.array([line.split()[1:] for line in lines(log) if line.startswith("force")], dtype=float)


def ended_well(log):
    """Whether the device was relaxed and then closed, once, as its last calls."""
    done = lines(log)
    return done[-2:] == ["relax", "close"] and done.count("close") == 1


def child(log):
    return int(lines(log)[0].split()[1])


def test_the_process_sets_the_force_in_steps_and_closes(begin, log):
    start = time.monotonic()
    servo = begin()
    assert feed(servo, (1.0, -2.0), feels(servo, 1.0, -2.0))
    assert servo.position == (0.01, -0.02) and servo.velocity == (0.3, 0.4) and servo.is_held
    assert servo.fault is None
    assert feed(servo, (1.0, -2.0), lambda: servo.steps > 200)
    steps, seconds = servo.steps, time.monotonic() - start
    servo.advance(20, SEEN)  # time passes by itself
    servo._process.terminate = lambda: pytest.fail("it did not end by itself")
    servo.close()
    servo.close()
    assert ended_well(log) and servo.fault == "the servo is closed"
    assert steps <= seconds * SERVO_HZ + 1
    assert (forces(log) == (1.0, -2.0)).all(axis=1).any()


def test_the_process_knows_nothing_of_the_game(begin, log):
    begin()
    assert re.fullmatch(r"open \d+", lines(log)[0])  # else the heavy modules that it imported


def test_a_callable_opens_the_device_as_well(log):
    servo = ServoProcess(partial(Logged, str(log)), AT_ONCE)
    servo.close()
    assert ended_well(log)


def test_a_device_that_does_not_open_is_an_error_here(log):
    with pytest.raises(DeviceError, match=r"^there is no such device$"):
        ServoProcess(
            ("tests.guidance.haptics.fake_device", "Logged", {"path": str(log), "refuse": "there is no such device"}),
            AT_ONCE,
        )
    with pytest.raises(DeviceError, match=r"No module named 'guidance.haptics.devices.loudspeaker'"):
        ServoProcess(("guidance.haptics.devices.loudspeaker", "Loudspeaker", {}), AT_ONCE)


def test_a_process_that_dies_as_it_opens_is_an_error_here():
    with pytest.raises(DeviceError, match=r"^the servo ended while it opened the device \(exit code 5\)$"):
        ServoProcess(("os", "_exit", {"status": 5}), AT_ONCE)


def test_the_process_keeps_to_the_limits(begin, log):
    limits = SafetyLimits(soft_start=0.05)
    servo = begin(limits)
    rng = np.random.default_rng(0)
    for _ in range(25):
        steps, force = servo.steps, rng.uniform(-9, 9, 2)
        assert feed(servo, force, lambda steps=steps: servo.steps >= steps + 20)
    servo.close()
    done = forces(log)
    norms = [math.hypot(*force) for force in done]  # numpy's rounds otherwise
    assert 2.5 < max(norms) <= limits.force
    assert np.hypot(*np.diff(done, axis=0, prepend=0).T).max() <= limits.slew * PERIOD * (1 + 1e-9)


def test_vectors_are_never_torn(begin, log):
    servo, rng, different = begin(), np.random.default_rng(1), set()

    def pushes_and_reads():
        for value in rng.uniform(-2, 2, 100):
            servo.push((value, value))
        x, y = servo.force
        assert x == y
        different.add(x)
        return len(different) > 200

    assert wait_for(pushes_and_reads, interval=0.0)
    servo.close()
    done = forces(log)
    assert len(done) >= len(different) - 1  # the first may be that of no request yet
    assert (done[:, 0] == done[:, 1]).all()


def test_the_force_ramps_down_when_requests_stop(begin, log):
    servo = begin(QUICK)
    assert feed(servo, (3.0, 0.0), feels(servo, 3.0, 0.0))
    assert wait_for(feels(servo, 0.0, 0.0))
    assert servo.fault is None
    servo.close()
    falling = forces(log)[:, 0]
    falling = falling[np.flatnonzero(falling == 3.0)[-1] :]
    assert np.diff(falling).min() >= -QUICK.slew * PERIOD * (1 + 1e-9)
    assert (np.diff(falling)[:19] < 0).all() and falling[-1] == 0


def test_letting_go_ends_the_force_in_the_process(begin):
    servo = begin()
    assert feed(servo, (3.0, 0.0), feels(servo, 3.0, 0.0))
    assert feed(servo, (3.0, 0.0), feels(servo, 0.0, 0.0), is_held=False) and servo.fault is None


def test_a_device_that_fails_in_the_process_is_a_fault_until_it_is_released(begin, log):
    servo = begin(fails_at=50)
    assert feed(servo, (3.0, 0.0), lambda: servo.fault) == "the device failed: no answer from the motor"
    assert servo.force == (0.0, 0.0)
    assert wait_for(lambda: lines(log).count("relax") > 60)
    done = lines(log)
    failed = next(index for index, line in enumerate(done) if line.startswith("failed"))
    assert done[failed + 1 : failed + 50] == ["relax"] * 49  # at once, and until
    assert not servo.release()  # it fails again at once
    assert servo.fault == "the device failed: no answer from the motor"
    assert wait_for(servo.release)  # each attempt is a call, and after a hundred it works again
    assert feed(servo, (3.0, 0.0), feels(servo, 3.0, 0.0))


def test_a_hand_that_is_out_of_the_workspace_keeps_the_fault(begin, tmp_path):
    far = tmp_path / "far"
    servo = begin(far=str(far))
    assert feed(servo, (3.0, 0.0), feels(servo, 3.0, 0.0))
    far.touch()
    assert wait_for(lambda: servo.fault) == "the hand is 1.000 m from the center, further than 0.12 m"
    assert servo.force == (0.0, 0.0) and not servo.release()
    far.unlink()
    time.sleep(0.02)
    assert servo.fault and wait_for(servo.release)
    assert feed(servo, (3.0, 0.0), feels(servo, 3.0, 0.0))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_process_that_gets_a_signal_leaves_no_force(begin, log, number):
    servo = begin()
    assert feed(servo, (3.0, 0.0), lambda: servo.force[0] > 0 or servo.fault)
    os.kill(child(log), number)
    assert wait_for(lambda: servo.fault) == "the servo has ended (exit code 0)"
    assert ended_well(log)
    assert not servo.release()


def test_a_process_that_is_gone_is_a_fault(begin, log):
    servo = begin(ends_at=50)
    assert feed(servo, (3.0, 0.0), lambda: servo.force[0] > 0 or servo.fault)
    assert wait_for(lambda: servo.fault) == "the servo has ended (exit code 3)"


def test_a_process_that_hangs_is_a_fault(begin):
    start = time.monotonic()
    servo = begin(hangs_at=20)
    assert wait_for(lambda: servo.fault).startswith("the servo hangs: no step for ")
    assert wait_for(lambda: servo.fault is None)  # it has come back
    time.sleep(0.1)
    assert servo.steps < (time.monotonic() - start - 0.9) * SERVO_HZ  # the steps of that second are skipped


def test_looking_seldom_is_no_fault(begin):
    servo = begin()
    time.sleep(0.6)
    assert servo.fault is None


PARENT = """
import os, sys, time
import numpy  # heavy, and the child must not import it for this program's sake
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo_process import ServoProcess

device = "tests.guidance.haptics.fake_device", "Logged", {"path": sys.argv[1]}
servo = ServoProcess(device, SafetyLimits(soft_start=0.0, slew=3000.0))
print("begun", flush=True)
for _ in range(1000):
    servo.push((3.0, 0.0))
    time.sleep(0.01)
    if len(sys.argv) > 2 and servo.force[0] == 3.0:
        raise SystemExit(int(sys.argv[2]))
"""


def parent(tmp_path, log, *arguments):
    program = tmp_path / "program.py"
    program.write_text(PARENT)
    command, environment = [sys.executable, str(program), str(log), *arguments], os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def test_when_the_parent_is_killed_the_device_is_left_without_a_force(tmp_path, log):
    process = parent(tmp_path, log)
    assert process.stdout.readline() == "begun\n"
    assert wait_for(lambda: len(forces(log)) and forces(log)[-1][0] == 3.0)
    process.kill()
    process.wait()
    assert wait_for(lambda: ended_well(log))
    assert re.fullmatch(r"open \d+", lines(log)[0])
    assert wait_for(lambda: not Path(f"/proc/{child(log)}").exists() or not sys.platform.startswith("linux"))


def test_when_the_program_ends_without_closing_the_device_is_closed(tmp_path, log):
    process = parent(tmp_path, log, "0")
    assert process.wait(PATIENCE) == 0
    assert ended_well(log)
