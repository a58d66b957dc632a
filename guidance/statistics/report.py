"""The report of a study: the paper's tables and Figure 6, with the paper's numbers beside ours."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from airhockey_marl.experiment.files import atomic_write, write_text
from airhockey_marl.experiment.html import number, template
from airhockey_marl.experiment.plotting import save_figure
from guidance.forces.condition_specs import ConditionSpec
from guidance.statistics.design import (
    ALPHA,
    BEYOND,
    CONDITIONS,
    FAMILIES,
    FEWEST_PARTICIPANTS,
    METRICS,
)
from guidance.statistics.figures import figure6, means_beside
from guidance.statistics.groups import UNTESTED, Group, side_by_side
from guidance.statistics.paper import EVIDENCE, EVIDENCE_OF_PEOPLE, count_findings, published_results, reference_points
from guidance.statistics.research_questions import QUESTIONS, answer_questions
from guidance.statistics.tests import missing_games, order_effects

PAPER_LETTERS = [condition.letter for condition in CONDITIONS.values()]
SHORT_METRICS = ("win rate", "smash", "defense", "disagree", "helpful", "natural", "control", "comfort")


def write_report(
    trials: pd.DataFrame, folder: Path | str, manifest: Mapping[str, Any], beside: Group | None = None
) -> Group:
    """Test the trials and write tests.csv, figure6.png, figure6.svg and report.html into `folder`.

    Every file is replaced atomically. report.html contains its style and figures and loads nothing.

    Args:
        trials: one row per participant and condition, the columns of `trials.csv`; any subset of the conditions.
        folder: created if absent.
        manifest: the origin of the trials (hashes of the models, seeds, versions, configuration), shown as it is. The
            report says that the run is not the frozen study if `frozen` is False, takes the ratings for those of
            people if `participants` is "people", and labels conditions beyond the paper's by `conditions`.
        beside: another group, tested separately and shown beside these trials, in beside.png, beside.svg and a section.

    Returns:
        The trials, with their tests.

    Raises:
        ValueError: there are no trials.
    """
    if trials.empty:
        raise ValueError("there are no trials to report")
    folder, group = Path(folder), Group(trials, manifest)
    with atomic_write(folder / "tests.csv") as path:
        group.tests.to_csv(path, index=False)
    svg = save_figure(lambda: figure6(group), folder, "figure6", dpi=150)
    comparison = {} if beside is None else _beside(group, beside, folder)
    write_text(folder / "report.html", _page(group, svg, {"beside": None} | comparison))
    return group


def screen_table(group: Group) -> str:
    """The means of the eight metrics per condition as aligned text for a terminal."""
    ratings = "7-point ratings" if group.people else "PROXY of the 7-point ratings"
    means = group.trials.groupby("condition")[list(METRICS)].mean()
    gap, width = 9, max(22, *(len(condition.label) + 5 for condition in group.conditions.values()))
    lines = [f"{'':{width + 4 * gap}} | {ratings:^{4 * gap}}"]
    cells = [("condition", [f"{name:>{gap}}" for name in SHORT_METRICS])]
    for name, condition in group.conditions.items():
        values = [number(value) for value in means.loc[name]]
        cells.append((f"({condition.letter}) {condition.label}", [f"{value:>{gap}}" for value in values]))
    lines += [f"{label:{width}}{''.join(row[:4])} | {''.join(row[4:])}" for label, row in cells]
    return "\n".join(lines)


def _beside(here: Group, beside: Group, folder: Path) -> dict[str, Any]:
    """Draw two groups side by side, and return the variables of their section of the page."""
    svg = save_figure(lambda: means_beside(here, beside), folder, "beside", dpi=130)
    return {
        "beside": side_by_side(here, beside),
        "beside_figure": base64.b64encode(svg).decode("ascii"),
        "beside_manifest": beside.manifest,
    }


def _page(group: Group, svg: bytes, beside: Mapping[str, Any]) -> str:
    """The page of a group; `svg` is Figure 6."""
    trials, tests, withdrawn, people = group.trials, group.tests, group.withdrawn, group.people
    conditions = group.conditions
    comparison = group.comparison.copy()
    comparison["less"] = [_other(row.x, row.y, row.greater) for row in comparison.itertuples()]
    comparison["paper_less"] = [_other(row.x, row.y, row.paper_greater) for row in comparison.itertuples()]
    comparison["dz_toward_paper"] = comparison["dz"] * np.where(comparison["x"] == comparison["paper_greater"], 1, -1)
    findings = comparison[comparison["paper"] == "significant"]
    by_ranks = findings["rank_p"].lt(ALPHA) & findings["greater"].eq(findings["paper_greater"])
    tested = ~comparison["outcome"].isin(UNTESTED)
    counts = comparison["significant"] & tested
    ours = comparison.assign(tested=tested, greater=comparison["greater"].where(counts, ""))
    paper = comparison.assign(tested=True, greater=comparison["paper_greater"])
    enough = group.size >= FEWEST_PARTICIPANTS
    by_chance, rerun = reference_points(group.size) if enough else (None, None)
    in_family = tests.groupby("family", sort=False)["n"].max()

    return template(Path(__file__).parent / "templates", "report.html", p=_p).render(
        people=people,
        participants=group.size,
        planned=group.planned,
        unfinished=_unfinished(trials),
        too_few=in_family[in_family < FEWEST_PARTICIPANTS].to_dict() if people else {},
        games=len(trials),
        conditions=CONDITIONS,
        labels={c.letter: c.label for c in (CONDITIONS | conditions).values()},
        types={"a": "NHG", "c": "OAHG", "f": "UPHG", "i": "CombHG"},
        metrics=METRICS,
        all_metrics=METRICS | group.extra_metrics,
        extra=_extra_rows(group),
        evidence=EVIDENCE_OF_PEOPLE if people else EVIDENCE,
        withdrawn=withdrawn,
        absent=[name for name in CONDITIONS if name not in conditions],
        untested_families=[family for family in FAMILIES if family not in set(tests["family"])],
        counts=count_findings(comparison).to_dict("index"),
        by_chance=by_chance,
        rerun=rerun,
        figure=base64.b64encode(svg).decode("ascii"),
        means=_means(trials, conditions),
        table2=findings[findings["table"] == 2].to_dict("records"),
        table3=findings[findings["table"] == 3].to_dict("records"),
        reversals=findings[findings["outcome"] == "reversed"].to_dict("records"),
        wrong=comparison[comparison["outcome"] == "false_positives"].to_dict("records"),
        paired=_paired_rows(tests, comparison),
        anovas=_anova_rows(tests[tests["family"] != BEYOND]),
        own=[condition for condition in conditions.values() if condition.type == BEYOND],
        beyond=_beyond_rows(tests),
        planned_comparisons=tests[tests["test"] == "planned"].to_dict("records"),
        by_ranks=int((by_ranks & ~findings["metric"].isin(withdrawn)).sum()),
        order=order_effects(trials),
        weights=_weights(trials),
        questions=QUESTIONS,
        answers=answer_questions(ours, people),
        paper_answers=answer_questions(paper),
        manifest=group.manifest,
        **beside,
    )


def _unfinished(trials: pd.DataFrame) -> dict[str, int]:
    """The number of conditions played, by participant, of those who have not played all."""
    games = trials["user"].value_counts()
    return {user: int(games[user]) for user in missing_games(trials)}


def _other(x: str, y: str, letter: str) -> str:
    return {x: y, y: x}.get(letter, "")


def _means(trials: pd.DataFrame, conditions: Mapping[str, ConditionSpec]) -> list[dict[Any, Any]]:
    by_condition, n = (
        trials.groupby("condition")[list(METRICS)].agg(["mean", "std"]),
        trials["condition"].value_counts(),
    )
    return [{"condition": condition, "n": n[name], **by_condition.loc[name]} for name, condition in conditions.items()]


def _extra_rows(group: Group) -> list[dict[str, Any]]:
    """Mean and SD of each metric of a plug-in under each condition, and its significant comparisons."""
    rows = []
    for name, metric in group.extra_metrics.items():
        scores = group.trials.groupby("condition")[name].agg(["mean", "std"])
        tests = group.tests[(group.tests["metric"] == name) & group.tests["significant"] & (group.tests["x"] != "")]
        pairs = [f"({t.greater}) > ({_other(t.x, t.y, t.greater)})" for t in tests.itertuples()]
        cells = [(condition, *scores.loc[key]) for key, condition in group.conditions.items()]
        rows.append({"metric": metric, "cells": cells, "pairs": list(dict.fromkeys(pairs))})
    return rows


def _paired_rows(tests: pd.DataFrame, comparison: pd.DataFrame) -> list[dict[str, Any]]:
    """The paired t-tests within OAHG, and whether the paper's were significant."""
    paper = comparison.set_index(["family", "metric", "x", "y"])[["paper", "p_paper"]]
    return tests[tests["test"] == "paired_t"].join(paper, on=["family", "metric", "x", "y"]).to_dict("records")


