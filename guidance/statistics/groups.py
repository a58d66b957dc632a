"""Groups of participants, people or simulated people, and the comparison of two groups; groups are never pooled."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import pandas as pd

from airhockey_marl.experiment.files import find_files, load_json, sha256
from airhockey_marl.experiment.validation.tables import Column, read_table
from guidance.forces.condition_specs import ConditionSpec, other_specs
from guidance.statistics.codebook import NUMBER, TRIAL_COLUMNS
from guidance.statistics.design import (
    CONDITIONS,
    METRICS,
    Metric,
    conditions_of,
    declared_conditions,
    declared_metrics,
)
from guidance.statistics.paper import compare_with_paper
from guidance.statistics.tests import check_trials, run_tests

TRIALS = "trials.csv"
FORMULA = "=+-@"  # first characters of a spreadsheet formula
UNTESTED = ("not_tested", "withdrawn")  # outcomes without a result


@dataclass(frozen=True)
class Group:
    """The trials of one study and their manifest.

    Attributes:
        trials: one row per participant and condition, the columns of `trials.csv`.
        manifest: `manifest.json` of the run, or `{"runs": {folder: manifest, ...}}` of several runs; may be empty.
    """

    trials: pd.DataFrame
    manifest: Mapping[str, Any]

    @property
    def run_manifest(self) -> Mapping[str, Any]:
        """The manifest of the first run."""
        return next(iter(self._manifests), {})

    @property
    def _manifests(self) -> list[Mapping[str, Any]]:
        return list(self.manifest["runs"].values()) if "runs" in self.manifest else [self.manifest]

    @cached_property
    def declared(self) -> dict[str, ConditionSpec]:
        """The conditions beyond the paper's by name: this project's, and those that the manifests declare."""
        entries = (entry for manifest in self._manifests for entry in manifest.get("conditions", ()))
        return {**other_specs(lambda text: None), **declared_conditions(entries)}

    @cached_property
    def extra_metrics(self) -> dict[str, Metric]:
        """The metrics beside the paper's eight that the manifests declare and the trials have, by name."""
        declared = declared_metrics(entry for manifest in self._manifests for entry in manifest.get("metrics", ()))
        return {name: metric for name, metric in declared.items() if name in self.trials}

    @property
    def conditions(self) -> dict[str, ConditionSpec]:
        """The conditions of the trials by name, see `conditions_of`."""
        return conditions_of(self.trials, self.declared)

    @property
    def people(self) -> bool:
        """Whether the participants are people."""
        return of_people(self.run_manifest)

    @property
    def planned(self) -> int | None:
        """The planned number of participants; None if unknown."""
        return self.run_manifest.get("config", {}).get("participants")

    @property
    def withdrawn(self) -> list[str]:
        """The metrics that the configuration withdraws: rating proxies that failed a check; none for people."""
        return [] if self.people else list(self.run_manifest.get("config", {}).get("users", {}).get("withdrawn", []))

    @property
    def study_hash(self) -> str | None:
        """The hash of the study; None if unknown."""
        return self.run_manifest.get("study_hash")

    @property
    def size(self) -> int:
        """The number of participants."""
        return self.trials["user"].nunique()

    @cached_property
    def tests(self) -> pd.DataFrame:
        """See `guidance.statistics.tests.run_tests`."""
        return run_tests(self.trials, self.people, self.declared, self.extra_metrics)

    @cached_property
    def comparison(self) -> pd.DataFrame:
        """See `guidance.statistics.paper.compare_with_paper`."""
        return compare_with_paper(self.tests, self.withdrawn)

    @property
    def findings(self) -> pd.DataFrame:
        """The rows of `comparison` that are the paper's 38 findings."""
        return self.comparison[self.comparison["paper"] == "significant"]


def of_people(manifest: Mapping[str, Any]) -> bool:
    """Whether a run is with people, by the `participants` of its manifest: `people`, or `simulated` (the default).

    Raises:
        ValueError: it is anything else.
    """
    kind = manifest.get("participants", "simulated")
    if kind not in ("people", "simulated"):
        raise ValueError(f"manifest: participants = {kind!r} must be people or simulated")
    return kind == "people"


def confidence_half_width(scores: pd.DataFrame) -> pd.Series:
    """Half the width of the 95 % confidence interval of each column's mean, by Student's t; NaN below two values."""
    from scipy.stats import t

    n = scores.count()
    return scores.sem() * t.isf(0.025, (n - 1).where(n > 1))


def names_of(groups: Sequence[Group]) -> list[str]:
    """Names of two groups: by kind, or by place if they are of the same kind."""
    if groups[0].people != groups[1].people:
        return ["people" if group.people else "simulated people" for group in groups]
    kind = "people" if groups[0].people else "simulated people"
    return [f"{kind} here", f"{kind} beside"]


