"""What run.json says of each run below `outputs/`, and the list of runs.

A run writes it as it begins and as it ends. One that was killed writes nothing any more: that it is over is seen from
its process, on the machine that it ran on.
"""

import json
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import psutil

from airhockey_marl.experiment.config import STATE_FILE
from airhockey_marl.experiment.files import write_json

COLUMNS = ("run", "status", "took", "settings", "")  # of the list
RECORD = "run.json"
OVER = ("failed", "interrupted")
STATES = ("running", "done", "failed", "interrupted", "unknown")
GOES_ON_FROM = (STATE_FILE, "batches")  # what a run leaves that can be resumed


@dataclass(frozen=True)
class RunRecord:
    """What run.json says of a run, and where it lies.

    Attributes:
        folder: of the run.
        command: the name of its yaml.
        overrides: what was set on the command line.
        commands: as they were typed: the one that began it, and those that resumed it.
        status: running, done or failed, as it was written; see `state`.
        host, pid, birth: of its process, see `process_start`.
        started, seconds: Unix time, and how long it took; None while it runs.
        error: why it failed, in one line.
        headline: the numbers that it is known by, see `note_headline`.
    """

    folder: Path
    command: str
    overrides: list[str] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    status: str = "unknown"
    host: str = ""
    pid: int = 0
    birth: str = ""
    started: float = 0.0
    seconds: float | None = None
    error: str = ""
    headline: str = ""

    @property
    def state(self) -> str:
        """One of `STATES`: a run that says it is running is interrupted if its process is gone from this machine.

        On another machine nobody can tell from here, so it is taken at its word.
        """
        gone = self.host == socket.gethostname() and process_start(self.pid) != self.birth
        return "interrupted" if self.status == "running" and gone else self.status

    @property
    def resumable(self) -> bool:
        """Whether it has left something to go on from."""
        return any((self.folder / name).exists() for name in GOES_ON_FROM)

    def write(self) -> None:
        write_json(self.folder / RECORD, {key: value for key, value in asdict(self).items() if key != "folder"})


def process_start(pid: int) -> str:
    """When a process began, in seconds since the boot, which no later process of the same number has; "" if it is gone.

    Not the time of day, which an adjusted clock moves.
    """
    try:
        process = psutil.Process(pid)
        alive = pid > 0 and process.status() != psutil.STATUS_ZOMBIE
        return f"{process.create_time() - psutil.boot_time():.2f}" if alive else ""
    except (psutil.Error, ValueError, OverflowError):
        return ""


def read_run(folder: Path) -> RunRecord:
    """The run of a folder; of unknown state where its run.json is absent or not what `RunRecord.write` writes."""
    try:
        facts: Any = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        run = RunRecord(folder, **facts)
        sound = run.status in STATES and isinstance(run.pid, int) and isinstance(run.overrides, list)
        sound &= isinstance(run.commands, list)
        sound &= isinstance(run.headline, str)
        sound &= isinstance(run.started, int | float) and isinstance(run.seconds, int | float | None)
    except (OSError, ValueError, TypeError):
        sound = False
    return run if sound else RunRecord(folder, "")


def runs_below(outputs: Path) -> list[RunRecord]:
    """Every run below a folder, by its .hydra/ or its run.json; what links lead to is not looked at."""
    runs = []
    for place, folders, files in os.walk(outputs, followlinks=False):
        folder = Path(place)
        if RECORD in files or (".hydra" in folders and (folder / ".hydra" / "config.yaml").is_file()):
            run = read_run(folder)
            runs.append(run if run.command else RunRecord(folder, "?"))
        folders[:] = sorted(name for name in folders if not name.startswith("."))
    return runs


def listing(runs: Sequence[RunRecord], outputs: Path) -> str:
    """A line per run with its headline numbers, or why it failed; what all have in common stands above."""
    one_command = len({run.command for run in runs}) == 1
    shared = set.intersection(*(set(run.overrides) for run in runs)) if len(runs) > 1 and one_command else set()
    rows = [_cells(run, outputs, shared) for run in runs]
    same = [nth for nth in (1, 2, 3) if len(runs) > 1 and len({row[nth] for row in rows}) == 1]
    common = [rows[0][nth] for nth in same if rows[0][nth] != "–"] + [_settings(sorted(shared))]
    lines = [[row[nth] for nth in range(len(COLUMNS)) if nth not in same] for row in (COLUMNS, *rows)]
    widths = [max(len(line[nth]) for line in lines) for nth in range(len(lines[0]) - 1)]
    text = ["  ".join(c.ljust(w) for c, w in zip(line, (*widths, 0), strict=True)).rstrip() for line in lines]
    above = " ".join(filter(None, common))
    return "\n".join([f"all {len(runs)}: {above}"] * bool(above) + text)


def _cells(run: RunRecord, outputs: Path, shared: set[str]) -> tuple[str, ...]:
    state = run.state
    elapsed = time.time() - run.started if state == "running" else run.seconds
    end = f"pid {run.pid} on {run.host}" if state == "running" else run.error or run.headline
    if state in OVER and run.resumable:
        end = f"{end} (resume={run.folder} goes on)".strip()
    settings = _settings([override for override in run.overrides if override not in shared])
    return str(run.folder.relative_to(outputs)), state, _duration(elapsed), settings or "–", end


def _settings(overrides: Sequence[str]) -> str:
    return " ".join(override for override in overrides if not override.startswith("hydra."))


def _duration(seconds: float | None) -> str:
    """A time in s, min or h."""
    if seconds is None:
        return "–"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
