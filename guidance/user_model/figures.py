"""Figures of what a user model predicts."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from guidance.simulated_users.validation.figures import BLUE, GRAY, GREEN, ORANGE, plain, save

LOOKS = {
    "persistence": (GRAY, ":"),
    "extrapolation": (GRAY, "-"),
    "supervised": (GREEN, "-"),
    "before_ua": (ORANGE, "--"),
    "after_ua": (BLUE, "-"),
}


def draw_ahead(found: Mapping, names: Mapping[str, str], path: Path) -> None:
    """Errors, and gains over extrapolation, by time ahead."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for axes, measure, title, label in (
        (panels[0], "rmse", "Error", "root mean square, units of action"),
        (panels[1], "gain", "Gain over moving the paddle on", "share of that error"),
    ):
        for name, (color, style) in LOOKS.items():
            rows = [row for row in found["ahead"] if row["predictor"] == name]
            at, mean = [row["ahead_s"] for row in rows], np.array([row[measure]["mean"] for row in rows])
            half = [row[measure]["high"] - row[measure]["mean"] for row in rows]
            axes.errorbar(at, mean, half, color=color, ls=style, capsize=3, marker="o", ms=3, label=names[name])
        plain(axes, title, "s ahead", label)
    panels[0].legend(frameon=False, fontsize=8)
    panels[1].axhline(0.0, color=GRAY, lw=0.8)
    low = min(row["gain"]["low"] for row in found["ahead"] if row["predictor"] not in ("persistence", "extrapolation"))
    panels[1].set_ylim(bottom=min(-0.1, 1.15 * low))
    save(figure, path)


def draw_adaptation(found: Mapping, names: Mapping[str, str], path: Path) -> None:
    """Whose model predicts whom; and errors by minutes of play and by steps of UA."""
    figure, panels = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    matrix = np.array(found["matrix"])
    excess = 100 * (matrix / matrix.diagonal() - 1)
    most = max(np.abs(excess).max(), 1e-9)
    shown = panels[0].imshow(excess, cmap="PuOr_r", vmin=-most, vmax=most)
    figure.colorbar(shown, ax=panels[0], label="% more than their own model's", shrink=0.85)
    panels[0].xaxis.get_major_locator().set_params(integer=True)
    panels[0].yaxis.get_major_locator().set_params(integer=True)
    plain(panels[0], "Error of the row's model on the column", "person", "model adapted to")
    before = next(row["rmse"]["mean"] for row in found["ahead"] if row["predictor"] == "before_ua")
    labels = {"minutes": "minutes of play", "steps": "steps of gradient descent"}
    for axes, (key, label) in zip(panels[1:], labels.items(), strict=True):
        rows = [row for row in found[key] if row["rmse"]["high"] is not None]  # where it did not diverge
        mean = [row["rmse"]["mean"] for row in rows]
        half = [row["rmse"]["high"] - row["rmse"]["mean"] for row in rows]
        at = [row[key] for row in rows]
        axes.errorbar(at, mean, half, color=BLUE, capsize=3, marker="o", ms=3, label="after UA")
        axes.axhline(before, color=ORANGE, ls="--", label="before UA")
        plain(axes, f"Error by {label} for UA", label, "units of action")
        axes.set_xscale("log")
        axes.set_xticks(at, [f"{value:g}" for value in at])
        axes.minorticks_off()
    if max(mean) > 1.0:  # as wide as the whole table
        panels[2].set_yscale("log")
    panels[1].legend(frameon=False, fontsize=8)
    save(figure, path)


def draw_reliability(found: Mapping, names: Mapping[str, str], path: Path) -> None:
    """What the STD says against what the errors are: on the diagonal where it is right."""
    figure, axes = plt.subplots(figsize=(4.4, 4), layout="constrained")
    for name, pairs in found["reliability"].items():
        color, style = LOOKS[name]
        axes.loglog(pairs["said"], pairs["seen"], color=color, ls=style, marker="o", ms=4, label=names[name])
    ends = np.array([*axes.get_xlim(), *axes.get_ylim()])
    axes.plot([ends.min(), ends.max()], [ends.min(), ends.max()], color=GRAY, lw=0.8)
    plain(axes, "Is the STD right?", "norm of the STD, units of action", "error, root mean square")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)
