"""Films of a recorded game: single frames, an animated film, and a sheet of six frames.

They are drawn from a table of ticks, see `guidance.sessions.tick_log`. For a simulated person, the table also has the
desired position of the hand (wanted_x, wanted_y, in m of the hand) and the intention.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from math import hypot
from pathlib import Path

import numpy as np
import pandas as pd
import pygame
import torch
from PIL import Image, ImageOps

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec
from airhockey_marl.envs.rendering import COLORS, FELT, LINE, RIM
from guidance.display.arena import TRAIL, Arena, draw_ellipse
from guidance.display.drawing import font, write, write_weight
from guidance.display.scene import ARROW, FORCE, GRAY, HAND, INK, PAPER, STATE, TARGETS, WEIGHT_LABELS, Pixel, mix
from guidance.forces.conditions import Prediction
from guidance.haptics.screen import DisplayState
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


def _pair(tick: pd.Series, name: str) -> np.ndarray:
    return np.array([tick[f"{name}_x"], tick[f"{name}_y"]], dtype=float)


def _display(tick: pd.Series, info: FilmInfo) -> DisplayState:
    """What is shown of one tick."""
    state = tick[STATE].to_numpy(float)
    if tick["goal"]:  # a row has the state at the beginning of its tick; a goal falls at its end
        state[8:10] += info.table.tick * state[10:12]
    optimal, predicted = (
        Prediction(*(torch.from_numpy(_pair(tick, name))[None] for name in (model, f"{model}_std")))
        for model in TARGETS
    )
    hand = _pair(tick, "wanted" if info.is_simulated else "hand") / HAND_REACH
    return DisplayState(state, state, hand=hand, force=_pair(tick, "force"), optimal=optimal, predicted=predicted)


@lru_cache(maxsize=4)
def _arena(info: FilmInfo, width: int) -> Arena:
    return Arena(info.table, width, info.guiding_models)


def draw_play(ticks: pd.DataFrame, index: int, info: FilmInfo, width: int) -> Image.Image:
    """The table at one tick, `width` pixels wide: bodies, predictions, the hand and the force."""
    arena, recent = _arena(info, width), ticks.iloc[max(index - TRAIL, 0) : index]
    recent = recent.loc[recent["round"] == ticks["round"].iloc[index], ["puck_x", "puck_y"]].to_numpy()
    arena.trail = [arena.pixel(place) for place in recent]
    surface = pygame.Surface(arena.size)
    arena.draw(surface, _display(ticks.iloc[index], info), overlay=True, force=True)
    return _image(surface)


def draw_frame(ticks: pd.DataFrame, index: int, info: FilmInfo) -> Image.Image:
    """One frame of the film: score, table and legend."""
    size = max(12, round(info.width / 57))
    header = _draw_header(ticks.iloc[index], info.title, info.width, size)
    return _join(
        [header, draw_play(ticks, index, info, info.width), _draw_legend(info, info.width, size, info.width)], 0
    )


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
    title = _paper(wide, 3 * size)
    text = f"{info.title}: {info.player} against {info.opponent}"
    write(title, text, (size, 1.5 * size), round(1.4 * size), INK, bold=True)
    rows = [_join(panels[i : i + 2], 1) for i in range(0, SHEET_FRAMES, 2)]
    return _join([_image(title), *rows, _draw_legend(info, wide, size, width)], 0)


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
    opacities = np.linspace(1, 0.06, 12)
    mixed = [mix(color, paper, opacity) for paper in (FELT, PAPER) for color in colors for opacity in opacities]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for color in (FELT, PAPER, GRAY, *mixed) for value in color])
    return palette


def _join(images: list[Image.Image], axis: int) -> Image.Image:
    """Join images vertically (axis 0) or horizontally (axis 1)."""
    return Image.fromarray(np.concatenate([np.asarray(image) for image in images], axis))


def _paper(width: int, height: float) -> pygame.Surface:
    surface = pygame.Surface((width, round(height)))
    surface.fill(PAPER)
    return surface


def _image(surface: pygame.Surface) -> Image.Image:
    return Image.fromarray(pygame.surfarray.array3d(surface).swapaxes(0, 1))


def _draw_header(tick: pd.Series, title: str, width: int, size: int) -> Image.Image:
    """Score, time, intention, force and its weights, in text of `size` pixels."""
    row, large, middle = round(1.7 * size), round(1.3 * size), width / 2
    weights = {text: tick[name] for name, text in WEIGHT_LABELS.items() if np.isfinite(tick[name])}
    surface, line = _paper(width, row * (2.3 + bool(weights))), 0.7 * row
    write(surface, title, (size, line), large, INK, bold=True)
    write(surface, f"{tick['won']:.0f}", (middle - size, line), large, COLORS[LEFT], True, "midright")
    write(surface, ":", (middle, line), large, INK, True, "center")
    write(surface, f"{tick['lost']:.0f}", (middle + size, line), large, COLORS[RIGHT], True, "midleft")
    write(surface, f"{tick['time_s']:.2f} s", (width - size, line), large, INK, True, "midright")
    line += row
    intention = f"wants to {INTENTIONS[tick['intention']]}" if "intention" in tick else ""
    write(surface, "goal!" if tick["goal"] else intention, (size, line), size, INK)
    force = f"force {hypot(*_pair(tick, 'force')):.1f} N"
    write(surface, force, (width - size, line), size, FORCE, True, "midright")
    line, left = line + row, size
    labels_width = sum(font(size).size(f"{text} 0.00")[0] + 2 * size + 12 for text in weights)
    bar = min((width - 2 * size - labels_width) / max(len(weights), 1), 7 * size)
    for text, value in weights.items():
        left = write_weight(surface, text, value, (left, line), size, bar, 2 * size / 3)
        left = write(surface, f"{value:.2f}", (left + 0.5 * size, line), size, INK).right + 1.5 * size
    return _image(surface)


@lru_cache(maxsize=4)
def _draw_legend(info: FilmInfo, width: int, size: int, table_width: int) -> Image.Image:
    """Legend for pictures of the table that are `table_width` pixels wide."""
    row, columns, arena = round(1.8 * size), (0, 0.29 * width, 0.64 * width), _arena(info, table_width)
    surface, unit = _paper(width, 3 * row + size // 2), arena.scale / 400
    circle = partial(pygame.draw.aacircle, surface)

    def paddle(at: Pixel, seat: int) -> None:
        circle(COLORS[seat], at, 8 * unit)
        circle(PAPER, at, 4 * unit)

    def puck(at: Pixel) -> None:
        pygame.draw.aaline(surface, mix(COLORS[PUCK], FELT, 1 / 3), (at[0] - 20 * unit, at[1]), at, 3)
        circle(COLORS[PUCK], at, 6 * unit)

    def force(at: Pixel) -> None:
        arena.draw_force(surface, (at[0] - ARROW * arena.scale / 2, at[1]), np.array([1.0, 0.0]))

    def mark(at: Pixel, model: str) -> None:
        surface.blit(arena.marks[model], arena.marks[model].get_rect(center=at))

    entries = [
        (info.player, lambda at: paddle(at, LEFT)),
        (info.opponent, lambda at: paddle(at, RIGHT)),
        ("puck, its last 0.3 s", puck),
        ("where the person wants to be" if info.is_simulated else "hand", lambda at: circle(HAND, at, 5 * unit, 3)),
        ("force on the hand, here 1 N", force),
        ("ellipse: ± 1 STD of a target", lambda at: draw_ellipse(surface, at, unit * np.array([28, 16]), RIM)),
    ]
    for model in TARGETS:
        name = f"{model} action" + " (adapted)" * (info.is_adapted and model == "predicted")
        name += ", not used" * (model not in info.guiding_models)
        entries.append((name, partial(mark, model=model)))
    for i, (text, draw) in enumerate(entries):
        x, y = columns[i // 3] + 2.2 * size, row * (i % 3 + 0.7)
        draw((x, y))
        write(surface, text, (x + 1.9 * size, y), size, INK)
    return _image(surface)
