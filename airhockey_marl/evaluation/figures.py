"""Figures of the league report and of TensorBoard, and an animated match.

matplotlib is imported where it draws: training imports this module and may show no pictures.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from PIL import Image

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.rendering import draw_table
from airhockey_marl.envs.world import World, round_steps
from airhockey_marl.evaluation.matches import FRAME_SKIP
from airhockey_marl.evaluation.policy_std import SITUATIONS
from airhockey_marl.evaluation.ratings import Proportion, win_rates
from airhockey_marl.experiment.html import number
from airhockey_marl.experiment.plotting import (
    BLUE,
    GRAY,
    GREEN,
    INK,
    LIGHT_GRAY,
    ORANGE,
    PINK,
    SKY,
    YELLOW,
    new_figure,
    percent,
    style_axes,
)
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.players import rollout, stochastic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

SCRIPT_COLORS = (YELLOW, GREEN, PINK, ORANGE, SKY, GRAY)
MAX_NUMBERS, MAX_LABELS = 12, 26  # members of a payoff matrix that has numbers in its cells, labels along its sides
ROUND_SECONDS = 60.0  # s, of a film's rounds


def member_label(member: PlayerId) -> str:
    """The name of a league member in running text."""
    return f"“{member}”" if isinstance(member, str) else f"generation {member}"


@cache
def loss_to_win() -> Colormap:
    """Colors of win rates: orange loses, white is even, blue wins."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("loss_to_win", ["#A84300", ORANGE, "#F7F7F7", BLUE, "#004B78"])


def _heat_map(width: float, height: float, shares: np.ndarray, label: str, **options: Any) -> tuple[Figure, Axes]:
    """A figure of win rates (rows, columns) as colors; NaN are gray."""
    figure = new_figure(width, height)
    axes = figure.subplots()
    axes.set_facecolor(LIGHT_GRAY)
    image = axes.imshow(shares, cmap=loss_to_win(), vmin=0, vmax=1, **options)
    figure.colorbar(image, ax=axes, shrink=0.75, label=label, ticks=[0, 0.5, 1], format=percent())
    axes.spines[:].set_visible(False)
    return figure, axes


