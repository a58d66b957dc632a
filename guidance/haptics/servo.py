"""The servo: a thousand times a second, from the newest force the guidance asked for to the one that acts on the hand.

The guidance speaks every 20 ms. In between the force goes in a straight line from the one before to the newest, through
the safety layer, to the device. `InProcessServo` does this for a virtual device in time that passes only as it is told; `ServoProcess`
in a process of its own, in real time, that knows nothing of the game: it stops by itself when nobody speaks any more.
"""

import atexit
import gc
import multiprocessing
import os
import signal
import struct
import sys
import types
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import accumulate
from math import inf
from multiprocessing.connection import Connection
from time import monotonic, perf_counter, sleep
from typing import TYPE_CHECKING, Any

from guidance.haptics.devices import Device, DeviceError, Pair, VirtualDevice
from guidance.haptics.safety import NONE, Safety, SafetyLimits, clip_norm

if TYPE_CHECKING:  # the servo's own process starts at once, without numpy
    import numpy as np

SERVO_HZ = 1000
PERIOD = 1 / SERVO_HZ
TICK = 0.02  # s between two forces of the guidance

# of the process
SPIN = 0.0002  # s before its time a step stops sleeping and watches the clock
LATE = PERIOD / 2  # s after its time a step counts as late
ORPHAN_STEPS = 20  # from one look whether the parent is alive to the next
PRIORITY, NICENESS = 20, -15  # where the system allows it
LONGEST = 20_000  # us, longer periods are counted as this
OPENING, ANSWER, ENDING = 30.0, 0.25, 2.0  # s of patience with the process
HANGING = 0.25  # s without a step
FAULT_BYTES = 300

DeviceFactory = Callable[[], Device] | tuple[str, str, Mapping[str, Any]]
"""What opens a device in another process: something importable to call, or a module, a name in it and keywords."""


class ServoLoop:
    """One step of the servo, whoever's time it is.

    Attributes:
        position, velocity, held: of the hand, as read last.
        force: (2,) N, what really acts on it.
    """

    def __init__(self, device: Device, limits: SafetyLimits) -> None:
        self.device, self.safety = device, Safety(limits)
        self.position = self.velocity = self.force = NONE
        self.held = False
        self.rest()

    def push(self, x: float, y: float, held: bool) -> None:
        """Ask for this force in N from now on; none if it is not finite."""
        self._from = self._target()
        self._to = clip_norm(x, y, self.safety.limits.force)
        self._age, self._wanted = 0.0, held

    def rest(self) -> None:
        """Have no force act until the next push, which then starts softly, as if it were the first."""
        self._from = self._to = NONE
        self._age, self._wanted = inf, False
        self.safety.rest()
        self._relax()

    def _target(self) -> Pair:
        share = min(self._age / TICK, 1.0)
        (from_x, from_y), (to_x, to_y) = self._from, self._to
        return from_x + (to_x - from_x) * share, from_y + (to_y - from_y) * share

    def step(self, seconds: float) -> None:
        """Read the hand, and set the force for it; `seconds` have passed since the last step.

        The force changes by no more than it may in one period, however late the step is.
        """
        device, safety = self.device, self.safety
        self._age += seconds
        try:
            self.position, self.velocity, self.held = device.position, device.velocity, device.held
            held = self.held and self._wanted
            self.force = safety.filter(self._target(), self._age, self.position, self.velocity, held, PERIOD)
            if safety.fault is None:
                device.set_force(self.force)
                return
        except Exception as error:
            self._failed(error)
        self._relax()

    def _relax(self) -> None:
        self.force = NONE
        try:
            self.device.relax()
        except Exception as error:
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        self.safety.fail(f"the device failed: {_words(error)}")


def _words(error: Exception) -> str:
    return str(error) or type(error).__name__


def _pair(force: Any) -> Pair:
    if len(force) != 2:
        raise ValueError(f"force of {len(force)} numbers must be of 2, in N")
    return float(force[0]), float(force[1])


