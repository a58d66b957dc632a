"""Films of a recorded game: single frames, an animated film, and a sheet of six frames.

They are drawn from a table of ticks, see `guidance.sessions.tick_log`. For a simulated person, the table also has the
desired position of the hand (wanted_x, wanted_y, in m of the hand) and the intention.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from math import hypot
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from PIL import Image, ImageDraw, ImageFont, ImageOps

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec, action_range
from airhockey_marl.envs.rendering import COLORS, FELT, LINE, RIM, SMOOTHING, View, draw_bodies, empty_table
from guidance.display.scene import (
    ARROW,
    FORCE,
    GRAY,
    HAND,
    INK,
    PAPER,
    TARGETS,
    WEIGHT_LABELS,
    Color,
    Pixel,
    SceneDrawer,
    mix,
)
from guidance.simulated_users.arm import HAND_REACH

INTENTIONS = {
    "WAIT": "wait before the goal",
    "SHADOW": "follow the puck sideways",
    "PRESS": "press at the half-way line",
    "BLOCK": "block the shot",
    "CONTROL": "stop the puck softly",
    "SMASH": "smash at the goal",
    "SMASH_BANK_LEFT": "smash over the left wall",
    "SMASH_BANK_RIGHT": "smash over the right wall",
    "RECOVER": "get back behind the puck",
}
TRAIL = 15  # ticks of the puck's trail
GOAL_SHOWN = 800  # ms for which a goal is shown
MIN_WIDTH = 640  # px, minimum width, at which text is 12 pixels high
SHEET_FRAMES, SHEET_STEP = 6, 20  # frames of a sheet, and ticks between them


@dataclass(frozen=True)
class FilmInfo:
    """What is the same in every frame.

    Attributes:
        table: of the game.
        title: label of the condition.
        player, opponent: names of the left and the right player.
        guiding_models: the keys of `TARGETS` whose predictions the force is computed from.
        is_adapted: whether the predicted action is that of a model adapted to this person.
        width: pixels, of a frame.
        is_simulated: whether the person is simulated, so that desired position and intention are known.
    """

    table: TableSpec
    title: str
    player: str
    opponent: str
    guiding_models: frozenset[str]
    is_adapted: bool
    width: int
    is_simulated: bool = True


def _color(model: str, info: FilmInfo) -> Color:
    """Color of a prediction; pale if it does not enter the force."""
    return TARGETS[model] if model in info.guiding_models else mix(TARGETS[model], FELT, 0.4)


def _pair(tick: pd.Series, name: str) -> np.ndarray:
    return np.array([tick[f"{name}_x"], tick[f"{name}_y"]], dtype=float)


def draw_play(ticks: pd.DataFrame, index: int, info: FilmInfo, width: int) -> Image.Image:
    """The table at one tick, `width` pixels wide: bodies, predictions, desired position and force."""
    tick, view = ticks.iloc[index], View(info.table, width)
    image = empty_table(view)
    drawer = SceneDrawer(image, view.scale)
    middle, half = action_range(info.table)
    recent = ticks.iloc[max(index - TRAIL, 0) : index + 1]
    trail = recent.loc[recent["round"] == tick["round"], ["puck_x", "puck_y"]].to_numpy()
    drawer.line([view.pixel(*place) for place in trail], mix(COLORS[PUCK], FELT, 0.35), 3)
    targets = {model: view.pixel(*middle + half * _pair(tick, model)) for model in TARGETS}
    for model, at in targets.items():
        radii = half * _pair(tick, f"{model}_std") * view.scale
        drawer.ellipse(at, *radii, _color(model, info), model in info.guiding_models)
    paddle = view.pixel(*_pair(tick, "own"))
    if info.is_simulated:
        desired = view.pixel(*middle + half * _pair(tick, "wanted") / HAND_REACH)
        drawer.line([paddle, desired], HAND, 2)
    bodies = np.stack([_pair(tick, body) for body in ("own", "other", "puck")])
    if tick["goal"]:  # a row has the state at the beginning of its tick; a goal falls at its end
        bodies[PUCK] += info.table.tick * np.array([tick["puck_vx"], tick["puck_vy"]])
    draw_bodies(drawer.pen, view, bodies)
    edge = 10 * drawer.unit  # the symbol of a prediction off the table stays in the image
    for model, at in targets.items():
        inside = np.clip(at, edge, np.array(view.size) - edge)
        drawer.target(tuple(inside), model, _color(model, info))
    if info.is_simulated:
        drawer.cross(desired)
    drawer.arrow(paddle, _pair(tick, "force"))
    return image.reduce(SMOOTHING)


def draw_frame(ticks: pd.DataFrame, index: int, info: FilmInfo) -> Image.Image:
    """One frame of the film: score, table and legend."""
    size = max(12, round(info.width / 57))
    header = _draw_header(ticks.iloc[index], info.title, info.width, size)
    play, scale = draw_play(ticks, index, info, info.width), View(info.table, info.width).scale
    return _join([header, play, _draw_legend(info, info.width, size, scale)], 0)


def _ticks_before_goal(ticks: pd.DataFrame) -> np.ndarray:
    """Six ticks up to the person's first goal; without one, up to the opponent's first; without one, up to the end."""
    first = [int(np.argmax(ticks[goals] > 0)) for goals in ("won", "lost") if (ticks[goals] > 0).any()]
    last = [*first, len(ticks) - 1][0]
    return np.linspace(max(last - (SHEET_FRAMES - 1) * SHEET_STEP, 0), last, SHEET_FRAMES).round().astype(int)


def draw_sheet(ticks: pd.DataFrame, info: FilmInfo) -> Image.Image:
    """Six frames, the last of which shows a goal if there was one."""
    wide, gap = 2 * (3 * info.width // 4), info.width // 200
    width, size = wide // 2 - 2 * gap, max(12, round(wide / 80))
    panels = [
        _join([_draw_header(ticks.iloc[i], "", width, size), draw_play(ticks, i, info, width)], 0)
        for i in _ticks_before_goal(ticks)
    ]
    panels = [ImageOps.expand(panel, (gap, 0), PAPER) for panel in panels]
    title = Image.new("RGB", (wide, 3 * size), PAPER)
    text = f"{info.title}: {info.player} against {info.opponent}"
    ImageDraw.Draw(title).text((size, 1.5 * size), text, INK, _font(round(1.4 * size), True), anchor="lm")
    rows = [_join(panels[i : i + 2], 1) for i in range(0, SHEET_FRAMES, 2)]
    return _join([title, *rows, _draw_legend(info, wide, size, View(info.table, width).scale)], 0)


def save_film(
    path: Path,
    ticks: pd.DataFrame,
    info: FilmInfo,
    every: int,
    milliseconds: int,
    progress: Callable[[float], None] = lambda fraction: None,
) -> None:
    """Write an animated GIF with a frame per `every` ticks, shown for `milliseconds`, and a longer one per goal."""
    scored = ticks["goal"].to_numpy() != 0
    shown = np.flatnonzero((np.arange(len(ticks)) % every == every - 1) | scored)
    palette = _palette()

    def frames() -> Iterator[Image.Image]:
        for i, index in enumerate(shown):
            progress(i / len(shown))
            yield draw_frame(ticks, index, info).quantize(palette=palette, dither=Image.Dither.NONE)

    film = frames()
    durations = [GOAL_SHOWN if scored[index] else milliseconds for index in shown]
    next(film).save(path, "GIF", save_all=True, append_images=film, duration=durations, loop=0)


def _palette() -> Image.Image:
    """A palette of every color and its steps to the backgrounds; one for all frames, or the film would flicker."""
    colors = [*COLORS.values(), *TARGETS.values(), HAND, FORCE, INK, RIM, LINE]
    opacities = np.linspace(1, 0.2, 9)
    mixed = [mix(color, paper, opacity) for paper in (FELT, PAPER) for color in colors for opacity in opacities]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for color in (FELT, PAPER, GRAY, *mixed) for value in color])
    return palette


def _join(images: list[Image.Image], axis: int) -> Image.Image:
    """Join images vertically (axis 0) or horizontally (axis 1)."""
    return Image.fromarray(np.concatenate([np.asarray(image) for image in images], axis))


@lru_cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def _draw_header(tick: pd.Series, title: str, width: int, size: int) -> Image.Image:
    """Score, time, intention, force and its weights, in text of `size` pixels."""
    row = round(1.7 * size)
    weights = {text: tick[name] for name, text in WEIGHT_LABELS.items() if np.isfinite(tick[name])}
    image = Image.new("RGB", (width, round(row * (2.3 + bool(weights)))), PAPER)
    write, plain, bold = ImageDraw.Draw(image).text, _font(size), _font(round(1.3 * size), True)
    middle, line = width / 2, 0.7 * row
    write((size, line), title, INK, bold, anchor="lm")
    write((middle - size, line), f"{tick['won']:.0f}", COLORS[LEFT], bold, anchor="rm")
    write((middle, line), ":", INK, bold, anchor="mm")
    write((middle + size, line), f"{tick['lost']:.0f}", COLORS[RIGHT], bold, anchor="lm")
    write((width - size, line), f"{tick['time_s']:.2f} s", INK, bold, anchor="rm")
    line += row
    intention = f"wants to {INTENTIONS[tick['intention']]}" if "intention" in tick else ""
    write((size, line), "goal!" if tick["goal"] else intention, INK, plain, anchor="lm")
    write((width - size, line), f"force {hypot(*_pair(tick, 'force')):.1f} N", FORCE, _font(size, True), anchor="rm")
    line += row
    labels_width = sum(plain.getlength(f"{text} 0.00") + 2 * size for text in weights)
    bar = min((width - 2 * size - labels_width) / max(len(weights), 1), 7 * size)
    left = size
    for text, value in weights.items():
        write((left, line), text, INK, plain, anchor="lm")
        left += plain.getlength(f"{text} ")
        for share, color in ((1, GRAY), (value, FORCE)):
            ImageDraw.Draw(image).rectangle((left, line - size / 3, left + share * bar, line + size / 3), fill=color)
        write((left + bar + 0.5 * size, line), f"{value:.2f}", INK, plain, anchor="lm")
        left += bar + plain.getlength("0.00") + 2 * size
    return image


@lru_cache(maxsize=4)
def _draw_legend(info: FilmInfo, width: int, size: int, scale: float) -> Image.Image:
    """Legend for frames of `scale` pixels per m before they are scaled down."""
    row, columns = round(1.8 * size), (0, 0.29 * width, 0.64 * width)
    image = Image.new("RGB", (SMOOTHING * width, SMOOTHING * (3 * row + size // 2)), PAPER)
    drawer, unit = SceneDrawer(image, scale), scale / 400

    def paddle(at: Pixel, seat: int) -> None:
        drawer.disc(at, 8, COLORS[seat])
        drawer.disc(at, 4, PAPER)

    def force(at: Pixel) -> None:
        drawer.arrow((at[0] - ARROW * scale / 2, at[1]), np.array([1.0, 0.0]))

    def puck(at: Pixel) -> None:
        drawer.line([(at[0] - 20 * unit, at[1]), at], mix(COLORS[PUCK], FELT, 0.35), 3)
        drawer.disc(at, 6, COLORS[PUCK])

    entries = [
        (info.player, lambda at: paddle(at, LEFT)),
        (info.opponent, lambda at: paddle(at, RIGHT)),
        ("puck, its last 0.3 s", puck),
        *[("where the person wants to be", drawer.cross)] * info.is_simulated,
        ("force on the hand, here 1 N", force),
        ("ellipse: ± 1 STD of a target", lambda at: drawer.ellipse(at, 14 * unit, 8 * unit, RIM, True)),
    ]
    for model in TARGETS:
        name = f"{model} action" + " (adapted)" * (info.is_adapted and model == "predicted")
        name += ", not used" * (model not in info.guiding_models)
        entries.append((name, partial(drawer.target, model=model, color=_color(model, info))))
    positions = [(columns[i // 3] + 2.2 * size, row * (i % 3 + 0.7)) for i in range(len(entries))]
    for (x, y), (_, draw) in zip(positions, entries, strict=True):
        draw((SMOOTHING * x, SMOOTHING * y))
    image = image.reduce(SMOOTHING)
    for (x, y), (text, _) in zip(positions, entries, strict=True):
        ImageDraw.Draw(image).text((x + 1.9 * size, y), text, INK, _font(size), anchor="lm")
    return image
