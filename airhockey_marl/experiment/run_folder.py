"""Run folders: the callback of Hydra that writes run.json, what a card says of its origin, and the lock."""

import os
import shutil
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import name_write_errors, remove_temporary_files, write_text
from airhockey_marl.experiment.run_record import RECORD, RunRecord, listing, process_start, read_run, runs_below


class RunRecorder(Callback):
    """Hydra tells it of each job's beginning and end, in the job's own process; it writes run.json.

    A run is refused where it would write over another one's files, before Hydra writes its own.

    A run that goes on with an earlier one (`resume`) speaks for that one's folder as well. A command that keeps nothing
    of what was typed (`hydra.output_subdir: null`, as for a session with a person) is not written down.
    """

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Refuse the folder of a run that there is something to lose of; one that goes on keeps its log elsewhere."""
        if config.hydra.output_subdir is not None:
            _require_free(Path(config.hydra.run.dir), "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Likewise for a sweep's jobs; and make its folder, which stands above a search's database."""
        sweep = Path(config.hydra.sweep.dir)
        for job in sorted(sweep.glob("*")):  # what a job's folder is called is known, if not how many there will be
            if job.name.isdecimal():
                _require_free(job, "hydra.sweep.dir")
        sweep.mkdir(parents=True, exist_ok=True)

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Write that the job is running."""
        if config.hydra.output_subdir is not None:
            _running(RunRecord(Path(config.hydra.runtime.output_dir), config.hydra.job.config_name)).write()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Write how it ended, into the folder of the run that it resumed, too; a run that was refused leaves none."""
        failed = job_return.status == JobStatus.FAILED
        if failed and isinstance(job_return._return_value, InputError) and config.hydra.mode != RunMode.MULTIRUN:
            _remove_unused(Path(config.hydra.runtime.output_dir))
        error = " ".join(str(job_return._return_value).split()) if failed else ""
        for folder in {
            Path(config.hydra.runtime.output_dir),
            Path(config.get("resume") or config.hydra.runtime.output_dir),
        }:
            run = read_run(folder)
            if run.status == "running" and run.pid == os.getpid():
                seconds = round(time.time() - run.started, 1)
                replace(run, status="failed" if failed else "done", error=error, seconds=seconds).write()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Print what the sweep varied, and what came of it."""
        sweep = Path(config.hydra.sweep.dir)
        jobs = sorted((run for run in runs_below(sweep) if run.command != "?"), key=lambda run: run.started)
        if jobs:
            print(f"\nsweep: {sweep}\n{listing(jobs, sweep)}")


def _running(run: RunRecord) -> RunRecord:
    """A run as this process begins or resumes it."""
    pid, typed = os.getpid(), HydraConfig.get().overrides.task
    own = [argument for argument in typed if argument not in run.overrides and not argument.startswith("resume=")]
    return replace(
        run,
        overrides=[*run.overrides, *own],
        commands=[*run.commands, command_line()],
        **{"status": "running", "host": socket.gethostname(), "pid": pid, "birth": process_start(pid)},
        **{"started": time.time(), "seconds": None, "error": ""},
    )


def output_folder(cfg: DictConfig) -> Path:
    """The folder for a command's files: of the run that it resumes, the one that its key `out` names, or its own."""
    return Path(cfg.get("resume") or cfg.get("out") or HydraConfig.get().runtime.output_dir)


def command_line() -> str:
    """The running command as it was typed."""
    job = HydraConfig.get()
    return " ".join(["airhockey", job.job.config_name, *job.overrides.task])


def command_history(cfg: DictConfig) -> dict[str, Any]:
    """The command that began the run, and those that resumed it, if any."""
    first, *others = read_run(output_folder(cfg)).commands or [command_line()]
    return {"command": first} | ({"resumed_by": others} if others else {})


def card_facts(cfg: DictConfig, seconds: float) -> dict[str, Any]:
    """What the card of every result says of its origin."""
    facts = {**command_history(cfg), "date": time.strftime("%Y-%m-%d"), "seed": cfg.seed}
    return facts | {"seconds": round(seconds, 1), "config": OmegaConf.to_container(cfg)}


def note_headline(folder: Path, headline: str) -> None:
    """Print the numbers that a job is known by, in a few words, and write them into its run.json, if it has one."""
    print(headline)
    run = read_run(folder)
    if run.command:
        replace(run, headline=headline).write()


def files_at_risk(folder: Path) -> str | None:
    """What a run would write over in this folder, in words; None if there is nothing to lose.

    A run that failed or was interrupted before it could be resumed has left nothing that anybody could use; and one of
    which there is only a log, as where it went on with another, nothing at all.
    """
    run = read_run(folder)
    if run.resumable:
        return f"a run that can be gone on with: resume={folder}"
    if run.state == "running":
        return "a run that is running"
    if run.state in ("failed", "interrupted") or not (folder / ".hydra").is_dir():
        return None
    names = [path.name for path in folder.iterdir() if not path.name.startswith(".") and path.suffix != ".log"]
    names = sorted({*names} - {RECORD})
    return f"a run that has left {', '.join(names[:3])}" if names else None


def _remove_unused(folder: Path) -> None:
    """Remove the folder of a run that has written nothing, and those of its day if there are no others in them."""
    if {path.name for path in folder.iterdir() if path.suffix != ".log"} <= {".hydra", RECORD}:
        shutil.rmtree(folder, ignore_errors=True)
        for parent in folder.parents[:2]:
            with suppress(OSError):
                parent.rmdir()


def _require_free(folder: Path, key: str) -> None:
    """Refuse a folder by the one exception that Hydra lets a callback raise; `command.run` prints it in one line."""
    if lost := files_at_risk(folder):
        sys.exit(f"{key}: {folder} holds {lost}; a run must have a folder of its own")


def acquire_lock(folder: Path, name: str) -> FileLock:
    """Lock an existing folder for this process, until the lock is released or the process ends.

    A ValueError, with `name` for the folder, says which other process holds the lock.
    """
    lock = FileLock(folder / ".lock", timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        pid = "unknown"
        with suppress(OSError):
            pid = (folder / ".lock").read_text(encoding="ascii").strip() or pid
        raise ValueError(f"{name} = {folder} is in use by process {pid}; one at a time can have it") from None
    with suppress(OSError):  # on a full disk, or on Windows, the lock holds without the number
        Path(lock.lock_file).write_text(f"{os.getpid()}\n", encoding="ascii")
    return lock


@contextmanager
def lock_run_folder(cfg: DictConfig) -> Iterator[Path]:
    """Hold the lock of a command's folder, remove what a killed process has left half written, yield the folder.

    If it is that of an earlier run, its run.json says from now on that it runs, and its configuration is the resumed
    one.
    """
    folder = output_folder(cfg)
    with report_input_errors(), name_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = acquire_lock(folder, "run")
    try:
        remove_temporary_files(folder)
        if cfg.get("resume"):
            write_text(folder / ".hydra" / "config.yaml", OmegaConf.to_yaml(OmegaConf.merge(cfg, {"resume": None})))
            earlier = read_run(folder)
            _running(replace(earlier, command=earlier.command or HydraConfig.get().job.config_name)).write()
        yield folder
    finally:
        lock.release()
