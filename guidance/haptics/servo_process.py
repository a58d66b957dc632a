"""The servo of a real device, at 1 kHz in a process of its own.

The process knows nothing of the game: it drops the force by itself when requests stop.
"""

import atexit
import gc
import multiprocessing
import os
import signal
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from time import monotonic, perf_counter, sleep
from typing import Any, NamedTuple

from guidance.haptics.devices import Device, DeviceError, Pair
from guidance.haptics.hand import CLOSED, HapticHand
from guidance.haptics.safety import NO_FORCE, SafetyLimits
from guidance.haptics.servo import PERIOD, ServoLoop, message_of
from guidance.haptics.shared_record import SharedRecord

SPIN = 0.0002  # s before its due time in which a step polls the clock instead of sleeping
ORPHAN_STEPS = 20  # steps between two checks whether the parent is alive
PRIORITY, NICENESS = 20, -15  # where the system allows them
OPEN_TIMEOUT, RELEASE_TIMEOUT, END_TIMEOUT = 30.0, 0.25, 2.0  # s
HANG_TIMEOUT = 0.25  # s without a step
FAULT_BYTES = 300

DeviceFactory = Callable[[], Device] | tuple[str, str, Mapping[str, Any]]
"""Opens a device in another process: a picklable callable, or a module, a name in it and keyword arguments."""


class Request(NamedTuple):
    """What the servo process is asked to do; the counters tell a repeated request from a new one."""

    pushes: int = 0
    x: float = 0.0
    y: float = 0.0
    is_held: bool = False
    releases: int = 0
    rests: int = 0
    stop: bool = False


class Report(NamedTuple):
    """What the servo process reports after each step."""

    steps: int = 0
    releases: int = 0  # the last release that was answered
    x: float = 0.0
    y: float = 0.0
    velocity_x: float = 0.0
    velocity_y: float = 0.0
    force_x: float = 0.0
    force_y: float = 0.0
    is_held: bool = False
    fault: bytes = b""


REQUEST_LAYOUT = "=q2d?2q?"
REPORT_LAYOUT = f"=2q6d?{FAULT_BYTES}s"


class ServoProcess(HapticHand):
    """Runs the servo of a real device in its own process, in real time.

    The process relaxes and closes the device when the servo is closed, when it fails, on SIGTERM and SIGINT, and when
    its parent process is gone. Use it from one thread only.

    Args:
        open_device: opens the device in that process, see `DeviceFactory`.
        limits: of the force.

    Raises:
        DeviceError: the device could not be opened; with the reason.
    """

    def __init__(self, open_device: DeviceFactory, limits: SafetyLimits) -> None:
        context = multiprocessing.get_context("spawn")
        self._requests = SharedRecord(REQUEST_LAYOUT, context, *Request())
        self._reports = SharedRecord(REPORT_LAYOUT, context, *Report())
        self._request, self._report, self._report_time = Request(), Report(), monotonic()
        self._is_closed = False
        ours, theirs = context.Pipe(duplex=False)
        arguments = open_device, limits, self._requests, self._reports, theirs
        self._process = context.Process(target=_serve, args=arguments, daemon=True, name="servo")
        with _without_main():
            self._process.start()
        theirs.close()
        atexit.register(self.close)
        try:
            error = ours.recv() if ours.poll(OPEN_TIMEOUT) else f"the device was not open after {OPEN_TIMEOUT:g} s"
        except EOFError:
            self._process.join(END_TIMEOUT)
            error = f"the servo ended while it opened the device (exit code {self._process.exitcode})"
        if error is not None:
            self.close()
            raise DeviceError(error)
        self._report_time = monotonic()

    def _send(self, **changes: Any) -> None:
        self._request = self._request._replace(**changes)
        self._requests.write(*self._request)

    def _read(self) -> Report:
        values = self._reports.read()
        report = self._report if values is None else Report(*values)
        if report.steps != self._report.steps:
            self._report_time = monotonic()
        self._report = report
        return report

    def advance(self, milliseconds: int, state: Any) -> None:
        """Nothing: time passes by itself."""

    @property
    def position(self) -> Pair:
        report = self._read()
        return report.x, report.y

    @property
    def velocity(self) -> Pair:
        report = self._read()
        return report.velocity_x, report.velocity_y

    @property
    def force(self) -> Pair:
        report = self._read()
        return report.force_x, report.force_y

    @property
    def is_held(self) -> bool:
        return self._read().is_held

    @property
    def steps(self) -> int:
        """Number of steps of the servo so far."""
        return self._read().steps

    @property
    def fault(self) -> str | None:
        if self._is_closed:
            return CLOSED
        fault = self._read().fault.rstrip(b"\0").decode("utf-8", "ignore")
        if not self._process.is_alive():
            return f"the servo has ended (exit code {self._process.exitcode})"
        silence = monotonic() - self._report_time
        if silence > HANG_TIMEOUT:
            return f"the servo hangs: no step for {silence:.2f} s"
        return fault or None

    def push(self, force: Sequence[float], is_held: bool = True) -> None:
        self._send(pushes=self._request.pushes + 1, x=force[0], y=force[1], is_held=is_held)

    def rest(self) -> None:
        self._request = self._request._replace(rests=self._request.rests + 1)
        self.push(NO_FORCE, False)  # replaces a request that the process may not have read yet

    def release(self) -> bool:
        self._send(releases=self._request.releases + 1)
        end = monotonic() + RELEASE_TIMEOUT
        while self._read().releases != self._request.releases and monotonic() < end and self._process.is_alive():
            sleep(PERIOD)
        return self._report.releases == self._request.releases and self.fault is None

    def close(self) -> None:
        if self._is_closed:
            return
        self._is_closed = True
        atexit.unregister(self.close)
        self._send(stop=True)
        self._process.join(END_TIMEOUT)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(END_TIMEOUT)


