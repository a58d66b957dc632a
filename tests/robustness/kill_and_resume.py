"""Kill a command at random moments, resume it each time, and compare the end with a run that was left alone."""

import math
import random
import shutil
import signal
import time
from pathlib import Path

from tests.processes import Command


def resumable(state: Path) -> bool:
    return state.is_file() and (state.parent / ".hydra" / "config.yaml").is_file()


def exit_code(command: Command, seconds: float) -> int | None:
    """Exit code of a command that ends within so many seconds, else None."""
    command.process.join(None if seconds == math.inf else seconds)
    return command.poll()


def kill_and_resume(name: str, state: str, arguments: list[str], kills: int, seed: int, folder: Path) -> int:
    """Run a command undisturbed in <folder>/whole, and with `kills` times SIGKILL in <folder>/killed.

    Args:
        name: of the command.
        state: file in the run folder from which `resume` goes on.
        arguments: of the command, without its run folder.

    Returns:
        How many of the processes resumed what another had begun.

    Raises:
        RuntimeError: a process ended by itself with an error.
    """
    rng, started = random.Random(seed), time.monotonic()
    whole, first = Command("airhockey_marl", name, *arguments, f"hydra.run.dir={folder}/whole"), math.inf
    while exit_code(whole, 0.002) is None:
        if first == math.inf and resumable(folder / "whole" / state):
            first = time.monotonic() - started
    if (done := whole.wait()).returncode:
        raise RuntimeError(f"{name} ended with {done.returncode}: {done.stderr[-2000:]}")
    rest = time.monotonic() - started - first  # after the first state was written
    killed = resumed = 0
    while True:
        resumes = resumable(folder / "killed" / state)
        new, again = [*arguments, f"hydra.run.dir={folder}/killed"], [f"hydra.run.dir={folder}/again"]
        command = Command("airhockey_marl", name, *([f"resume={folder}/killed", *again] if resumes else new))
        # about where the first state is written, and after it
        seconds = rng.uniform(0.5 * first, 1.7 * first + rest / kills) if killed < kills else math.inf
        status = exit_code(command, seconds)
        if status is None:
            status = command.kill()
        resumed += resumes
        if status == 0 and killed == kills:
            return resumed
        if status == 0:  # too fast to be killed, as where the first run had to compile: anew, and sooner
            shutil.rmtree(folder / "killed")
            first, rest = 0.7 * first, 0.7 * rest
        elif status == -signal.SIGKILL:
            killed += 1
        else:
            raise RuntimeError(f"{name} ended with {status}: {command.stderr.read_text()[-2000:]}")