def payoff_figure(members: Sequence[PlayerId], score: np.ndarray) -> Figure:
    """Heat map of win rates, rows against columns, from `score` (k, k, 3), see `ratings.payoff`."""
    shares, k = win_rates(score), len(members)
    size = min(8.6, 3.6 + 0.32 * k)
    figure, axes = _heat_map(size + 0.9, size, shares, "decided rounds that the row wins")
    generations = sum(not isinstance(member, str) for member in members)
    every = -(-generations // MAX_LABELS)
    ticks = [*range(0, generations - every, max(every, 1)), *range(max(generations - 1, 0), k)]
    labels = [str(members[i]) for i in ticks]
    axes.set_xticks(ticks, labels, rotation=90 if any(len(label) > 3 for label in labels) else 0)
    axes.set_yticks(ticks, labels)
    axes.tick_params(labelsize=9 if k <= 16 else 8, length=2)
    axes.set_xlabel("against generation (or script)")
    axes.set_ylabel("generation (or script)")
    if 0 < generations < k:
        for line in (axes.axhline, axes.axvline):
            line(generations - 0.5, color=INK, linewidth=0.9)
    if k <= MAX_NUMBERS:
        for row, column in np.argwhere(np.isfinite(shares)):
            share = shares[row, column]
            color = "white" if abs(share - 0.5) > 0.22 else INK
            text = f"{share:.2f}".removeprefix("0").replace("1.00", "1")
            axes.text(column, row, text, ha="center", va="center", fontsize=9, color=color)
    return figure


def rating_figure(ratings: pd.DataFrame, matches: pd.DataFrame | None = None) -> Figure:
    """Ratings of the generations with 95 % intervals, and of the scripted players as horizontal lines.

    Both tables have the columns member, rating, low, high; that of the matches played during training is a second line.
    """
    figure = new_figure(9.2, 4.6)
    axes = figure.subplots()
    learned, scripted = _split_members(ratings)
    generation = learned["member"].astype(int)
    if matches is not None:
        training, _ = _split_members(matches)
        style = {"color": GRAY, "linewidth": 1.1, "label": "from the matches kept during training"}
        axes.plot(training["member"].astype(int), training["rating"], **style)
    axes.fill_between(generation, learned["low"], learned["high"], color=BLUE, alpha=0.18, linewidth=0)
    style = {"color": BLUE, "marker": "o", "markersize": 4, "linewidth": 1.6, "label": "from the payoff matrix"}
    axes.plot(generation, learned["rating"], **style)
    for row, color in zip(scripted.itertuples(), itertools.cycle(SCRIPT_COLORS), strict=False):
        axes.axhline(row.rating, color=color, linewidth=1.4, linestyle="--")
        axes.axhspan(row.low, row.high, color=color, alpha=0.12, linewidth=0)
        place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        axes.annotate(row.member, (1.0, row.rating), (5, 0), va="center", color=color, fontsize=9.5, **place)
    axes.set_xlabel("generation")
    axes.set_ylabel(f"Elo points above {member_label(ratings['member'].iloc[0])}")
    if matches is not None:
        figure.legend(frameon=False, fontsize=9, loc="outside upper left", ncols=2)
    style_axes(axes)
    return figure


def win_rates_figure(matches: pd.DataFrame) -> Figure:
    """Heat map of win rates: a column per generation, when it was the newest, and a row per opponent."""
    from matplotlib.ticker import MaxNLocator

    scripts = [member for member in dict.fromkeys(matches["opponent"]) if isinstance(member, str)]
    opponents = [*sorted(set(matches["opponent"]) - set(scripts)), *scripts]
    first, last, k = matches["generation"].min(), matches["generation"].max(), len(opponents)
    shares = np.full((k, last - first + 1), np.nan)  # NaN: not played, or no round decided
    for row in matches[matches["won"] + matches["lost"] > 0].itertuples():
        shares[opponents.index(row.opponent), row.generation - first] = row.won / (row.won + row.lost)
    options = {"extent": (first - 0.5, last + 0.5, k - 0.5, -0.5), "aspect": "auto", "interpolation": "nearest"}
    # small: a card of TensorBoard is 350 px wide
    figure, axes = _heat_map(4.6, 1.2 + 0.2 * k, shares, "decided rounds won", **options)
    axes.set_yticks(range(k), map(str, opponents), fontsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if 0 < len(scripts) < k:
        axes.axhline(k - len(scripts) - 0.5, color=INK, linewidth=0.9)
    axes.set_xlabel("generation, when it was the newest")
    axes.set_ylabel("against")
    return figure


def precision_figure(table_of_std: pd.DataFrame, maps: tuple[np.ndarray, np.ndarray], table: TableSpec) -> Figure:
    """Mean STD of the actions in each situation with its interval, and as maps over the position of the puck.

    Args:
        table_of_std: see `policy_std.std_by_situation`.
        maps: see `policy_std.std_map`, of an approaching puck and of one that departs or rests.
    """
    from matplotlib.ticker import FuncFormatter

    figure = new_figure(11.6, 3.1)
    left, *rest = figure.subplots(1, 3, width_ratios=[1.35, 1.7, 1.7])
    rows = table_of_std.set_index("situation").loc[list(SITUATIONS)]
    places = np.arange(len(rows))
    left.bar(places, rows["std"], width=0.68, color=[BLUE, GREEN, YELLOW, GRAY])
    finite_rows = rows["std"].notna().to_numpy()
    ends = np.abs(rows[["low", "high"]].sub(rows["std"], axis=0).to_numpy().T)
    whiskers = {"fmt": "none", "ecolor": INK, "elinewidth": 1.1, "capsize": 4}
    left.errorbar(places[finite_rows], rows["std"][finite_rows], ends[:, finite_rows], **whiskers)
    left.set_xticks(places, [name.replace(" a ", " a\n").replace("far ", "far\n") for name in SITUATIONS], fontsize=9)
    left.set_ylabel("mean STD, action units")
    left.set_ylim(bottom=0)
    style_axes(left)
    finite = np.concatenate([values[np.isfinite(values)] for values in maps])
    scale = {"vmin": finite.min(), "vmax": finite.max()} if finite.size else {"vmin": 0, "vmax": 1}
    extent = (-table.length / 2, table.length / 2, -table.width / 2, table.width / 2)
    for axes, values, title in zip(rest, maps, ("puck coming", "puck going or at rest"), strict=True):
        axes.set_facecolor(LIGHT_GRAY)
        image = axes.imshow(values, origin="lower", extent=extent, cmap="viridis", **scale)
        axes.axvline(0, color="white", linewidth=0.8)
        axes.plot([extent[0]] * 2, [-table.goal / 2, table.goal / 2], color=ORANGE, linewidth=6, clip_on=False)
        axes.set_title(title, fontsize=10)
        axes.set_xticks([-table.length / 4, table.length / 4], ["own side", "other side"], fontsize=9)
        axes.tick_params(axis="x", length=0)
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=rest, shrink=0.62, label="mean STD", format=FuncFormatter(lambda std, _: number(std)))
    return figure


def best_response_figure(results: Sequence[tuple[int, Proportion]]) -> Figure:
    """Win rate of a best response against the last generation, over its steps of training."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    steps, shares = zip(*results, strict=True)
    value, low, high, _ = zip(*shares, strict=True)
    figure = new_figure(6.4, 3.2)
    axes = figure.subplots()
    axes.axhline(0.5, color=GRAY, linewidth=0.8)
    ends = np.abs(np.array([low, high]) - value)  # bars: a single result has an interval too
    axes.errorbar(steps, value, ends, color=ORANGE, marker="o", markersize=4, linewidth=1.6, elinewidth=1.1, capsize=3)
    axes.set_ylim(-0.02, 1.02)
    axes.yaxis.set_major_formatter(percent())
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps / 1e6:g} M"))
    axes.set_xlabel("steps that the best response has learned")
    axes.set_ylabel("decided rounds it wins")
    style_axes(axes)
    return figure


@torch.no_grad()
def film(
    league: League,
    members: tuple[PlayerId, PlayerId],
    seed: int,
    seconds: float = 10.0,
    width: int = 320,
    frame_skip: int = FRAME_SKIP,
    arm: HandArm | None = None,
) -> bytes:
    """An animated GIF of a match between two members, left and right: round after round, a picture per decision.

    Both sample, as in training, with random numbers of their own that follow from the seed.
    """
    left, right = (
        stochastic(league.opponent_batch([member]), torch.Generator().manual_seed(seed + seat))
        for seat, member in enumerate(members)
    )
    world = World(1, seed=seed, arm=arm)
    world.new_rounds()
    between, palette = frame_skip * world.table.tick, None
    steps = rollout(world, (left, right), frame_skip, round_steps(ROUND_SECONDS, world.table, frame_skip))
    pictures = []
    for _ in range(max(1, round(seconds / between))):
        picture = Image.fromarray(draw_table(world.bodies[0], world.table, width))
        palette = palette or picture.quantize(32)  # one for all pictures: they flicker otherwise
        pictures.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
        next(steps)
    gif = io.BytesIO()
    pictures[0].save(gif, "GIF", save_all=True, append_images=pictures[1:], duration=round(1000 * between), loop=0)
    return gif.getvalue()


def _split_members(ratings: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The rows of the generations, and those of the scripted players."""
    scripted = ratings["member"].map(lambda member: isinstance(member, str)).astype(bool)
    return ratings[~scripted], ratings[scripted]
