"""Figure 6 of the paper: the eight metrics under the nine conditions, from a tidy table of games."""

from collections.abc import Collection

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from guidance.stats import BEYOND, METRICS, Condition, Metric, conditions_of

# Okabe and Ito's colours, which people with any kind of colour vision can tell apart
COLOURS = {"NHG": "#8C8C8C", "OAHG": "#E69F00", "UPHG": "#0072B2", "CombHG": "#009E73", BEYOND: "#CC79A7"}
SCALE = (1, 7)  # of the ratings


def confidence_half_width(scores: pd.DataFrame) -> pd.Series:
    """Half the width of the 95 % confidence interval of each column's mean, by Student's t; NaN below two values."""
    n = scores.count()
    return scores.sem() * stats.t.isf(0.025, (n - 1).where(n > 1))


def figure6(trials: pd.DataFrame, withdrawn: Collection[str] = ()) -> Figure:
    """Draw the paper's Figure 6 (section 5).

    Args:
        trials: one row per participant and condition; any subset of the nine conditions, and others.
        withdrawn: metrics that count for nothing; their panels say so.

    Returns:
        Eight panels, the objective metrics above, the proxies of the ratings below; a bar per condition present in
        the colour of its guidance type, with the mean's 95 % confidence interval. A metric that is undefined in a
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
        )
    legend = [
        Patch(color=COLOURS[condition.guidance], label=f"({condition.letter}) {condition.label}")
        for condition in present.values()
    ]
    style = {"frameon": False, "fontsize": 8.5, "handlelength": 1.1, "columnspacing": 1.4, "handletextpad": 0.5}
    figure.legend(handles=legend, loc="outside lower center", ncols=len(present), **style)
    return figure


def _draw_bars(axes: Axes, scores: pd.DataFrame, conditions: list[Condition], metric: Metric, withdrawn: bool) -> None:
    """Draw one panel; scores (participants, conditions)."""
    places = np.arange(len(conditions))
    mean, half = scores.mean().to_numpy(), confidence_half_width(scores).to_numpy()
    axes.bar(places, mean, width=0.72, color=[COLOURS[condition.guidance] for condition in conditions])
    drawn = np.isfinite(half)
    axes.errorbar(places[drawn], mean[drawn], half[drawn], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=3)
    proxy = metric.kind == "subjective"
    if proxy:
        axes.set_ylim(*SCALE)
    elif np.isnan(mean).all():
        axes.set_yticks([])  # a scale without values would be made up
    for place in places[np.isnan(mean)]:
        axes.annotate("–", (place, 0.03), xycoords=("data", "axes fraction"), ha="center", fontsize=13, color="#666666")
    mark = " (PROXY, withdrawn)" if withdrawn else " (PROXY)" if proxy else ""
    axes.set_title(metric.label + mark, fontsize=11, fontweight="bold")
    axes.set_ylabel("proxy of the 7-point rating" if proxy else metric.unit, fontsize=9, color="#444444")
    axes.set_xticks(places, [f"({condition.letter})" for condition in conditions])
    middle, half_span = (len(conditions) - 1) / 2, max(len(conditions), 5) / 2  # a lone bar is no wall
    axes.set_xlim(middle - half_span - 0.1, middle + half_span + 0.1)
    axes.tick_params(labelsize=9)
    axes.tick_params(axis="x", length=0)
    axes.grid(axis="y", color="#E3E3E3", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
