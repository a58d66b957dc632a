"""Figures of the prediction report: errors by horizon, adaptation to people, and calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from airhockey_marl.experiment.plotting import BLUE, GRAY, GREEN, ORANGE, label_axes, legend_below, new_figure, save_png

DIVERGED = 1e6  # units of action: errors of a model that UA has made diverge, which no axis shows
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
            horizons, (mean, half) = [row["ahead_s"] for row in rows], _means(rows, measure)
            axes.errorbar(horizons, mean, half, color=color, ls=style, capsize=3, marker="o", ms=3, label=labels[name])
        label_axes(axes, title, "s ahead", y_label)
    legend_below(figure, panels[0].get_legend_handles_labels()[0])
    panels[1].axhline(0.0, color=GRAY, lw=0.8)
    of_models = [row for row in results["ahead"] if row["predictor"] not in ("persistence", "extrapolation")]
    mean, half = _means(of_models, "gain")
    panels[1].set_ylim(bottom=min(-0.1, 1.15 * np.nan_to_num(mean - half, nan=0.0).min(initial=0.0)))
    save_png(figure, path)


def _means(rows: Sequence[Mapping], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Means (rows,) of a measure, and halves of their intervals; NaN of what is not finite or beyond `DIVERGED`."""
    mean, high = (np.array([row[measure][key] for row in rows], dtype=float) for key in ("mean", "high"))
    half = high - mean
    return np.where(np.abs(mean) < DIVERGED, mean, np.nan), np.where(np.abs(half) < DIVERGED, half, np.nan)


def draw_adaptation(results: Mapping, labels: Mapping[str, str], path: Path) -> None:
    """Errors of each person's model on each person, and errors by minutes of play and by steps of UA."""
    figure = new_figure(11, 3.4)
    panels = figure.subplots(1, 3)
    matrix = np.array(results["matrix"], dtype=float)
    excess = 100 * (matrix / matrix.diagonal() - 1)
    largest = np.abs(excess[np.isfinite(excess)]).max(initial=1e-9)
    image = panels[0].imshow(excess, cmap="PuOr_r", vmin=-largest, vmax=largest)
    figure.colorbar(image, ax=panels[0], label="% more than their own model's", shrink=0.85)
    panels[0].xaxis.get_major_locator().set_params(integer=True)
    panels[0].yaxis.get_major_locator().set_params(integer=True)
    label_axes(panels[0], "Error of the row's model on the column", "person", "model adapted to")
    before = next(row["rmse"]["mean"] for row in results["ahead"] if row["predictor"] == "before_ua")
    x_labels = {"minutes": "minutes of play", "steps": "steps of gradient descent"}
    for axes, (key, label) in zip(panels[1:], x_labels.items(), strict=True):
        (mean, half), x = _means(results[key], "rmse"), [row[key] for row in results[key]]
        axes.errorbar(x, mean, half, color=BLUE, capsize=3, marker="o", ms=3, label="after UA")
        axes.axhline(before, color=ORANGE, ls="--", label="before UA")
        label_axes(axes, f"Error by {label} for UA", label, "units of action")
        axes.set_xscale("log")
        axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.minorticks_off()
        if np.nan_to_num(mean).max(initial=0.0) > 1.0:  # errors as wide as the table
            axes.set_yscale("log")
    legend_below(figure, panels[1].get_legend_handles_labels()[0])
    save_png(figure, path)


def draw_reliability(results: Mapping, labels: Mapping[str, str], path: Path) -> None:
    """Root mean square error against predicted STD: calibrated on the diagonal."""
    figure = new_figure(4.4, 4)
    axes = figure.subplots()
    for name, pairs in results["reliability"].items():
        color, style = STYLES[name]
        said, seen = (np.array(pairs[key], dtype=float) for key in ("said", "seen"))
        known = np.isfinite(said) & np.isfinite(seen)
        axes.loglog(said[known], seen[known], color=color, ls=style, marker="o", ms=4, label=labels[name])
    ends = np.array([*axes.get_xlim(), *axes.get_ylim()])
    axes.plot([ends.min(), ends.max()], [ends.min(), ends.max()], color=GRAY, lw=0.8)
    label_axes(axes, "Is the STD right?", "norm of the STD, units of action", "error, root mean square")
    legend_below(figure, axes.get_legend_handles_labels()[0])
    save_png(figure, path)
