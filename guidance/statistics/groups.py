"""Whom a report is on: people or simulated people, and two such groups side by side, which are never pooled."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from guidance.statistics.figures import confidence_half_width
from guidance.statistics.paper import compare_with_paper
from guidance.statistics.tests import METRICS, conditions_of, run_tests

UNTESTED = ("not_tested", "withdrawn")  # outcomes that say nothing about a finding


@dataclass(frozen=True)
class Group:
    """The trials of one study and what they rest on.

    Attributes:
        trials: one row per participant and condition, the columns of `trials.csv`.
        manifest: as the study left it, or `{"runs": {place: manifest, ...}}` of runs of one study; may be empty.
    """

    trials: pd.DataFrame
    manifest: Mapping[str, Any]

    @property
    def one(self) -> Mapping[str, Any]:
        """The manifest of one of the runs, which are of one study."""
        return next(iter(self.manifest["runs"].values()), {}) if "runs" in self.manifest else self.manifest

    @property
    def people(self) -> bool:
        """Whether people played; else they are simulated."""
        return of_people(self.one)

    @property
    def planned(self) -> int | None:
        """How many participants the study is to have; None where that is not known."""
        return self.one.get("config", {}).get("participants")

    @property
    def withdrawn(self) -> list[str]:
        """The metrics that the configuration withdraws: proxies that failed. What people say is not."""
        return [] if self.people else list(self.one.get("config", {}).get("users", {}).get("withdrawn", []))

    @property
    def size(self) -> int:
        """How many participants there are."""
        return self.trials["user"].nunique()

    @cached_property
    def tests(self) -> pd.DataFrame:
        """See `guidance.statistics.tests.run_tests`."""
        return run_tests(self.trials, self.people)

    @cached_property
    def comparison(self) -> pd.DataFrame:
        """See `guidance.statistics.paper.compare_with_paper`."""
        return compare_with_paper(self.tests, self.withdrawn)


def of_people(manifest: Mapping[str, Any]) -> bool:
    """Whether the manifest of a run says that people played.

    Raises:
        ValueError: it says something else than `people` or `simulated`; nothing means the latter.
    """
    kind = manifest.get("participants", "simulated")
    if kind not in ("people", "simulated"):
        raise ValueError(f"manifest: participants = {kind!r} must be people or simulated")
    return kind == "people"


def names_of(groups: Sequence[Group]) -> list[str]:
    """What to call two groups: by what they are or, if they are of a kind, by their places."""
    if groups[0].people != groups[1].people:
        return ["people" if group.people else "simulated people" for group in groups]
    kind = "people" if groups[0].people else "simulated people"
    return [f"{kind} here", f"{kind} beside"]


def side_by_side(here: Group, beside: Group) -> dict[str, Any]:
    """What a page shows of two groups; nothing is computed over both.

    Returns:
        `groups`: per group its `name`, `people`, `size` and `study_hash`. `means`: a row per condition, with its
        `letter`, `label` and `cells`, per group `n` and per metric the mean and half the 95 % interval. `findings`: a
        row per finding of the paper, with `rows`, the group's row of `compare_with_paper` and `toward_paper`, dz in
        the paper's direction. `counts`: of the findings, how many replicate in `both`, in the `first`, in the `second`
        and in `neither` of those that both could test, and how many one could not test, `untested`.
    """
    groups = [here, beside]
    # the letters of conditions that are not the paper's must mean the same in both
    conditions = conditions_of(pd.concat([group.trials[["condition"]] for group in groups]))
    means = [
        {
            "letter": condition.letter,
            "label": condition.label,
            "cells": [_cells(group.trials[group.trials["condition"] == name]) for group in groups],
        }
        for name, condition in conditions.items()
    ]
    comparisons = [group.comparison[group.comparison["paper"] == "significant"] for group in groups]
    findings = []
    for rows in zip(*(comparison.to_dict("records") for comparison in comparisons), strict=True):
        sign = 1 if rows[0]["x"] == rows[0]["paper_greater"] else -1
        less = rows[0]["y"] if sign == 1 else rows[0]["x"]
        findings.append(rows[0] | {"less": less, "rows": [row | {"toward_paper": sign * row["dz"]} for row in rows]})
    replicated = [comparison["outcome"].eq("replicated").to_numpy() for comparison in comparisons]
    tested = ~(
        comparisons[0]["outcome"].isin(UNTESTED) | comparisons[1]["outcome"].isin(UNTESTED).to_numpy()
    ).to_numpy()
    first, second = replicated
    return {
        "groups": [
            {"name": name, "people": group.people, "size": group.size, "study_hash": group.one.get("study_hash")}
            for name, group in zip(names_of(groups), groups, strict=True)
        ],
        "means": means,
        "findings": findings,
        "counts": {
            "both": int((first & second & tested).sum()),
            "first": int((first & ~second & tested).sum()),
            "second": int((~first & second & tested).sum()),
            "neither": int((~first & ~second & tested).sum()),
            "untested": int((~tested).sum()),
        },
    }


def _cells(trials: pd.DataFrame) -> dict[str, Any]:
    """One group in one condition: how many there are, and per metric the mean and half the interval; NaN of nobody."""
    half = confidence_half_width(trials[list(METRICS)].astype(float))
    return {"n": len(trials)} | {metric: (trials[metric].mean(), half[metric]) for metric in METRICS}
