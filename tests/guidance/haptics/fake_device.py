"""A device that another process can open: it logs its calls, a line each, and fails on request."""

import os
import sys
import time
from pathlib import Path


class Refused(OSError):
    """An error of the device."""


class Still:
    """A hand that keeps still at the center."""

    position = velocity = (0.0, 0.0)
    is_held = True

    def set_force(self, force):
        pass

    def relax(self):
        pass

    def close(self):
        pass


class Timed(Still):
    """Writes the times of its steps, a line each, to `path` when it is closed."""

    def __init__(self, path):
        self._path, self._times = path, []

    @property
    def position(self):
        self._times.append(time.perf_counter())
        return (0.0, 0.0)

    def close(self):
        Path(self._path).write_text("\n".join(map(repr, self._times)))


class Logged(Still):
    """Writes each call to `path` at once, so that a process that is killed has written it.

    Args:
        refuse: do not open, with these words.
        fails_at: this call of `set_force`, and the hundred after it, fail.
        ends_at: at this call of `set_force` the process is gone without a word.
        hangs_at: this call of `set_force` takes a second.
        far: the hand is out of the workspace while this file exists.
    """

    def __init__(self, path, refuse=None, fails_at=None, ends_at=None, hangs_at=None, far=None):
        if refuse is not None:
            raise Refused(refuse)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._calls, self._fails_at, self._ends_at, self._hangs_at = 0, fails_at, ends_at, hangs_at
        self._far = far and Path(far)
        heavy = sorted({"numba", "torch", "numpy", "pygame"} & set(sys.modules))
        self._write("open", os.getpid(), *heavy)

    def _write(self, *words):
        os.write(self._file, (" ".join(map(str, words)) + "\n").encode())

    @property
    def position(self):
        return (1.0, 0.0) if self._far and self._far.exists() else (0.01, -0.02)

    @property
    def velocity(self):
        return (0.3, 0.4)

    def set_force(self, force):
        self._calls += 1
        if self._calls == self._ends_at:
            os._exit(3)
        if self._calls == self._hangs_at:
            time.sleep(1.0)
        if self._fails_at and self._fails_at <= self._calls <= self._fails_at + 100:
            self._write("failed", *force)
            raise Refused("no answer from the motor")
        self._write("force", *map(repr, force))

    def relax(self):
        self._write("relax")

    def close(self):
        self._write("close")
