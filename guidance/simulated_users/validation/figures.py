"""Figures of simulated people: how they reach, give way, stand and shoot."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.files import atomic_write
from guidance.simulated_users.validation.motor_tasks import Reaches
from guidance.simulated_users.validation.playstyles import STEEP, blows

matplotlib.use("Agg")

BLUE, ORANGE, GREEN, GRAY = "#0072B2", "#D55E00", "#009E73", "#8a8f98"  # Okabe and Ito's, and a neutral one
SOFT = 0.8  # m/s of the puck: slower blows were meant to stop it
SHOTS = ("soft", "straight", "over the left wall", "over the right wall")


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure, whole or not at all."""
    with atomic_write(path) as temporary:
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
    axes.plot(share, bell / bell.max(), color=GRAY, ls="--", label="minimum jerk")
    plain(axes, f"Speed of the hand in {len(profiles)} reaches", "share of the movement", "share of its peak")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def draw_push(pushed: Mapping[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """How far hands that hold still give way to 2 N for a second, by variant: median and quartiles."""
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    labels = {"V0": "V0 passive arm", "V1": "V1 comply or resist", "V2": "V2 and goal sharing"}
    for (name, (seconds, off)), color in zip(pushed.items(), (GRAY, BLUE, ORANGE), strict=True):
        low, middle, high = 1e3 * np.percentile(off, [25, 50, 75], axis=0)
        axes.fill_between(seconds, low, high, color=color, alpha=0.15, lw=0)
        axes.plot(seconds, middle, color=color, lw=2, label=labels.get(name, name))
    axes.axvspan(0.0, 1.0, color="#f0f1f4", zorder=0)
    axes.set_xlim(-0.2, 1.4)
    plain(axes, "A push of 2 N for one second", "s since the push began", "mm that the hand gives way")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def draw_places(play: Mapping[str, Tensor], table: TableSpec, path: Path) -> None:
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


def kinds(observation: Tensor, table: TableSpec) -> np.ndarray:
    """(4,) shares of the blows of some people (n, ticks, 12) by `SHOTS`: how the puck left the paddle."""
    hit = np.concatenate([blows(seen, table) for seen in observation.numpy().astype(np.float64)])
    soft = np.linalg.norm(hit, axis=-1) < SOFT
    left, right = hit[:, 1] > STEEP * hit[:, 0], hit[:, 1] < -STEEP * hit[:, 0]
    counts = [soft.sum(), (~soft & ~left & ~right).sum(), (~soft & left).sum(), (~soft & right).sum()]
    return np.array(counts) / max(len(hit), 1)


def draw_shots(play: Mapping[str, Tensor], table: TableSpec, path: Path) -> None:
    """Blows by kind, a bar per archetype."""
    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    begin = np.zeros(len(play))
    shares = np.array([kinds(seen, table) for seen in play.values()])
    names = [name.replace("_", " ") for name in play]
    for kind, share, color in zip(SHOTS, shares.T, (GRAY, BLUE, ORANGE, GREEN), strict=True):
        axes.barh(names, share, left=begin, color=color, label=kind)
        begin += share
    axes.invert_yaxis()
    plain(axes, "How the puck leaves the paddle", "share of blows")
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.45, -0.2))
    save(figure, path)
