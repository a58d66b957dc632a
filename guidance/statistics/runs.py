"""The trials and manifests of runs, read from their folders."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from airhockey_marl.experiment.files import find_files, sha256
from guidance.statistics.design import METRICS
from guidance.statistics.groups import Group, of_people
from guidance.statistics.tests import check_trials

TRIALS = "trials.csv"
FORMULA = "=+-@"  # first characters of a spreadsheet formula


def gather(places: Iterable[str | Path], mixed: bool = False) -> Group:
    """The group of the trials at or below these places, with their manifests and the hashes of their files."""
    files = find_files(places, TRIALS)
    manifests = {str(file.parent): _manifest(file) for file in files}
    manifest = next(iter(manifests.values())) if len(files) == 1 else {"runs": manifests}
    if len({run.get("study_hash") for run in manifests.values()}) > 1:
        manifest |= {"frozen": False}  # at most one of several studies is the frozen one
    group = Group(merge(files, mixed), manifest | {"trials_sha256": {str(file): sha256(file) for file in files}})
    check_trials(group.trials, group.people)
    return group


def merge(folders: Iterable[str | Path], mixed: bool = False) -> pd.DataFrame:
    """Concatenate every trials.csv at or below the given files, folders or glob patterns.

    Simulated people of different seeds or studies are different people. Where there are several, `user` contains the
    seed and the first digits of the study's hash, as in "S01 of 2022 in 1a2b3c4d".

    Args:
        mixed: allow runs of different studies.

    Raises:
        ValueError: no file is found, a file is broken or empty, a game occurs twice, the runs are of different studies
            (`study_hash` of manifest.json) and not `mixed`, or some are of people and some not.
    """
    files = find_files(folders, TRIALS)
    studies: dict[str, list[str]] = {}
    manifests = [_manifest(file) for file in files]
    for file, manifest in zip(files, manifests, strict=True):
        if "study_hash" in manifest:
            studies.setdefault(manifest["study_hash"], []).append(str(file.parent))
    if len(studies) > 1 and not mixed:
        listed = "; ".join(f"{study}: {', '.join(places)}" for study, places in studies.items())
        raise ValueError(f"these runs are of different studies and cannot be merged, unless mixed=true: {listed}")
    if len(kinds := {of_people(manifest) for manifest in manifests}) > 1:
        raise ValueError("people and simulated people cannot be merged: name one of them as beside")
    tables = [
        _read(file).assign(study=manifest.get("study_hash", ""), place=str(file))
        for file, manifest in zip(files, manifests, strict=True)
    ]
    trials = pd.concat(tables, ignore_index=True)
    key = ["user", "condition", "seed", *(["study"] if mixed else [])]
    if (repeated := trials[trials.duplicated(key, keep=False)]).size:
        games = (
            repeated.groupby(key, sort=False)["place"].agg(lambda places: " and ".join(sorted(places))).reset_index()
        )
        listed = ", ".join(f"{row.user} {row.condition} (seed {row.seed})" for row in games.itertuples())
        raise ValueError(f"the same game more than once, in {'; '.join(games['place'].unique())}: {listed}")
    if kinds == {False}:
        if trials["seed"].nunique() > 1:
            trials["user"] += " of " + trials["seed"].astype("str")
        if trials["study"].nunique() > 1:
            trials["user"] += " in " + trials["study"].str[:8]
    return trials.drop(columns=["study", "place"])


def _read(file: Path) -> pd.DataFrame:
    try:
        trials = pd.read_csv(file, dtype={"user": "str", "condition": "str"})
    except ValueError as error:  # pandas does not name the file
        raise ValueError(f"{file}: {error}") from error
    if absent := [column for column in ("user", "condition", "seed", *METRICS) if column not in trials]:
        raise ValueError(f"{file} lacks the columns {', '.join(absent)}")
    if trials.empty:
        raise ValueError(f"{file} holds no games")
    for name in ("user", "condition"):  # spreadsheet programs run texts that begin like a formula
        for text in trials[name].dropna().unique():
            if text[:1] in FORMULA or not text.isprintable():
                raise ValueError(f"{file}: {name} = {text[:40]!r} must be a name, and begin with none of {FORMULA}")
    return trials


def _manifest(trials_file: Path) -> dict[str, Any]:
    file = trials_file.with_name("manifest.json")
    if not file.is_file():
        return {}
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
