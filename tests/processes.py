"""Commands in processes of their own, as `python -m` runs them, without importing torch and the rest for each.

A server imports the libraries once and forks for each command: the fork has its own arguments, folder, environment,
standard output and exit code, and may be killed at any moment. It saves about seven seconds of imports per command.
"""

import atexit
import os
import runpy
import sys
import warnings
from collections.abc import Callable
from multiprocessing import forkserver, get_context
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory
from unittest.mock import patch

from tests import ROOT

# What commands import in the end; a module that is missing only costs time.
PRELOAD = [
    *("torch", "torchrl.collectors", "torchrl.objectives", "torch._dynamo", "torch.utils.tensorboard"),
    *("pandas", "pingouin", "scipy.stats", "sklearn.linear_model", "matplotlib.pyplot", "pyarrow.parquet"),
    *("numba", "PIL.Image", "jinja2", "hydra", "tests.processes", "airhockey_marl.train", "guidance.evaluate"),
]
CONTEXT = get_context("forkserver")


class Command:
    """`python -m module arguments`, started in a process, after a call of `before` there."""

    def __init__(
        self,
        module: str,
        *arguments: object,
        cwd: Path = ROOT,
        env: dict[str, str] | None = None,
        before: Callable[[], None] | None = None,
    ) -> None:
        self.args = [module, *map(str, arguments)]
        self._folder = TemporaryDirectory()
        written = [Path(self._folder.name) / name for name in ("stdout", "stderr")]
        for file in written:
            file.touch()
        self.stdout, self.stderr = written
        CONTEXT.set_forkserver_preload(PRELOAD)
        with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, (str(ROOT), os.getenv("PYTHONPATH"))))):
            forkserver.ensure_running()
        options = (self.args, str(cwd), dict(os.environ) | (env or {}), before, *map(str, written))
        self.process = CONTEXT.Process(target=_run, args=options)
        self.process.start()
        self.pid = self.process.pid

    def poll(self) -> int | None:
        """Exit code, negative for a signal; None while the process runs."""
        return self.process.exitcode

    def kill(self) -> int:
        """Send SIGKILL and return the exit code, which is another one where the process had ended before."""
        self.process.kill()
        self.process.join()
        return self.process.exitcode

    def wait(self, timeout: float = 300.0) -> CompletedProcess:
        self.process.join(timeout)
        if self.poll() is None:
            self.kill()
            raise TimeoutError(f"{self.args} did not end within {timeout} s: {self.stderr.read_text()[-2000:]}")
        return CompletedProcess(self.args, self.poll(), self.stdout.read_text(), self.stderr.read_text())


def start(module: str, *arguments: object, timeout: float = 300.0, **options) -> CompletedProcess:
    """Run `python -m module arguments` to its end: exit code, standard output and standard error."""
    return Command(module, *arguments, **options).wait(timeout)


def smoke(module: str, *arguments: object, **options) -> CompletedProcess:
    """The same with the budgets of the preset `smoke`; it must succeed."""
    done = start(module, *arguments, "+preset=smoke", **options)
    assert done.returncode == 0, done.stderr
    return done


def _run(
    args: list[str], cwd: str, env: dict[str, str], before: Callable[[], None] | None, stdout: str, stderr: str
) -> None:
    for descriptor, path in ((1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), descriptor)
    os.environ.clear()
    os.environ.update(env)
    os.chdir(cwd)
    if before is not None:
        before()
    sys.argv = args
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")  # the server has imported the module
    try:
        runpy.run_module(args[0], run_name="__main__", alter_sys=True)
    finally:
        atexit._run_exitfuncs()  # a fork leaves them out
