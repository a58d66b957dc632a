"""One process at a time writes into a folder: its lock goes with the process, however that ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from airhockey_marl.cli import input_errors
from airhockey_marl.files import clear, saying

try:
    import fcntl
except ImportError:  # not a POSIX system: there, nobody is kept out
    fcntl = None


def take(folder: Path, name: str) -> int:
    """The handle of a folder's lock, which this process now holds; to close it gives the folder free.

    Args:
        folder: it must exist.
        name: of the folder, for the person whom it is refused to.

    Raises:
        ValueError: another process has it; says which.
        OSError: the folder cannot be written to.
    """
    handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(handle, 32, 0).decode("ascii", "replace").strip()
        os.close(handle)
        raise ValueError(
            f"{name} = {folder} is in use by process {holder or 'unknown'}; one at a time can have it"
        ) from None
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode("ascii"))
    except OSError:  # the disk is full: the lock holds, and the number is a courtesy
        pass
    return handle


@contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Have a run folder for oneself, without what a killed process has left in it half written.

    Raises:
        InputError: another process has it.
        OSError: it cannot be written to; the message names it.
    """
    with input_errors(), saying(folder):
        folder.mkdir(parents=True, exist_ok=True)
        handle = take(folder, name)
    try:
        clear(folder)
        yield
    finally:
        os.close(handle)
