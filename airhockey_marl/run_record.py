"""What is known of the runs below `outputs/`: each writes run.json into its folder as it begins and as it ends.

A run that was killed writes nothing any more. That it is over is seen from its process, on the machine that it ran on.
"""

import json
import os
import socket
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.files import write_json

RECORD = "run.json"
STATES = ("running", "done", "failed", "interrupted", "unknown")
GOES_ON_FROM = ("state.safetensors", "batches")  # what a run leaves that can be resumed


@dataclass(frozen=True)
class Run:
    """What run.json says of a run, and where it lies.

    Attributes:
        folder: of the run.
        command: the name of its yaml.
        overrides: what was set on the command line.
        status: running, done or failed, as it was written; see `state`.
        host, pid, birth: of its process, see `birth_of`.
        started, seconds: Unix time, and how long it took; None while it runs.
        error: why it failed, in one line.
    """

    folder: Path
    command: str
    overrides: list[str] = field(default_factory=list)
    status: str = "unknown"
    host: str = ""
    pid: int = 0
    birth: str = ""
    started: float = 0.0
    seconds: float | None = None
    error: str = ""

    @property
    def state(self) -> str:
        """One of `STATES`: a run that says it is running is interrupted if its process is gone from this machine.

        On another machine nobody can tell from here, so it is taken at its word.
        """
        gone = self.host == socket.gethostname() and birth_of(self.pid) != self.birth
        return "interrupted" if self.status == "running" and gone else self.status

    @property
    def resumable(self) -> bool:
        """Whether it has left something to go on from."""
        return any((self.folder / name).exists() for name in GOES_ON_FROM)

    def write(self) -> None:
        """Write run.json, whole."""
        write_json(self.folder / RECORD, {key: value for key, value in asdict(self).items() if key != "folder"})


def birth_of(pid: int) -> str:
    """When a process began, in a form that no later process of the same number has; "" if there is none.

    Where the system does not tell (there is no /proc), all living processes are born "alive".
    """
    if pid <= 0:
        return ""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return ""
    except PermissionError:
        pass  # somebody else's, but there
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except FileNotFoundError:
        return "" if Path("/proc/self/stat").exists() else "alive"
    return "" if fields[0] == "Z" else f"{boot} {fields[19]}"  # clock ticks from the boot to its start


def read_run(folder: Path) -> Run:
    """The run of a folder; of unknown state where its run.json is absent or not what `Run.write` writes."""
    try:
        facts: Any = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        run = Run(folder, **facts)
        sound = run.status in STATES and isinstance(run.pid, int) and isinstance(run.overrides, list)
        sound &= isinstance(run.started, int | float) and isinstance(run.seconds, int | float | None)
    except (OSError, ValueError, TypeError):
        sound = False
    return run if sound else Run(folder, "")


def runs_below(outputs: Path) -> list[Run]:
    """Every run below a folder, by its .hydra/ or its run.json; what links lead to is not looked at."""
    found = []
    for place, folders, files in os.walk(outputs, followlinks=False):
        folder = Path(place)
        if RECORD in files or (".hydra" in folders and (folder / ".hydra" / "config.yaml").is_file()):
            run = read_run(folder)
            found.append(run if run.command else Run(folder, _command_of(folder)))
        folders[:] = sorted(name for name in folders if not name.startswith("."))
    return found


def _command_of(folder: Path) -> str:
    """What Hydra wrote down of a run that is older than run.json."""
    try:
        return str(OmegaConf.select(OmegaConf.load(folder / ".hydra" / "hydra.yaml"), "hydra.job.config_name") or "?")
    except (OSError, ValueError):
        return "?"


class Record(Callback):
    """Hydra tells it of each job's beginning and end, in the job's own process; it writes run.json.

    A run that goes on with an earlier one (`resume`) speaks for that one's folder as well. A command that keeps nothing
    of what was typed (`hydra.output_subdir: null`, as for a session with a person) is not written down.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Make the sweep's folder, which stands above a search's database, before anybody writes there."""
        Path(config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Write that the job is running."""
        pid = os.getpid()
        place = {"host": socket.gethostname(), "pid": pid, "birth": birth_of(pid)}
        job = config.hydra.job.config_name, list(config.hydra.overrides.task)
        folders = _folders(config) if config.hydra.output_subdir is not None else []
        self._runs = [Run(folder, *job, "running", **place, started=time.time()) for folder in folders]
        for run in self._runs:
            run.write()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Write how it ended."""
        failed = job_return.status == JobStatus.FAILED
        error = " ".join(str(job_return._return_value).split()) if failed else ""
        end = {"status": "failed" if failed else "done", "error": error}
        for run in self._runs:
            Run(**vars(run) | end | {"seconds": round(time.time() - run.started, 1)}).write()


def _folders(config: DictConfig) -> list[Path]:
    own, resumed = Path(config.hydra.runtime.output_dir), config.get("resume")
    is_run = isinstance(resumed, str) and (Path(resumed) / ".hydra" / "config.yaml").is_file()
    return [own, Path(resumed)] if is_run else [own]
