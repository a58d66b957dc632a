"""Figures of simulated people: how they reach, give way, stand and shoot."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from airhockey_marl.files import replacing
from airhockey_marl.table import Table
from guidance.styles import STEEP, blows
from guidance.users.laboratory import Reaches

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a8f98"  # Okabe and Ito's, and a neutral one
SOFT = 0.8  # m/s of the puck: slower blows were meant to stop it
SHOTS = ("soft", "straight", "over the left wall", "over the right wall")


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)
    plt.close(figure)


def plain(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    """Title, labels, and no box."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def draw_speeds(data: Reaches, path: Path) -> None:
    """Speed profiles of reaches, each over duration and peak, beside the minimum-jerk one (Flash & Hogan 1985)."""
    share = np.linspace(0.0, 1.0, 60)
    profiles = []
    for index in np.ndindex(*data.jump.shape):
        speed = data.profile(index)
        if len(speed) > 4:
            profiles.append(np.interp(share, np.linspace(0, 1, len(speed)), speed / speed.max()))
    low, middle, high = np.percentile(profiles, [10, 50, 90], axis=0)
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    axes.fill_between(share, low, high, color=BLUE, alpha=0.2, lw=0, label="80 % of reaches")
    axes.plot(share, middle, color=BLUE, lw=2, label="median")
    bell = share**2 * (1 - share) ** 2
    axes.plot(share, bell / bell.max(), color=GREY, ls="--", label="minimum jerk")
    plain(axes, f"Speed of the hand in {len(profiles)} reaches", "share of the movement", "share of its peak")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def draw_push(pushed: Mapping[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """How far hands that hold still give way to 2 N for a second, by variant: median and quartiles."""
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    labels = {"V0": "V0 passive arm", "V1": "V1 comply or resist", "V2": "V2 and goal sharing"}
    for (name, (seconds, off)), colour in zip(pushed.items(), (GREY, BLUE, ORANGE), strict=True):
        low, middle, high = 1e3 * np.percentile(off, [25, 50, 75], axis=0)
        axes.fill_between(seconds, low, high, color=colour, alpha=0.15, lw=0)
        axes.plot(seconds, middle, color=colour, lw=2, label=labels.get(name, name))
    axes.axvspan(0.0, 1.0, color="#f0f1f4", zorder=0)
    axes.set_xlim(-0.2, 1.4)
    plain(axes, "A push of 2 N for one second", "s since the push began", "mm that the hand gives way")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def draw_places(play: Mapping[str, Tensor], table: Table, path: Path) -> None:
    """Where each archetype keeps its paddle: a heat map of the own half per archetype, on one scale."""
    edges = np.linspace(-table.length / 2, 0.0, 41), np.linspace(-table.width / 2, table.width / 2, 43)
    places = {name: seen[..., :2].flatten(0, -2).T.numpy() for name, seen in play.items()}
    maps = {name: np.histogram2d(x, y, bins=edges, density=True)[0] for name, (x, y) in places.items()}
    top = np.percentile(np.stack(list(maps.values())), 99.5)
    figure, panels = plt.subplots(
        1, len(maps), figsize=(1.7 * len(maps) + 0.8, 2.3), layout="constrained", squeeze=False
    )
    for axes, (name, density) in zip(panels[0], maps.items(), strict=True):
        shown = axes.pcolormesh(*edges, density.T, cmap="Blues", vmin=0, vmax=top, rasterized=True)
        axes.plot([-table.length / 2] * 2, [-table.goal / 2, table.goal / 2], color=ORANGE, lw=4)
        axes.set_aspect("equal")
        plain(axes, name.replace("_", " "))
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(shown, ax=panels[0], label="density, 1/m²", shrink=0.8)
    save(figure, path)


def kinds(observation: Tensor, table: Table) -> np.ndarray:
    """(4,) shares of the blows of some people (n, ticks, 12) by `SHOTS`: how the puck left the paddle."""
    hit = np.concatenate([blows(seen, table) for seen in observation.numpy().astype(np.float64)])
    soft = np.linalg.norm(hit, axis=-1) < SOFT
    left, right = hit[:, 1] > STEEP * hit[:, 0], hit[:, 1] < -STEEP * hit[:, 0]
    counts = [soft.sum(), (~soft & ~left & ~right).sum(), (~soft & left).sum(), (~soft & right).sum()]
    return np.array(counts) / max(len(hit), 1)


def draw_shots(play: Mapping[str, Tensor], table: Table, path: Path) -> None:
    """Blows by kind, a bar per archetype."""
    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    begin = np.zeros(len(play))
    shares = np.array([kinds(seen, table) for seen in play.values()])
    names = [name.replace("_", " ") for name in play]
    for kind, share, colour in zip(SHOTS, shares.T, (GREY, BLUE, ORANGE, GREEN), strict=True):
        axes.barh(names, share, left=begin, color=colour, label=kind)
        begin += share
    axes.invert_yaxis()
    plain(axes, "How the puck leaves the paddle", "share of blows")
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.45, -0.2))
    save(figure, path)


LOOKS = {
    "persistence": (GREY, ":"),
    "extrapolation": (GREY, "-"),
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
        for name, (colour, style) in LOOKS.items():
            rows = [row for row in found["ahead"] if row["predictor"] == name]
            at, mean = [row["ahead_s"] for row in rows], np.array([row[measure]["mean"] for row in rows])
            half = [row[measure]["high"] - row[measure]["mean"] for row in rows]
            axes.errorbar(at, mean, half, color=colour, ls=style, capsize=3, marker="o", ms=3, label=names[name])
        plain(axes, title, "s ahead", label)
    panels[0].legend(frameon=False, fontsize=8)
    panels[1].axhline(0.0, color=GREY, lw=0.8)
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
        colour, style = LOOKS[name]
        axes.loglog(pairs["said"], pairs["seen"], color=colour, ls=style, marker="o", ms=4, label=names[name])
    ends = np.array([*axes.get_xlim(), *axes.get_ylim()])
    axes.plot([ends.min(), ends.max()], [ends.min(), ends.max()], color=GREY, lw=0.8)
    plain(axes, "Is the STD right?", "norm of the STD, units of action", "error, root mean square")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)
