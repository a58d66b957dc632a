"""Figures of studies: the paper's Figure 6, two groups side by side, and the robustness of findings over studies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from airhockey_marl.experiment.plotting import (
    BLUE,
    GRAY,
    GREEN,
    INK,
    LIGHT_GRAY,
    PINK,
    YELLOW,
    despine,
    label_panel,
    legend_below,
    new_figure,
)
from guidance.forces.condition_specs import ConditionSpec
from guidance.statistics.design import BEYOND, CONDITIONS, METRICS, Metric
from guidance.statistics.groups import Group, conditions_of_both, confidence_half_width, names_of
from guidance.statistics.paper import EVIDENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

COLORS = {"NHG": GRAY, "OAHG": YELLOW, "UPHG": BLUE, "CombHG": GREEN, BEYOND: PINK}  # by type of guidance
SCALE = (1, 7)  # of the ratings
MOST_LETTERS = 13  # conditions below a panel in the usual size of letters
SIDES = ((BLUE, "o", -0.16), (YELLOW, "D", 0.16))  # color, marker and shift of two groups side by side


def color_of(condition: ConditionSpec) -> str:
    """The color of a condition's bars, by its type of guidance unless it has its own."""
    return condition.color or COLORS[condition.type]


def figure6(group: Group) -> Figure:
    """Draw the paper's Figure 6 (section 5) of a group, whose trials may be of any subset of the conditions.

    Returns:
        Eight panels, objective metrics above, ratings or their proxies below; a bar per condition in the color of its
        guidance type, with the 95 % confidence interval of the mean. A dash stands for a metric that is undefined in
        a condition, as disagreement is without guidance.
    """
    from matplotlib.patches import Patch

    present = group.conditions
    figure = new_figure(13.5, 6.6)
    panels = figure.subplots(2, 4).flat
    for axes, (name, metric) in zip(panels, METRICS.items(), strict=True):
        scores = group.trials.pivot(index="user", columns="condition", values=name)[list(present)]
        _draw_bars(axes, scores, list(present.values()), metric, name in group.withdrawn, group.people)
    legend_below(figure, [Patch(color=color_of(c), label=f"({c.letter}) {c.label}") for c in present.values()])
    return figure


def _draw_bars(
    axes: Axes, scores: pd.DataFrame, conditions: list[ConditionSpec], metric: Metric, withdrawn: bool, people: bool
) -> None:
    """Draw one panel; scores (participants, conditions)."""
    places = np.arange(len(conditions))
    mean, half = scores.mean().to_numpy(), confidence_half_width(scores).to_numpy()
    axes.bar(places, mean, width=0.72, color=[color_of(condition) for condition in conditions])
    known = np.isfinite(half)
    axes.errorbar(places[known], mean[known], half[known], fmt="none", ecolor=INK, elinewidth=1.1, capsize=3)
    rating = metric.kind == "subjective"
    proxy = rating and not people
    if rating:
        axes.set_ylim(SCALE[0] - 0.5, SCALE[1])  # so that a mean of 1 has a bar
    else:
        _clip_scale(axes, metric)
    if not rating and np.isnan(mean).all():
        axes.set_yticks([])  # no values, no scale
    for place in places[np.isnan(mean)]:
        axes.annotate("–", (place, 0.03), xycoords=("data", "axes fraction"), ha="center", fontsize=13, color="#666666")
    mark = " (PROXY, withdrawn)" if withdrawn else " (PROXY)" if proxy else ""
    unit = "proxy of the 7-point rating" if proxy else "7-point rating" if rating else metric.unit
    label_panel(axes, metric.label + mark, y=unit)
    _letter_ticks(axes, conditions)
    middle, half_span = (len(conditions) - 1) / 2, max(len(conditions), 5) / 2  # a few bars do not fill the panel
    axes.set_xlim(middle - half_span - 0.1, middle + half_span + 0.1)
    axes.tick_params(axis="x", length=0)


def _letter_ticks(axes: Axes, conditions: Sequence[ConditionSpec]) -> None:
    size = min(9.0, 9.0 * MOST_LETTERS / len(conditions))
    axes.set_xticks(range(len(conditions)), [f"({condition.letter})" for condition in conditions], fontsize=size)


