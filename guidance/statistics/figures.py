"""Figures of studies: the paper's Figure 6, and which of its findings hold over many of them."""

import io
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from airhockey_marl.experiment.files import atomic_write
from guidance.statistics.paper import EVIDENCE
from guidance.statistics.tests import BEYOND, METRICS, Condition, Metric, conditions_of

# Okabe and Ito's colors, which people with any kind of color vision can tell apart
COLORS = {"NHG": "#8C8C8C", "OAHG": "#E69F00", "UPHG": "#0072B2", "CombHG": "#009E73", BEYOND: "#CC79A7"}
SCALE = (1, 7)  # of the ratings
SIDES = (("#0072B2", "o", -0.16), ("#E69F00", "D", 0.16))  # color, marker and shift of two groups side by side


def save_figure(draw: Callable[[], Figure], folder: Path, name: str, dpi: int) -> bytes:
    """Draw a figure and write it as `name`.png and .svg, each whole; the same drawing gives the same bytes.

    Returns:
        The svg.
    """
    # no date and a fixed salt
    with matplotlib.rc_context({"svg.hashsalt": name, "font.family": "DejaVu Sans"}):
        figure, svg = draw(), io.BytesIO()
        with atomic_write(folder / f"{name}.png") as path:
            figure.savefig(path, dpi=dpi)
        figure.savefig(svg, format="svg", metadata={"Date": None})
    with atomic_write(folder / f"{name}.svg") as path:
        path.write_bytes(svg.getvalue())
    return svg.getvalue()


def confidence_half_width(scores: pd.DataFrame) -> pd.Series:
    """Half the width of the 95 % confidence interval of each column's mean, by Student's t; NaN below two values."""
    n = scores.count()
    return scores.sem() * stats.t.isf(0.025, (n - 1).where(n > 1))


def figure6(trials: pd.DataFrame, withdrawn: Collection[str] = (), people: bool = False) -> Figure:
    """Draw the paper's Figure 6 (section 5).

    Args:
        trials: one row per participant and condition; any subset of the nine conditions, and others.
        withdrawn: metrics that count for nothing; their panels say so.
        people: the ratings are people's; without it their panels say that they are proxies.

    Returns:
        Eight panels, the objective metrics above, the ratings or their proxies below; a bar per condition present in
        the color of its guidance type, with the mean's 95 % confidence interval. A metric that is undefined in a
        condition, as disagreement is without guidance, has a dash in place of its bar.
    """
    present = conditions_of(trials)
    figure = Figure(figsize=(13.5, 6.6), layout="constrained")
    panels = figure.subplots(2, 4).flat
    for axes, (name, metric) in zip(panels, METRICS.items(), strict=True):
        _draw_bars(
            axes,
            trials.pivot(index="user", columns="condition", values=name)[list(present)],
            list(present.values()),
            metric,
            name in withdrawn,
            people,
        )
    legend = [
        Patch(color=COLORS[condition.guidance], label=f"({condition.letter}) {condition.label}")
        for condition in present.values()
    ]
    style = {"frameon": False, "fontsize": 8.5, "handlelength": 1.1, "columnspacing": 1.4, "handletextpad": 0.5}
    figure.legend(handles=legend, loc="outside lower center", ncols=len(present), **style)
    return figure


def _draw_bars(
    axes: Axes, scores: pd.DataFrame, conditions: list[Condition], metric: Metric, withdrawn: bool, people: bool
) -> None:
    """Draw one panel; scores (participants, conditions)."""
    places = np.arange(len(conditions))
    mean, half = scores.mean().to_numpy(), confidence_half_width(scores).to_numpy()
    axes.bar(places, mean, width=0.72, color=[COLORS[condition.guidance] for condition in conditions])
    drawn = np.isfinite(half)
    axes.errorbar(places[drawn], mean[drawn], half[drawn], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=3)
    rating = metric.kind == "subjective"
    proxy = rating and not people
    if rating:
        axes.set_ylim(*SCALE)
    elif people:
        _within_reason(axes, metric)
    if not rating and np.isnan(mean).all():
        axes.set_yticks([])  # a scale without values would be made up
    for place in places[np.isnan(mean)]:
        axes.annotate("–", (place, 0.03), xycoords=("data", "axes fraction"), ha="center", fontsize=13, color="#666666")
    mark = " (PROXY, withdrawn)" if withdrawn else " (PROXY)" if proxy else ""
    axes.set_title(metric.label + mark, fontsize=11, fontweight="bold")
    unit = "proxy of the 7-point rating" if proxy else "7-point rating" if rating else metric.unit
    axes.set_ylabel(unit, fontsize=9, color="#444444")
    axes.set_xticks(places, [f"({condition.letter})" for condition in conditions])
    middle, half_span = (len(conditions) - 1) / 2, max(len(conditions), 5) / 2  # a lone bar is no wall
    axes.set_xlim(middle - half_span - 0.1, middle + half_span + 0.1)
    axes.tick_params(labelsize=9)
    axes.tick_params(axis="x", length=0)
    axes.grid(axis="y", color="#E3E3E3", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _within_reason(axes: Axes, metric: Metric) -> None:
    """Cut the scale off where the metric cannot be: of two or three people, intervals go there and hide the means."""
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 0.0), min(high, 1.02) if metric.unit.startswith("share") else high)