def side_by_side(here: Group, beside: Group) -> dict[str, Any]:
    """Means and findings of two groups side by side; nothing is computed over both.

    Returns:
        `groups`: per group its `name`, `people`, `size` and `study_hash`.
        `means`: per condition its `letter`, `label` and `cells`: per group `n`, and per metric the mean and half the
        95 % interval.
        `findings`: per finding of the paper its row, and `rows`: per group the row of `compare_with_paper` with
        `toward_paper`, dz in the paper's direction.
        `counts`: number of findings that replicate in `both`, in the `first`, in the `second` and in `neither`, of
        those that were tested in both; and the number of the `untested` others.
    """
    groups = [here, beside]
    conditions = conditions_of_both(here, beside)
    means = [
        {
            "letter": condition.letter,
            "label": condition.label,
            "cells": [_cells(group.trials[group.trials["condition"] == name]) for group in groups],
        }
        for name, condition in conditions.items()
    ]
    comparisons = [group.findings for group in groups]
    findings = []
    for rows in zip(*(comparison.to_dict("records") for comparison in comparisons), strict=True):
        sign = 1 if rows[0]["x"] == rows[0]["paper_greater"] else -1
        less = rows[0]["y"] if sign == 1 else rows[0]["x"]
        findings.append(rows[0] | {"less": less, "rows": [row | {"toward_paper": sign * row["dz"]} for row in rows]})
    outcomes = zip(*(comparison["outcome"] for comparison in comparisons), strict=True)
    replicated = [tuple(one == "replicated" for one in pair) for pair in outcomes if not {*pair} & {*UNTESTED}]
    places = {"both": (True, True), "first": (True, False), "second": (False, True), "neither": (False, False)}
    counts = {place: replicated.count(pair) for place, pair in places.items()}
    return {
        "groups": [
            {"name": name, "people": group.people, "size": group.size, "study_hash": group.study_hash}
            for name, group in zip(names_of(groups), groups, strict=True)
        ],
        "means": means,
        "findings": findings,
        "counts": counts | {"untested": len(findings) - len(replicated)},
    }


def conditions_of_both(here: Group, beside: Group) -> dict[str, ConditionSpec]:
    """The conditions of two groups by name; a letter stands for the same condition in both."""
    trials = pd.concat([group.trials[["condition"]] for group in (here, beside)])
    return conditions_of(trials, beside.declared | here.declared)


def _cells(trials: pd.DataFrame) -> dict[str, Any]:
    """One group in one condition: number of trials; per metric mean and half the 95 % interval, NaN without trials."""
    half = confidence_half_width(trials[list(METRICS)].astype(float))
    return {"n": len(trials)} | {metric: (trials[metric].mean(), half[metric]) for metric in METRICS}


def gather(places: Iterable[str | Path], mixed: bool = False) -> Group:
    """The group of the trials at or below these places, with their manifests and the hashes of their files."""
    files = find_files(places, TRIALS)
    manifests = {str(file.parent): _manifest(file) for file in files}
    manifest = next(iter(manifests.values())) if len(files) == 1 else {"runs": manifests}
    if len({run.get("study_hash") for run in manifests.values()}) > 1:
        manifest |= {"frozen": False}  # at most one of several studies is the frozen one
    group = Group(merge(files, mixed), manifest | {"trials_sha256": {str(file): sha256(file) for file in files}})
    try:
        check_trials(group.trials, group.people)
    except ValueError as error:
        raise ValueError(f"{files[0]}{' and others' if len(files) > 1 else ''}: {error}") from error
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
        _read(file, manifest).assign(study=manifest.get("study_hash", ""), place=str(file))
        for file, manifest in zip(files, manifests, strict=True)
    ]
    trials = pd.concat(tables, ignore_index=True)
    key = ["user", "condition", "seed", *(["study"] if mixed else [])]
    if (repeated := trials[trials.duplicated(key, keep=False)]).size:
        by_game = repeated.groupby(key, sort=False)["place"]
        games = by_game.agg(lambda places: " and ".join(sorted(places))).reset_index()
        listed = ", ".join(f"{row.user} {row.condition} (seed {row.seed})" for row in games.itertuples())
        raise ValueError(f"the same game more than once, in {'; '.join(games['place'].unique())}: {listed}")
    if kinds == {False}:
        if trials["seed"].nunique() > 1:
            trials["user"] += " of " + trials["seed"].astype("str")
        if trials["study"].nunique() > 1:
            trials["user"] += " in " + trials["study"].str[:8]
    return trials.drop(columns=["study", "place"])


def _read(file: Path, manifest: Mapping[str, Any]) -> pd.DataFrame:
    """The trials of a file, with the names of the paper's, this project's and the manifest's conditions."""
    specs = CONDITIONS | other_specs(lambda text: None) | declared_conditions(manifest.get("conditions", ()))
    labels = Counter(spec.label.casefold() for spec in specs.values())
    names = {spec.label: name for name, spec in specs.items() if labels[spec.label.casefold()] == 1}
    names |= {name: name for name in specs}
    extra = dict.fromkeys(declared_metrics(manifest.get("metrics", ())), NUMBER)
    trials = read_table(file, TRIAL_COLUMNS | {"condition": Column(names=names)} | extra)
    if trials.empty:
        raise ValueError(f"{file} holds no games")
    users = trials["user"].unique()
    for text in users:  # spreadsheet programs run texts that begin like a formula
        if text[:1] in FORMULA or not text.isprintable():
            raise ValueError(f"{file}: user = {text[:40]!r} must be a name, and begin with none of {FORMULA}")
    for one, other in combinations(users, 2):
        if one.casefold() == other.casefold():
            raise ValueError(f"{file}: user = {other!r} must differ from {one!r} in more than capitals")
    return trials


def _manifest(trials_file: Path) -> dict[str, Any]:
    file = trials_file.with_name("manifest.json")
    return load_json(file) if file.is_file() else {}
