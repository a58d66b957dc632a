"""List the runs in outputs/: command, settings, status, headline numbers; remove those that failed.

    airhockey runs                        all runs
    airhockey runs command=train          of one command
    airhockey runs status=failed          of one status: running, done, failed, interrupted, unknown
    airhockey runs --clean                remove failed and interrupted runs, after asking

A run is interrupted if it neither ended nor is running: it was killed, or its machine was switched off. One that can
be gone on with (`resume=`) is kept by --clean; so is whatever it cannot be sure of: runs that are on, are done, are
older than run.json (unknown), or have others within their folder. Links are not followed.
"""

import json
import shutil
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from airhockey_marl.experiment.command import InputError, command
from airhockey_marl.experiment.run_folder import STATES, RunRecord, read_run, runs_below
from guidance.statistics.groups import UNTESTED
from guidance.statistics.paper import compare_with_paper

OVER = ("failed", "interrupted")
# per command, the numbers of its card.json that are shown, and what they are called
HEADLINES = {
    "train": {"win_rate_of_last_against.0": "beats generation 0", "win_rate_of_last_against.striker": "striker"},
    "meta_train": {"on_nine_others.after_ua_loss": "loss after UA", "on_nine_others.after_ua_rmse": "error"},
}


def headline(run: RunRecord) -> str:
    """What came of a run that is done, in a few words; "" where nothing is known of it."""
    try:
        if run.command == "evaluate":
            return _replicated(run.folder)
        if run.command == "replicate":
            studies = pd.read_csv(run.folder / "studies.csv")
            own = studies.loc[studies["group"] == "replicates", "replicated"]
            return f"{own.mean():.1f} of 38 findings over {len(own)} studies, {len(studies) - len(own)} others"
        card = json.loads((run.folder / "card.json").read_text(encoding="utf-8"))
        return ", ".join(f"{name} {_at(card, key):.3g}" for key, name in HEADLINES.get(run.command, {}).items())
    except (OSError, ValueError, KeyError, TypeError):  # a file is absent or another program's
        return ""


def _replicated(folder: Path) -> str:
    """How many of the paper's findings replicate, of those that the run could test."""
    withdrawn = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["config"]["users"]["withdrawn"]
    outcomes = compare_with_paper(pd.read_csv(folder / "tests.csv"), withdrawn)
    outcomes = outcomes.loc[outcomes["paper"] == "significant", "outcome"]
    tested = (~outcomes.isin(UNTESTED)).sum()
    return f"{(outcomes == 'replicated').sum()} of {tested} tested findings" if tested else ""


def _at(tree: Mapping[str, Any], dotted: str) -> float:
    for key in dotted.split("."):
        tree = tree[key]
    return float(tree)


def listing(runs: Sequence[RunRecord], outputs: Path) -> str:
    """The runs as aligned text, oldest first, each with what came of it, or why it failed."""
    rows = [("run", "status", "took", "settings", "")]
    for run in runs:
        state = run.state
        elapsed = time.time() - run.started if state == "running" else run.seconds
        settings = " ".join(o for o in run.overrides if not o.startswith("hydra."))
        end = f"pid {run.pid} on {run.host}" if state == "running" else run.error or headline(run)
        if state in OVER and run.resumable:
            end = f"{end} (resume={run.folder} goes on)".strip()
        place = str(run.folder.relative_to(outputs))
        rows.append((place, state, _time(elapsed), settings or "–", end))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, (*widths, 0), strict=True)).rstrip() for row in rows]
    return "\n".join(lines)


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )


def removable(runs: Sequence[RunRecord]) -> list[RunRecord]:
    """Those that failed or were interrupted, cannot be gone on with, and have no other run within their folder."""
    lost = [run for run in runs if run.state in OVER and not run.resumable]
    return [run for run in lost if not any(run.folder in other.folder.parents for other in runs)]


def remove(runs: Iterable[RunRecord]) -> list[RunRecord]:
    """Remove the folders of runs, but for those that have been taken up again since they were read; which it were."""
    removed = []
    for run in runs:
        if removable([read_run(run.folder)]) and not run.folder.is_symlink():
            shutil.rmtree(run.folder)  # removes links within it, not what they lead to
            removed.append(run)
    return removed


@command("runs")
def list_runs(cfg: DictConfig) -> None:
    outputs = Path(cfg.outputs)
    if not outputs.is_dir():
        raise InputError(f"outputs = {cfg.outputs} must be a folder")
    if cfg.status is not None and cfg.status not in STATES:
        raise InputError(f"status = {cfg.status} must be one of {', '.join(STATES)}")
    if not isinstance(cfg.clean, bool):
        raise InputError(f"clean = {cfg.clean} must be true or false")
    everything = sorted(runs_below(outputs), key=lambda run: (run.started, run.folder))
    runs = [run for run in everything if cfg.command in (None, run.command) and cfg.status in (None, run.state)]
    if not runs:
        print(f"no such runs in {outputs}")
        return
    if not cfg.clean:
        print(listing(runs, outputs))
        return
    lost = [run for run in removable(everything) if run in runs]
    if not lost:
        print("nothing to remove")
        return
    print(listing(lost, outputs))
    try:
        answer = input(f"remove these {len(lost)} folders from {outputs}? [y/N] ")
    except EOFError:
        answer = ""
    removed = remove(lost) if answer.strip().lower() in ("y", "yes") else []
    print(f"removed {len(removed)} of {len(lost)}")


def main() -> None:
    """The command, with --clean for clean=true."""
    sys.argv = ["clean=true" if argument == "--clean" else argument for argument in sys.argv]
    list_runs()


if __name__ == "__main__":
    main()
