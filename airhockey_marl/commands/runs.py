"""List the runs in outputs/: command, settings, status, headline numbers; remove those that failed.

    airhockey runs                        all runs
    airhockey runs command=train          of one command
    airhockey runs status=failed          of one status: running, done, failed, interrupted, unknown
    airhockey runs --clean                remove failed and interrupted runs, after asking

A run is interrupted if it neither ended nor is running: it was killed, or its machine was switched off. --clean keeps
those that can be resumed (`resume=`), and every run that may be worth something: that is running or done, is older than
run.json (unknown), or has others within its folder. Links are not followed.
"""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

from omegaconf import DictConfig

from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.run_record import OVER, STATES, RunRecord, listing, read_run, runs_below


def check(cfg: DictConfig) -> None:
    if not Path(cfg.outputs).is_dir():
        raise InputError(f"outputs = {cfg.outputs} must be a folder")
    if cfg.status is not None and cfg.status not in STATES:
        raise InputError(f"status = {cfg.status} must be one of {', '.join(STATES)}")


def main(cfg: DictConfig) -> None:
    outputs = Path(cfg.outputs)
    all_runs = sorted(runs_below(outputs), key=lambda run: (run.started, run.folder))
    runs = [run for run in all_runs if cfg.command in (None, run.command) and cfg.status in (None, run.state)]
    if not runs or not cfg.clean:
        print(listing(runs, outputs) if runs else f"no such runs in {outputs}")
        return
    removals = [run for run in removable(all_runs) if run in runs]
    if not removals:
        print("nothing to remove")
        return
    print(listing(removals, outputs))
    try:
        answer = input(f"remove these {len(removals)} folders from {outputs}? [y/N] ")
    except EOFError:
        answer = ""
    removed = remove(removals) if answer.strip().lower() in ("y", "yes") else []
    print(f"removed {len(removed)} of {len(removals)}")


def removable(runs: Sequence[RunRecord]) -> list[RunRecord]:
    """The runs that failed or were interrupted, cannot be resumed, and have no other run within their folder."""
    removals = [run for run in runs if run.state in OVER and not run.resumable]
    return [run for run in removals if not any(run.folder in other.folder.parents for other in runs)]


def remove(runs: Iterable[RunRecord]) -> list[RunRecord]:
    """Remove the folders of runs that are still removable now that they are read again; those removed."""
    removed = []
    for run in runs:
        if removable([read_run(run.folder)]) and not run.folder.is_symlink():
            shutil.rmtree(run.folder)  # removes links within it, not what they lead to
            removed.append(run)
    return removed