class InProcessServo:
    """The servo of a virtual device, in this process and in the device's own time.

    What comes of it depends on nothing but what is pushed and what the device does.
    """

    def __init__(self, device: VirtualDevice, limits: SafetyLimits) -> None:
        self.device, self._loop = device, ServoLoop(device, limits)
        self._closed = False

    def push(self, force: Any, held: bool = True) -> None:
        """Ask for a force on the hand.

        Args:
            force: (2,) N.
            held: False for no force, whatever the device says.

        Raises:
            ValueError: not two numbers.
        """
        self._loop.push(*_pair(force), bool(held))

    def advance(self, milliseconds: int, state: "np.ndarray") -> None:
        """Let so much time pass.

        Args:
            milliseconds: as many steps.
            state: (12,) the game as the person sees it, see `tables.observe`.

        Raises:
            ValueError: the servo is closed, or the device refuses the state.
        """
        if self._closed:
            raise ValueError("the servo is closed")
        for _ in range(milliseconds):
            self._loop.step(PERIOD)
            self.device.advance(PERIOD, state)

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center, now; of a device that fails, where it was last."""
        try:
            return self.device.position
        except Exception:  # the next step says so
            return self._loop.position

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's, now."""
        return self.device.velocity

    @property
    def held(self) -> bool:
        """Whether the hand is at the device."""
        return self.device.held

    @property
    def force(self) -> Pair:
        """(2,) N, what really acts on the hand."""
        return self._loop.force

    @property
    def fault(self) -> str | None:
        """Why there is no force, in words; None while there may be one."""
        return "the servo is closed" if self._closed else self._loop.safety.fault

    def rest(self) -> None:
        """Have no force act until the next push, which then starts softly, whatever was before."""
        self._loop.rest()

    def release(self) -> bool:
        """End a fault, if what it was for is over: whether there is none any more."""
        return not self._closed and self._loop.safety.release()

    def close(self) -> None:
        """No force, and let go of the device. Closing twice is closing once."""
        if not self._closed:
            self._closed, self._loop.force = True, NONE
            self.device.close()


@dataclass(frozen=True)
class Timing:
    """How well the servo kept its time.

    Attributes:
        steps: so many periods were measured.
        p50, p99: s, quantiles of the period, to the microsecond.
        longest: s, the longest period.
        late: steps that began more than half a period after their time.
    """

    steps: int
    p50: float
    p99: float
    longest: float
    late: int


class SharedRecord:
    """A record in shared memory that one process writes and others read, never half of one and half of another.

    It carries its checksum, so it needs no lock that somebody who dies could keep, and no order of writes in memory.
    """

    def __init__(self, layout: str, context: Any, *first: Any) -> None:
        self._layout, self._size = layout, struct.calcsize(layout)
        self._raw = context.RawArray("c", self._size + 4)
        self.write(*first)

    def write(self, *values: Any) -> None:
        body = struct.pack(self._layout, *values)
        self._raw.raw = body + zlib.crc32(body).to_bytes(4, "little")

    def read(self) -> tuple | None:
        """The record, or None while it is being written."""
        for _ in range(4):
            raw = self._raw.raw
            body = raw[: self._size]
            if zlib.crc32(body).to_bytes(4, "little") == raw[self._size :]:
                return struct.unpack(self._layout, body)
        return None


ORDERS = "=q2d?2q?"  # how many pushes so far; force; held; how many releases and rests were asked for; stop
REPORT = (
    f"=3q6dd?{FAULT_BYTES}s"  # steps, late ones, releases answered; position, velocity, force; longest; held; fault
)


