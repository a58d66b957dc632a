"""Figures of the prediction report: errors by horizon, adaptation to people, and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from airhockey_marl.experiment.plotting import BLUE, GRAY, GREEN, ORANGE, label_axes, new_figure, save_png

STYLES = {  # color and line style of each predictor
    "persistence": (GRAY, ":"),
    "extrapolation": (GRAY, "-"),
    "supervised": (GREEN, "-"),
    "before_ua": (ORANGE, "--"),
    "after_ua": (BLUE, "-"),
}


def draw_horizons(results: Mapping, labels: Mapping[str, str], path: Path) -> None:
    """Prediction errors, and gains over extrapolation, by prediction horizon.

    Args:
        results: content of prediction.json.
        labels: of the predictors.
    """
    figure = new_figure(9, 3.4)
    panels = figure.subplots(1, 2)
    for axes, measure, title, y_label in (
        (panels[0], "rmse", "Error", "root mean square, units of action"),
        (panels[1], "gain", "Gain over moving the paddle on", "share of that error"),
    ):
        for name, (color, style) in STYLES.items():
            rows = [row for row in results["ahead"] if row["predictor"] == name]
            horizons, mean = [row["ahead_s"] for row in rows], np.array([row[measure]["mean"] for row in rows])
            half = [row[measure]["high"] - row[measure]["mean"] for row in rows]
            axes.errorbar(horizons, mean, half, color=color, ls=style, capsize=3, marker="o", ms=3, label=labels[name])
        label_axes(axes, title, "s ahead", y_label)
    panels[0].legend(frameon=False, fontsize=8)
    panels[1].axhline(0.0, color=GRAY, lw=0.8)
    of_models = [row["gain"] for row in results["ahead"] if row["predictor"] not in ("persistence", "extrapolation")]
    panels[1].set_ylim(bottom=min(-0.1, 1.15 * min(gain["low"] for gain in of_models)))
    save_png(figure, path)


def draw_adaptation(results: Mapping, labels: Mapping[str, str], path: Path) -> None:
    """Errors of each person's model on each person, and errors by minutes of play and by steps of UA."""
    figure = new_figure(11, 3.4)
    panels = figure.subplots(1, 3)
    matrix = np.array(results["matrix"])
    excess = 100 * (matrix / matrix.diagonal() - 1)
    largest = max(np.abs(excess).max(), 1e-9)
    image = panels[0].imshow(excess, cmap="PuOr_r", vmin=-largest, vmax=largest)
    figure.colorbar(image, ax=panels[0], label="% more than their own model's", shrink=0.85)
    panels[0].xaxis.get_major_locator().set_params(integer=True)
    panels[0].yaxis.get_major_locator().set_params(integer=True)
    label_axes(panels[0], "Error of the row's model on the column", "person", "model adapted to")
    before = next(row["rmse"]["mean"] for row in results["ahead"] if row["predictor"] == "before_ua")
    x_labels = {"minutes": "minutes of play", "steps": "steps of gradient descent"}
    for axes, (key, label) in zip(panels[1:], x_labels.items(), strict=True):
        rows = [row for row in results[key] if row["rmse"]["high"] is not None]  # None: UA diverged
        mean = [row["rmse"]["mean"] for row in rows]
        half = [row["rmse"]["high"] - row["rmse"]["mean"] for row in rows]
        x = [row[key] for row in rows]
        axes.errorbar(x, mean, half, color=BLUE, capsize=3, marker="o", ms=3, label="after UA")
        axes.axhline(before, color=ORANGE, ls="--", label="before UA")
        label_axes(axes, f"Error by {label} for UA", label, "units of action")
        axes.set_xscale("log")
        axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.minorticks_off()
    if max(mean) > 1.0:  # errors as wide as the table
        panels[2].set_yscale("log")
    panels[1].legend(frameon=False, fontsize=8)
    save_png(figure, path)


def draw_reliability(results: Mapping, labels: Mapping[str, str], path: Path) -> None:
    """Root mean square error against predicted STD: calibrated on the diagonal."""
    figure = new_figure(4.4, 4)
    axes = figure.subplots()
    for name, pairs in results["reliability"].items():
        color, style = STYLES[name]
        axes.loglog(pairs["said"], pairs["seen"], color=color, ls=style, marker="o", ms=4, label=labels[name])
    ends = np.array([*axes.get_xlim(), *axes.get_ylim()])
    axes.plot([ends.min(), ends.max()], [ends.min(), ends.max()], color=GRAY, lw=0.8)
    label_axes(axes, "Is the STD right?", "norm of the STD, units of action", "error, root mean square")
    axes.legend(frameon=False, fontsize=8)
    save_png(figure, path)