def means_beside(trials: Mapping[str, pd.DataFrame], people: Collection[str]) -> Figure:
    """Draw two groups side by side.

    Args:
        trials: of each group by its name, as `figure6` takes them.
        people: the groups of people; the ratings of others are marked as proxies.

    Returns:
        Eight panels, one per metric, with each group's mean under each condition and its 95 % confidence interval.
    """
    conditions = conditions_of(pd.concat([group[["condition"]] for group in trials.values()]))
    figure = Figure(figsize=(13.5, 6.2), layout="constrained")
    panels = list(figure.subplots(2, 4).flat)
    proxies = [name for name in trials if name not in people]
    asked = {0: "7-point rating", len(trials): "PROXY of the 7-point rating"}.get(
        len(proxies), f"7-point rating\n(PROXY of {', '.join(proxies)})"
    )
    for axes, (metric, about) in zip(panels, METRICS.items(), strict=True):
        for (name, group), (color, marker, shift) in zip(trials.items(), SIDES, strict=True):
            scores = group.pivot(index="user", columns="condition", values=metric).reindex(columns=list(conditions))
            mean, half = scores.mean().to_numpy(float), confidence_half_width(scores).to_numpy(float)
            places, drawn = np.arange(len(conditions)) + shift, np.isfinite(half)
            axes.plot(places, mean, marker, color=color, markersize=5.5, label=f"{name} (n = {len(scores)})")
            axes.errorbar(places[drawn], mean[drawn], half[drawn], fmt="none", ecolor=color, elinewidth=1.2, capsize=2)
        rating = about.kind == "subjective"
        if rating:
            axes.set_ylim(SCALE[0] - 0.2, SCALE[1] + 0.2)
        else:
            _within_reason(axes, about)
        axes.set_title(about.label, fontsize=11, fontweight="bold")
        axes.set_ylabel(asked if rating else about.unit, fontsize=8 if rating else 9, color="#444444")
        axes.set_xticks(range(len(conditions)), [f"({condition.letter})" for condition in conditions.values()])
        axes.set_xlim(-0.6, len(conditions) - 0.4)
        axes.tick_params(labelsize=9)
        axes.grid(axis="y", color="#E3E3E3", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9
    )
    return figure


def robustness_map(findings: pd.DataFrame) -> Figure:
    """Draw which findings hold over which studies.

    Args:
        findings: as `robustness.findings_over` returns them.

    Returns:
        A row per finding, grouped by evidence class. Left a cell per group of studies, the share of them that
        replicates it in per cent, with the share that reverses it in red where it is 5 % or more; right, the effect
        size in the paper's direction, 5 to 95 % of the studies of the first group, beside the paper's (a diamond).
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
    figure = Figure(figsize=(11, 0.27 * len(pairs) + 1.6), layout="constrained")
    cells, effects = figure.subplots(1, 2, sharey=True, width_ratios=(1 + 0.35 * len(groups), 2.4))
    cells.imshow(np.ma.masked_where(withdrawn == 1, shares), cmap="Blues", vmin=0, vmax=1.25, aspect="auto")
    for row, column in np.ndindex(shares.shape):
        if withdrawn[row, column] == 1:
            cells.text(column, row, "withdrawn", ha="center", va="center", fontsize=6.5, color="#888888")
            continue
        dark, center = shares[row, column] > 0.7, {"va": "center", "ha": "center"}
        text = f"{100 * shares[row, column]:.0f}"
        cells.text(column, row, text, fontsize=7.5, color="white" if dark else "#222222", **center)
        if reversed_[row, column] >= 0.05:
            text, color = f"{100 * reversed_[row, column]:.0f}", "#ffb3a0" if dark else "#c0392b"
            cells.text(column + 0.36, row, text, fontsize=6.5, color=color, fontweight="bold", **center)
    cells.set_xticks(range(len(groups)), groups, fontsize=8)
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
    effects.hlines(places, first["low"], first["high"], color="#0072B2", linewidth=2.2, alpha=0.55)
    effects.plot(first["median"], places, "o", color="#0072B2", markersize=4)
    effects.plot(first["dz_paper"], places, "D", color="#E69F00", markersize=4)
    effects.set_xlabel("$d_z$ toward the paper: studies (blue), paper, at least (orange)", fontsize=8)
    effects.tick_params(axis="x", labelsize=8)
    effects.grid(axis="x", color="#E3E3E3", linewidth=0.8)
    effects.spines[["top", "right"]].set_visible(False)
    for boundary in np.flatnonzero(np.diff(first["evidence"].map(order))) + 0.5:
        for axes in (cells, effects):
            axes.axhline(boundary, color="#222222", linewidth=0.8)
    return figure