class ServoProcess:
    """The servo of a real device, at 1 kHz in a process of its own; as `InProcessServo`, but time passes by itself.

    The device is relaxed and closed when the servo is, when it fails, when it is told to end (SIGTERM, SIGINT), and
    when the process that began it is no more. To be used from one thread.

    Args:
        open_device: opens the device in that process, see `DeviceFactory`.
        limits: what the force must keep to.

    Raises:
        DeviceError: the device could not be opened; says why.
    """

    def __init__(self, open_device: DeviceFactory, limits: SafetyLimits) -> None:
        context = multiprocessing.get_context("spawn")
        self._orders = SharedRecord(ORDERS, context, 0, 0.0, 0.0, False, 0, 0, False)
        self._report = SharedRecord(REPORT, context, 0, 0, 0, *[0.0] * 7, False, b"")
        self._periods = context.RawArray("Q", LONGEST + 1)
        self._pushes = self._releases = self._rests = 0
        self._force, self._wanted, self._closed = NONE, False, False
        self._seen, self._seen_at = self._report.read(), monotonic()
        ours, theirs = context.Pipe(duplex=False)
        shared = self._orders, self._report, self._periods, theirs
        self._process = context.Process(target=_serve, args=(open_device, limits, *shared), daemon=True, name="servo")
        with _without_main():
            self._process.start()
        theirs.close()
        atexit.register(self.close)
        try:
            trouble = ours.recv() if ours.poll(OPENING) else f"the device was not open after {OPENING:g} s"
        except EOFError:
            self._process.join(ENDING)
            trouble = f"the servo ended while it opened the device (exit code {self._process.exitcode})"
        if trouble is not None:
            self.close()
            raise DeviceError(trouble)
        self._seen_at = monotonic()

    def push(self, force: Any, held: bool = True) -> None:
        """Ask for a force on the hand, see `InProcessServo.push`."""
        self._force, self._wanted = _pair(force), bool(held)
        self._pushes += 1
        self._write()

    def _write(self, stop: bool = False) -> None:
        self._orders.write(self._pushes, *self._force, self._wanted, self._releases, self._rests, stop)

    def advance(self, milliseconds: int, state: Any) -> None:
        """Nothing: time passes by itself."""

    def _look(self) -> tuple:
        report = self._report.read() or self._seen
        if report[0] != self._seen[0]:
            self._seen_at = monotonic()
        self._seen = report
        return report

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center, at the last step."""
        return self._look()[3:5]

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's, at the last step."""
        return self._look()[5:7]

    @property
    def force(self) -> Pair:
        """(2,) N, what acts on the hand since the last step."""
        return self._look()[7:9]

    @property
    def held(self) -> bool:
        """Whether the hand is at the device."""
        return self._look()[10]

    @property
    def fault(self) -> str | None:
        """Why there is no force, in words; None while there may be one."""
        if self._closed:
            return "the servo is closed"
        fault = self._look()[11].rstrip(b"\0").decode("utf-8", "ignore")
        if not self._process.is_alive():
            return f"the servo has ended (exit code {self._process.exitcode})"
        silent = monotonic() - self._seen_at
        if silent > HANGING:
            return f"the servo hangs: no step for {silent:.2f} s"
        return fault or None

    def rest(self) -> None:
        """Have no force act until the next push, which then starts softly, see `InProcessServo.rest`."""
        self._rests += 1
        self.push(NONE, False)

    def release(self) -> bool:
        """End a fault, if what it was for is over: whether there is none any more."""
        self._releases += 1
        self._write()
        ends = monotonic() + ANSWER
        while self._look()[2] != self._releases and monotonic() < ends and self._process.is_alive():
            sleep(PERIOD)
        return self._seen[2] == self._releases and self.fault is None

    def timing(self) -> Timing:
        """How well time was kept since the device was opened."""
        counts, report = list(accumulate(self._periods)), self._look()
        p50, p99 = (1e-6 * bisect_left(counts, share * counts[-1]) for share in (0.5, 0.99))
        return Timing(counts[-1], p50, p99, longest=report[9], late=report[1])

    def close(self) -> None:
        """No force, let go of the device, and end the process. Closing twice is closing once."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._write(stop=True)
        self._process.join(ENDING)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(ENDING)


@contextmanager
def _without_main() -> Iterator[None]:
    """Have the process that is begun here not import the program that began it: torch and numba take seconds."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(
    open_device: DeviceFactory,
    limits: SafetyLimits,
    orders: SharedRecord,
    report: SharedRecord,
    periods: Any,
    opened: Connection,
) -> None:
    """The process: open the device, keep the loop going, and leave the device without a force whatever happens."""
    stopping: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, frame: stopping.append(signum))
    try:
        if isinstance(open_device, tuple):
            module, name, keywords = open_device
            device = getattr(import_module(module), name)(**keywords)
        else:
            device = open_device()
    except Exception as error:
        opened.send(_words(error))
        return
    try:
        _hurry()
        loop = ServoLoop(device, limits)
        opened.send(None)
        opened.close()
        _run(loop, orders, report, periods, stopping)
    finally:
        for end in (device.relax, device.close):
            with suppress(Exception):
                end()


def _run(loop: ServoLoop, orders: SharedRecord, report: SharedRecord, periods: Any, stopping: list[int]) -> None:
    parent, safety = multiprocessing.parent_process(), loop.safety
    steps = late = pushes = releases = rests = 0
    longest, fault, said = 0.0, None, b""
    due = last = perf_counter()
    while not stopping:
        due += PERIOD
        left = due - perf_counter() - SPIN
        if left > 0:
            sleep(left)
        while (now := perf_counter()) < due:
            pass
        period = now - last
        order = orders.read()
        if order is not None:
            number, x, y, held, asked, resting, stop = order
            if stop:
                break
            if resting != rests:
                rests = resting
                loop.rest()
            if number != pushes:
                pushes = number
                loop.push(x, y, held)
            if asked != releases:
                releases = asked
                safety.release()
        loop.step(period)
        steps, last, longest = steps + 1, now, max(longest, period)
        periods[min(int(period * 1e6 + 0.5), LONGEST)] += 1
        if now - due > LATE:
            late += 1
            due = max(due, now - PERIOD)  # steps that were missed are not made up for
        if safety.fault != fault:
            fault = safety.fault
            said = (fault or "").encode()[:FAULT_BYTES]
        report.write(steps, late, releases, *loop.position, *loop.velocity, *loop.force, longest, loop.held, said)
        if steps % ORPHAN_STEPS == 0 and _orphaned(parent):
            break


def _orphaned(parent: Any) -> bool:
    return os.getppid() != parent.pid  # not by a sentinel, which the parent's other children may keep


def _hurry() -> None:
    """Come first where the system allows it, and be never held up by a collection of garbage."""
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    gc.collect()
    gc.freeze()
    gc.disable()
