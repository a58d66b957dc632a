"""A command that is killed again and again, and gone on with: in one process that has imported it, which forks.

    python -m tests.robustness.kill_and_resume <module> <kills> <seed> <folder> <state> <argument>...

Every life of the command is a fork, hence begins at once. The first, in <folder>/whole, is left alone; the others, in
<folder>/killed, end with SIGKILL at a random moment, whatever the command does then, the last one by itself. Printed is
how many were killed, and how many went on with what another had begun.
"""

import math
import os
import random
import shutil
import signal
import sys
import time
from importlib import import_module
from pathlib import Path


def life(main, arguments: list[str], log: Path) -> int:
    """Begin the command in a fork."""
    pid = os.fork()
    if pid == 0:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.argv = ["command", *arguments]
        status = 1
        try:
            main()
            status = 0
        except SystemExit as stopped:
            status = stopped.code or 0
        finally:
            sys.stdout.flush()
            os._exit(status)
    return pid


def status_within(pid: int, seconds: float) -> int | None:
    """How a life has ended in so many seconds; None if it goes on."""
    until = time.monotonic() + seconds
    while (ended := os.waitpid(pid, os.WNOHANG)) == (0, 0):
        if time.monotonic() > until:
            return None
        time.sleep(0.002)
    return os.waitstatus_to_exitcode(ended[1])


def begun(state: Path) -> bool:
    return state.is_file() and (state.parent / ".hydra" / "config.yaml").is_file()


def main(module: str, kills: int, seed: int, folder: Path, state: str, arguments: list[str]) -> None:
    command, rng, log = import_module(module).main, random.Random(seed), folder / "log"
    folder.mkdir(parents=True)
    started = time.monotonic()
    pid, first = life(command, [*arguments, f"hydra.run.dir={folder}/whole"], log), None
    while status_within(pid, 0.0) is None:
        time.sleep(0.002)
        if first is None and begun(folder / "whole" / state):
            first = time.monotonic() - started
    rest = time.monotonic() - started - first
    killed = resumed = 0
    while True:
        going_on = begun(folder / "killed" / state)
        again = [f"resume={folder}/killed", f"hydra.run.dir={folder}/again"]
        pid = life(command, again if going_on else [*arguments, f"hydra.run.dir={folder}/killed"], log)
        # about where the first state is written, and after it
        patience = rng.uniform(0.5 * first, 1.7 * first + rest / kills) if killed < kills else math.inf
        status = status_within(pid, patience)
        if status is None:
            os.kill(pid, signal.SIGKILL)
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        resumed += going_on
        if status == 0 and killed == kills:
            break
        if status == 0:  # done before it could be killed, as where the first life had to compile: anew, and sooner
            shutil.rmtree(folder / "killed")
            first, rest = 0.7 * first, 0.7 * rest
            continue
        if status != -signal.SIGKILL:
            sys.exit(f"a life ended with {status}: {log.read_text()[-2000:]}")
        killed += 1
    print(f"{killed} {resumed}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), sys.argv[5], sys.argv[6:])