def _letters(conditions: Iterable[ConditionSpec]) -> list[Line2D]:
    """Entries of a legend that says which condition a letter is."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], linestyle="none", label=f"({c.letter}) {c.label}") for c in conditions]


def _clip_scale(axes: Axes, metric: Metric) -> None:
    """Clip the scale to possible values of the metric: the intervals of two or three people extend far beyond."""
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 0.0), min(high, 1.02) if metric.unit.startswith("share") else high)


def means_beside(here: Group, beside: Group) -> Figure:
    """Draw two groups side by side.

    Returns:
        Eight panels, one per metric, with each group's mean under each condition and its 95 % confidence interval.
    """
    groups, conditions = (
        dict(zip(names_of([here, beside]), (here, beside), strict=True)),
        conditions_of_both(here, beside),
    )
    figure = new_figure(13.5, 6.2)
    panels = list(figure.subplots(2, 4).flat)
    proxies = [name for name, group in groups.items() if not group.people]
    rating_label = {0: "7-point rating", len(groups): "PROXY of the 7-point rating"}.get(
        len(proxies), f"7-point rating\n(PROXY of {', '.join(proxies)})"
    )
    for axes, (name, metric) in zip(panels, METRICS.items(), strict=True):
        for (label, group), (color, marker, shift) in zip(groups.items(), SIDES, strict=True):
            scores = group.trials.pivot(index="user", columns="condition", values=name)
            scores = scores.reindex(columns=list(conditions))
            mean, half = scores.mean().to_numpy(float), confidence_half_width(scores).to_numpy(float)
            places, known = np.arange(len(conditions)) + shift, np.isfinite(half)
            axes.plot(places, mean, marker, color=color, markersize=5.5, label=f"{label} (n = {len(scores)})")
            axes.errorbar(places[known], mean[known], half[known], fmt="none", ecolor=color, elinewidth=1.2, capsize=2)
        rating = metric.kind == "subjective"
        if rating:
            axes.set_ylim(SCALE[0] - 0.2, SCALE[1] + 0.2)
        else:
            _clip_scale(axes, metric)
        label_panel(axes, metric.label, y=rating_label if rating else metric.unit)
        axes.yaxis.label.set_fontsize(8 if rating else 9)
        _letter_ticks(axes, list(conditions.values()))
        axes.set_xlim(-0.6, len(conditions) - 0.4)
    legend_below(figure, [*panels[0].get_legend_handles_labels()[0], *_letters(conditions.values())])
    return figure


def robustness_map(findings: pd.DataFrame, names: Mapping[str, str]) -> Figure:
    """Draw how many studies replicate each finding of the paper.

    Args:
        findings: as `robustness.findings_over` returns them.
        names: of the groups of studies.

    Returns:
        A row per finding, grouped by evidence class. Left, a cell per group of studies: the share that replicates the
        finding in per cent, and in red the share that reverses it if that is at least 5 %. Right, the effect size in
        the direction of the paper: 5 to 95 % of the studies of the first group, and that of the paper (a diamond).
    """
    groups = list(findings["group"].unique())
    first = findings[findings["group"] == groups[0]]
    order = {evidence: place for place, evidence in enumerate(EVIDENCE)}
    first = first.sort_values(["evidence", "id"], key=lambda c: c.map(order) if c.name == "evidence" else c)
    pairs = first["id"].tolist()
    shares, reversed_, withdrawn = (
        findings.pivot(index="id", columns="group", values=name).loc[pairs, groups].to_numpy()
        for name in ("replicated", "reversed", "withdrawn")
    )
    figure = new_figure(11, 0.27 * len(pairs) + 1.6)
    cells, effects = figure.subplots(1, 2, sharey=True, width_ratios=(1 + 0.35 * len(groups), 2.4))
    cells.imshow(np.ma.masked_where(withdrawn == 1, shares), cmap="Blues", vmin=0, vmax=1.25, aspect="auto")
    for row, column in np.ndindex(shares.shape):
        if withdrawn[row, column] == 1:
            cells.text(column, row, "withdrawn", ha="center", va="center", fontsize=6.5, color="#888888")
            continue
        dark, center = shares[row, column] > 0.7, {"va": "center", "ha": "center"}
        text = f"{100 * shares[row, column]:.0f}"
        cells.text(column, row, text, fontsize=7.5, color="white" if dark else INK, **center)
        if reversed_[row, column] >= 0.05:
            text, color = f"{100 * reversed_[row, column]:.0f}", "#ffb3a0" if dark else "#c0392b"
            cells.text(column + 0.36, row, text, fontsize=6.5, color=color, fontweight="bold", **center)
    titles = [fill(names[group], 13, break_long_words=False) for group in groups]
    cells.set_xticks(range(len(groups)), titles, fontsize=7)
    cells.xaxis.tick_top()
    labels = []
    for row in first.itertuples():
        less = row.y if row.paper_greater == row.x else row.x
        labels.append(f"{row.evidence}  {METRICS[row.metric].label.lower()}: ({row.paper_greater}) > ({less})")
    cells.set_yticks(range(len(pairs)), labels, fontsize=8)
    cells.tick_params(length=0)
    cells.set_title("% of studies that replicate it (reverse it)", fontsize=9, pad=18)
    places = np.arange(len(pairs))
    effects.axvline(0, color="#888888", linewidth=0.8)
    effects.hlines(places, first["low"], first["high"], color=BLUE, linewidth=2.2, alpha=0.55)
    effects.plot(first["median"], places, "o", color=BLUE, markersize=4)
    effects.plot(first["dz_paper"], places, "D", color=YELLOW, markersize=4)
    effects.set_xlabel("$d_z$ toward the paper: studies (blue), paper, at least (orange)", fontsize=8)
    effects.tick_params(axis="x", labelsize=8)
    effects.tick_params(axis="y", length=0)
    effects.grid(axis="x", color=LIGHT_GRAY, linewidth=0.8)
    despine(effects)
    for boundary in np.flatnonzero(np.diff(first["evidence"].map(order))) + 0.5:
        for axes in (cells, effects):
            axes.axhline(boundary, color=INK, linewidth=0.8)
    legend_below(figure, _letters(CONDITIONS.values()))
    return figure
