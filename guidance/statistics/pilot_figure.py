"""The figure of a pilot: its objective by T_lookahead and K, and the last candidates with their intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from airhockey_marl.experiment.plotting import (
    BLUE,
    GRAY,
    INK,
    label_axes,
    legend_below,
    new_figure,
    percent,
    save_png,
)

NORMAL_95 = 1.96  # standard errors


def draw_pilot(standings: pd.DataFrame, path: Path) -> None:
    """Draw the objective, the mean share of rounds won under OAHG and UPHG (UA).

    Args:
        standings: rows with `round` and the columns of `candidates.objective`. On the left are those of the first
            round: the best value over all other settings. On the right are those of the last round.
    """
    first, last = (standings[standings["round"] == number] for number in (1, standings["round"].max()))
    best = first.sort_values("objective", ascending=False).drop_duplicates(["lookahead", "stiffness"])
    values, errors = (best.pivot(index="lookahead", columns="stiffness", values=name) for name in ("objective", "se"))
    figure = new_figure(11.5, max(3.4, 0.5 * len(last) + 1.6))
    surface, forest = figure.subplots(1, 2, width_ratios=[1, 1.25])
    image = surface.imshow(values, cmap="cividis", aspect="auto", origin="lower")
    figure.colorbar(image, ax=surface, format=percent())
    middle = (np.nanmin(values.to_numpy()) + np.nanmax(values.to_numpy())) / 2
    for row, column in np.argwhere(values.notna().to_numpy()):
        value, error = values.iat[row, column], errors.iat[row, column]
        color = "white" if value < middle else INK
        text = f"{value:.2f}" if np.isnan(error) else f"{value:.2f}\n±{error:.2f}"
        surface.text(column, row, text, ha="center", va="center", fontsize=8, color=color)
    surface.set_xticks(range(len(values.columns)), [f"{value:g}" for value in values.columns])
    surface.set_yticks(range(len(values.index)), [f"{value:g}" for value in values.index])
    label_axes(surface, f"First round, best of all settings (n = {_people(first)})", "K, N/m", "T_lookahead, s")
    height = np.arange(len(last))[::-1]
    for name, color, shift in (("objective", INK, 0.0), ("oahg", BLUE, 0.18), ("uphg", GRAY, -0.18)):
        half = NORMAL_95 * last["se"] if name == "objective" else None
        label = {"objective": "objective, 95 %", "oahg": "under OAHG", "uphg": "under UPHG (UA)"}[name]
        forest.errorbar(last[name], height + shift, xerr=half, fmt="o", ms=4, capsize=3, color=color, label=label)
    forest.set_yticks(height, [_name(row) for row in last.itertuples()])
    forest.set_ylim(-0.6, len(last) - 0.4)
    forest.xaxis.set_major_formatter(percent())
    legend_below(figure, forest.get_legend_handles_labels()[0])
    low, high = forest.get_xlim()
    forest.set_xlim(max(low, 0.0), min(high, 1.0))
    label_axes(forest, f"Last round, other people (n = {_people(last)})", "share of rounds won")
    save_png(figure, path)


def _people(standings: pd.DataFrame) -> int:
    return int(standings["games"].max() / 2)


def _name(row: Any) -> str:
    """The settings of a candidate in two lines."""
    return f"{row.lookahead:g} s {row.reading}, K {row.stiffness:g}, {row.limit:g} N\n{row.predictor}, {row.league}"