def _anova_rows(tests: pd.DataFrame) -> list[dict[str, Any]]:
    """The ANOVAs and the paper's, which prints F only where it is significant."""
    paper = published_results("anova").set_index(["family", "metric"]).drop(columns=["df1", "df2"]).add_suffix("_paper")
    anovas = tests[tests["test"] == "rm_anova"].join(paper, on=["family", "metric"])
    return anovas.fillna({"p_reported_paper": ""}).to_dict("records")


def _beyond_rows(tests: pd.DataFrame) -> list[dict[str, Any]]:
    """The significant pairs with a condition beyond the paper's."""
    own = ~tests["x"].isin(PAPER_LETTERS) | ~tests["y"].isin(PAPER_LETTERS)
    rows = tests[(tests["family"] == BEYOND) & (tests["test"] == "posthoc") & own & tests["significant"]]
    return [row | {"less": _other(row["x"], row["y"], row["greater"])} for row in rows.to_dict("records")]


def _weights(trials: pd.DataFrame) -> list[dict[str, Any]]:
    """Mean and SD of each weight within a game, averaged over the games that have it (section 6.1), and the paper's."""
    rows = published_results("weights").to_dict("records")
    for row in rows:
        none = pd.Series(dtype=float)  # the columns are optional
        mean, sd = (trials.get(f"{row['weight']}_{statistic}", none) for statistic in ("mean", "sd"))
        row |= {"games": mean.count(), "our_mean": mean.mean(), "our_sd": sd.mean()}
    return rows


def _p(value: float) -> str:
    """Format p as the paper does, without the zero before the point."""
    if pd.isna(value):
        return "–"
    return "<.001" if value < 0.001 else "1" if value >= 0.9995 else f"{value:.3f}"[1:]
