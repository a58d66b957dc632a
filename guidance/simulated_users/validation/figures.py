"""Figures of simulated people: reaches, response to a push, paddle positions, shots, and ratings of anchor forces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.plotting import BLUE, GRAY, GREEN, ORANGE, label_axes, new_figure, save_png
from guidance.simulated_users.ratings import RATINGS, SIGNALS, expected_points
from guidance.simulated_users.validation.motor_tasks import Reaches
from guidance.simulated_users.validation.playstyles import STEEP, shot_velocities
from guidance.simulated_users.validation.rating_anchors import ANCHORS, STANDARD_ERRORS

SOFT = 0.8  # m/s of the puck after a touch; below, the touch was meant to stop it
SHOTS = ("soft", "straight", "over the left wall", "over the right wall")


def draw_speeds(data: Reaches, path: Path) -> None:
    """Speed profiles of reaches, scaled to duration and peak, and that of minimum jerk (Flash & Hogan 1985)."""
    share = np.linspace(0.0, 1.0, 60)
    profiles = []
    for index in np.ndindex(*data.jump.shape):
        speed = data.profile(index)
        if len(speed) > 4:
            profiles.append(np.interp(share, np.linspace(0, 1, len(speed)), speed / speed.max()))
    low, middle, high = np.percentile(profiles, [10, 50, 90], axis=0)
    figure = new_figure(5, 3.4)
    axes = figure.subplots()
    axes.fill_between(share, low, high, color=BLUE, alpha=0.2, lw=0, label="80 % of reaches")
    axes.plot(share, middle, color=BLUE, lw=2, label="median")
    bell = share**2 * (1 - share) ** 2
    axes.plot(share, bell / bell.max(), color=GRAY, ls="--", label="minimum jerk")
    label_axes(axes, f"Speed of the hand in {len(profiles)} reaches", "share of the movement", "share of its peak")
    axes.legend(frameon=False, fontsize=8)
    save_png(figure, path)


def draw_push(responses: Mapping[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Displacement of a still hand by 2 N for one second, by force-response variant: median and quartiles."""
    figure = new_figure(5, 3.4)
    axes = figure.subplots()
    for (name, (seconds, displacement)), color in zip(responses.items(), (GRAY, BLUE, ORANGE), strict=True):
        low, middle, high = 1e3 * np.percentile(displacement, [25, 50, 75], axis=0)
        axes.fill_between(seconds, low, high, color=color, alpha=0.15, lw=0)
        axes.plot(seconds, middle, color=color, lw=2, label=name.replace("_", " "))
    axes.axvspan(0.0, 1.0, color="#f0f1f4", zorder=0)
    axes.set_xlim(-0.2, 1.4)
    label_axes(axes, "A push of 2 N for one second", "s since the push began", "mm that the hand gives way")
    axes.legend(frameon=False, fontsize=8)
    save_png(figure, path)


def draw_places(play: Mapping[str, Tensor], table: TableSpec, path: Path) -> None:
    """Paddle positions of each archetype: heat maps of its half of the table, on one scale."""
    edges = np.linspace(-table.length / 2, 0.0, 41), np.linspace(-table.width / 2, table.width / 2, 43)
    places = {name: observation[..., :2].flatten(0, -2).T.numpy() for name, observation in play.items()}
    maps = {name: np.histogram2d(x, y, bins=edges, density=True)[0] for name, (x, y) in places.items()}
    top = np.percentile(np.stack(list(maps.values())), 99.5)
    figure = new_figure(1.7 * len(maps) + 0.8, 2.3)
    panels = figure.subplots(1, len(maps), squeeze=False)
    for axes, (name, density) in zip(panels[0], maps.items(), strict=True):
        image = axes.pcolormesh(*edges, density.T, cmap="Blues", vmin=0, vmax=top, rasterized=True)
        axes.plot([-table.length / 2] * 2, [-table.goal / 2, table.goal / 2], color=ORANGE, lw=4)
        axes.set_aspect("equal")
        label_axes(axes, name.replace("_", " "))
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(image, ax=panels[0], label="density, 1/m²", shrink=0.8)
    save_png(figure, path)


def shot_shares(observation: Tensor, table: TableSpec) -> np.ndarray:
    """Shares (4,) of paddle touches by kind of shot, `SHOTS`, from observations (n, ticks, 12)."""
    velocity = np.concatenate([shot_velocities(one, table) for one in observation.numpy().astype(np.float64)])
    soft = np.linalg.norm(velocity, axis=-1) < SOFT
    left, right = velocity[:, 1] > STEEP * velocity[:, 0], velocity[:, 1] < -STEEP * velocity[:, 0]
    counts = [soft.sum(), (~soft & ~left & ~right).sum(), (~soft & left).sum(), (~soft & right).sum()]
    return np.array(counts) / max(len(velocity), 1)


def draw_shots(play: Mapping[str, Tensor], table: TableSpec, path: Path) -> None:
    """Kinds of shots, a bar per archetype."""
    figure = new_figure(6, 3.2)
    axes = figure.subplots()
    left = np.zeros(len(play))
    shares = np.array([shot_shares(observation, table) for observation in play.values()])
    names = [name.replace("_", " ") for name in play]
    for kind, share, color in zip(SHOTS, shares.T, (GRAY, BLUE, ORANGE, GREEN), strict=True):
        axes.barh(names, share, left=left, color=color, label=kind)
        left += share
    axes.invert_yaxis()
    label_axes(axes, "How the puck leaves the paddle", "share of shots")
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.45, -0.2))
    save_png(figure, path)


def draw_anchors(table: pd.DataFrame, path: Path) -> None:
    """Rating proxies over the strength of each anchor force under one response to forces, from no force on.

    Args:
        table: rows of one variant of `AnchorResults.table`.
    """
    neutral = expected_points(np.zeros(len(SIGNALS)), dict.fromkeys(SIGNALS, 1.0))
    figure = new_figure(10, 2.8)
    panels = figure.subplots(1, len(RATINGS), sharey=True)
    for axes, name, start in zip(panels, RATINGS, neutral, strict=True):
        for anchor, color in zip(ANCHORS, (GREEN, BLUE, GRAY, ORANGE), strict=True):
            rows = table[table["anchor"] == anchor]
            mean, error = ([first, *rows[column]] for first, column in ((start, name), (0.0, f"{name}_se")))
            error = STANDARD_ERRORS * np.array(error)
            axes.errorbar([0.0, *rows["grade"]], mean, error, color=color, label=anchor, capsize=2)
        axes.set_ylim(1, 7)
        label_axes(axes, f"{name} (PROXY)", "share of full strength", "points" if axes is panels[0] else "")
    panels[0].legend(frameon=False, fontsize=8, loc="lower left")
    save_png(figure, path)