@contextmanager
def _without_main() -> Iterator[None]:
    """Keep a process started here from importing the main program, whose torch and numba take seconds."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(
    open_device: DeviceFactory, limits: SafetyLimits, requests: SharedRecord, reports: SharedRecord, opened: Connection
) -> None:
    """Main function of the process: open the device, run the loop, and always leave the device without a force."""
    signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, frame: signals.append(signum))
    try:
        if isinstance(open_device, tuple):
            module, name, kwargs = open_device
            device = getattr(import_module(module), name)(**kwargs)
        else:
            device = open_device()
    except Exception as error:
        opened.send(message_of(error))
        return
    try:
        _raise_priority()
        loop = ServoLoop(device, limits)
        opened.send(None)
        opened.close()
        _run(loop, requests, reports, signals)
    finally:
        for end in (device.relax, device.close):
            with suppress(Exception):
                end()


def _run(loop: ServoLoop, requests: SharedRecord, reports: SharedRecord, signals: list[int]) -> None:
    parent, last_request = multiprocessing.parent_process(), Request()
    steps, fault, fault_bytes = 0, None, b""
    due = last = perf_counter()
    while not signals:
        due += PERIOD
        remaining = due - perf_counter() - SPIN
        if remaining > 0:
            sleep(remaining)
        while (now := perf_counter()) < due:
            pass
        values = requests.read()
        if values is not None:
            request = Request(*values)
            if request.stop:
                break
            _apply(request, last_request, loop)
            last_request = request
        loop.step(now - last)
        steps, last = steps + 1, now
        due = max(due, now - PERIOD)  # missed steps are skipped
        if loop.safety.fault != fault:
            fault = loop.safety.fault
            fault_bytes = (fault or "").encode()[:FAULT_BYTES]
        hand = *loop.position, *loop.velocity, *loop.force
        reports.write(steps, last_request.releases, *hand, loop.is_held, fault_bytes)
        # not by the parent's sentinel, which its other children may keep open
        if steps % ORPHAN_STEPS == 0 and os.getppid() != parent.pid:
            break


def _apply(request: Request, last: Request, loop: ServoLoop) -> None:
    """Apply what is new in a request; a rest first, because the pushes that come with it were made after it."""
    if request.rests != last.rests:
        loop.rest()
    if request.pushes != last.pushes:
        loop.push(request.x, request.y, request.is_held)
    if request.releases != last.releases:
        loop.safety.release()


def _raise_priority() -> None:
    """Raise the scheduling priority where the system allows it, and never pause for garbage collection."""
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    gc.collect()
    gc.freeze()
    gc.disable()
