"""What goes on while a person plays under a guidance, as pictures: a moment, a film of many, a sheet of six.

They are drawn from a table of ticks, see `guidance.study.tick_log`, and from nothing else. Where the person is a simulated one,
it also says where they want the hand (wanted_x, wanted_y, in m of the hand) and their intention.
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
from guidance.simulated_users.arm import HAND_REACH

Pixel = tuple[float, float]
Color = tuple[int, int, int]

# Okabe and Ito's colors; the optimal action has that of OAHG in Figure 6
INK, PAPER, GRAY = (34, 34, 34), (255, 255, 255), (222, 226, 230)
WANTED, FORCE = (86, 180, 233), (0, 158, 115)
TARGETS = {"optimal": (230, 159, 0), "predicted": (204, 121, 167)}
CORNERS = {"optimal": ((0, -8), (8, 0), (0, 8), (-8, 0)), "predicted": ((-6, -6), (6, -6), (6, 6), (-6, 6))}
WEIGHTS = {"w_unc_optimal": "W_unc optimal", "w_unc_predicted": "W_unc predicted", "w_sim": "W_sim"}
WISHES = {
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
ARROW = 0.07  # m of the table for 1 N
TRAIL = 15  # ticks of the puck's way
GOAL_SHOWN = 800  # ms
NARROWEST = 640  # pixels: there, a text is 12 pixels high
MOMENTS, APART = 6, 20  # of a sheet, and ticks between them


@dataclass(frozen=True)
class FilmInfo:
    """What stays the same from picture to picture.

    Attributes:
        title: the condition's label.
        player, opponent: who sits at the left seat, and at the right one.
        used: the keys of `TARGETS` from which the condition's force comes.
        adapted: the predicted action is that of a model adapted to this person.
        width: pixels of a picture of the film.
        simulated: the person is a simulated one, whose wishes are known.
    """

    table: TableSpec
    title: str
    player: str
    opponent: str
    used: frozenset[str]
    adapted: bool
    width: int
    simulated: bool = True


class SceneDrawer:
    """Draws marks on a picture of `scale` pixels per m, at places in pixels."""

    def __init__(self, image: Image.Image, scale: float) -> None:
        self.pen, self.scale = ImageDraw.Draw(image, "RGBA"), scale
        self.unit = scale / 400  # a pixel, where the picture is 800 wide when it is scaled down

    def line(self, places: list[Pixel], color: Color, width: float) -> None:
        self.pen.line(places, fill=color, width=round(width * self.unit), joint="curve")

    def disc(self, at: Pixel, radius: float, color: Color) -> None:
        self.pen.ellipse(_box(at, radius * self.unit, radius * self.unit), fill=color)

    def ellipse(self, at: Pixel, radius_x: float, radius_y: float, color: Color, filled: bool) -> None:
        """Of radii in pixels."""
        inside, width = (*color, 50 * filled), round(1.5 * self.unit)
        self.pen.ellipse(_box(at, radius_x, radius_y), fill=inside, outline=(*color, 170), width=width)

    def target(self, at: Pixel, model: str, color: Color) -> None:
        corners = [(at[0] + self.unit * x, at[1] + self.unit * y) for x, y in CORNERS[model]]
        for ink, width in ((PAPER, 5), (color, 2.5)):
            self.line([*corners, *corners[:2]], ink, width)

    def cross(self, at: Pixel) -> None:
        x, y, arm = *at, 6 * self.unit
        for ink, width in ((PAPER, 6.5), (WANTED, 3.5)):
            for way in (-1, 1):
                self.line([(x - arm, y - way * arm), (x + arm, y + way * arm)], ink, width)

    def arrow(self, start: Pixel, force: np.ndarray) -> None:
        """From a place, for a force (2,) in N; y is up."""
        outline = arrow_outline(start, force, self.scale)
        if outline:
            self.pen.polygon(outline, fill=FORCE)
            self.line([*outline, outline[0]], PAPER, 1)


def arrow_outline(start: Pixel, force: np.ndarray, scale: float) -> list[Pixel]:
    """Corners of the arrow of a force (2,) in N on a picture of `scale` pixels per m; none if it is too short to see."""
    length, unit = hypot(*force) * ARROW * scale, scale / 400
    if length < unit:
        return []
    head = min(0.6 * length, 13 * unit)
    half = [(0, 2.5), (length - head, 2.5), (length - head, 7), (length, 0)]
    right, up = force / hypot(*force)
    return [
        (start[0] + far * right - aside * unit * up, start[1] - far * up - aside * unit * right)
        for far, aside in [*half, *((far, -aside) for far, aside in half[::-1])]
    ]


def _box(at: Pixel, radius_x: float, radius_y: float) -> tuple[float, ...]:
    return at[0] - radius_x, at[1] - radius_y, at[0] + radius_x, at[1] + radius_y


def _mix(color: Color, ground: Color, part: float) -> Color:
    return tuple(round(part * a + (1 - part) * b) for a, b in zip(color, ground, strict=True))


def _color(model: str, scene: FilmInfo) -> Color:
    """Of a target; pale where no force comes from it."""
    return TARGETS[model] if model in scene.used else _mix(TARGETS[model], FELT, 0.4)


def _pair(now: pd.Series, name: str) -> np.ndarray:
    return np.array([now[f"{name}_x"], now[f"{name}_y"]], dtype=float)


def draw_play(ticks: pd.DataFrame, index: int, scene: FilmInfo, width: int) -> Image.Image:
    """The table at one tick with all that is wanted, proposed and pushed, `width` pixels wide."""
    now, view = ticks.iloc[index], View(scene.table, width)
    image = empty_table(view)
    marks = SceneDrawer(image, view.scale)
    middle, half = action_range(scene.table)
    recent = ticks.iloc[max(index - TRAIL, 0) : index + 1]
    way = recent.loc[recent["round"] == now["round"], ["puck_x", "puck_y"]].to_numpy()
    marks.line([view.pixel(*place) for place in way], _mix(COLORS[PUCK], FELT, 0.35), 3)
    targets = {model: view.pixel(*middle + half * _pair(now, model)) for model in TARGETS}
    for model, at in targets.items():
        radii = half * _pair(now, f"{model}_std") * view.scale
        marks.ellipse(at, *radii, _color(model, scene), model in scene.used)
    paddle = view.pixel(*_pair(now, "own"))
    if scene.simulated:
        wanted = view.pixel(*middle + half * _pair(now, "wanted") / HAND_REACH)
        marks.line([paddle, wanted], WANTED, 2)
    bodies = np.stack([_pair(now, body) for body in ("own", "other", "puck")])
    if now["goal"]:  # a row shows the beginning of its tick, and the goal is at the end
        bodies[PUCK] += scene.table.tick * np.array([now["puck_vx"], now["puck_vy"]])
    draw_bodies(marks.pen, view, bodies)
    edge = 10 * marks.unit  # a model may want more than the table has; its mark stays in the picture
    for model, at in targets.items():
        inside = np.clip(at, edge, np.array(view.size) - edge)
        marks.target(tuple(inside), model, _color(model, scene))
    if scene.simulated:
        marks.cross(wanted)
    marks.arrow(paddle, _pair(now, "force"))
    return image.reduce(SMOOTHING)


def draw_moment(ticks: pd.DataFrame, index: int, scene: FilmInfo) -> Image.Image:
    """One picture of the film: how it stands, the table, and what the marks mean."""
    size = max(12, round(scene.width / 57))
    standing = _draw_standing(ticks.iloc[index], scene.title, scene.width, size)
    play, scale = draw_play(ticks, index, scene, scene.width), View(scene.table, scene.width).scale
    return _join([standing, play, _draw_legend(scene, scene.width, size, scale)], 0)


def _leading_to_a_goal(ticks: pd.DataFrame) -> np.ndarray:
    """Six ticks that lead to the person's first goal; without one, to the other's; without one, to the end."""
    first = [int(np.argmax(ticks[goals] > 0)) for goals in ("won", "lost") if (ticks[goals] > 0).any()]
    last = [*first, len(ticks) - 1][0]
    return np.linspace(max(last - (MOMENTS - 1) * APART, 0), last, MOMENTS).round().astype(int)


def draw_sheet(ticks: pd.DataFrame, scene: FilmInfo) -> Image.Image:
    """Six moments, the last of which is a goal if there was one."""
    wide, gap = 2 * (3 * scene.width // 4), scene.width // 200
    width, size = wide // 2 - 2 * gap, max(12, round(wide / 80))
    panels = [
        _join([_draw_standing(ticks.iloc[i], "", width, size), draw_play(ticks, i, scene, width)], 0)
        for i in _leading_to_a_goal(ticks)
    ]
    panels = [ImageOps.expand(panel, (gap, 0), PAPER) for panel in panels]
    title = Image.new("RGB", (wide, 3 * size), PAPER)
    text = f"{scene.title}: {scene.player} against {scene.opponent}"
    ImageDraw.Draw(title).text((size, 1.5 * size), text, INK, _font(round(1.4 * size), True), anchor="lm")
    rows = [_join(panels[i : i + 2], 1) for i in range(0, MOMENTS, 2)]
    return _join([title, *rows, _draw_legend(scene, wide, size, View(scene.table, width).scale)], 0)


def save_film(
    path: Path,
    ticks: pd.DataFrame,
    scene: FilmInfo,
    every: int,
    milliseconds: int,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Write an animated GIF: a picture for every `every` ticks, shown for so long, and one that stays for each goal."""
    scored = ticks["goal"].to_numpy() != 0
    shown = np.flatnonzero((np.arange(len(ticks)) % every == every - 1) | scored)
    palette = _palette()

    def pictures() -> Iterator[Image.Image]:
        for i, index in enumerate(shown):
            progress(i / len(shown))
            yield draw_moment(ticks, index, scene).quantize(palette=palette, dither=Image.Dither.NONE)

    film = pictures()
    durations = [GOAL_SHOWN if scored[index] else milliseconds for index in shown]
    next(film).save(path, "GIF", save_all=True, append_images=film, duration=durations, loop=0)


def _palette() -> Image.Image:
    """Every color and the steps from it to its grounds: one palette for all pictures, or the film would flicker."""
    colors = [*COLORS.values(), *TARGETS.values(), WANTED, FORCE, INK, RIM, LINE]
    mixed = [
        _mix(color, ground, part) for ground in (FELT, PAPER) for color in colors for part in np.linspace(1, 0.2, 9)
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for color in (FELT, PAPER, GRAY, *mixed) for value in color])
    return palette


def _join(images: list[Image.Image], axis: int) -> Image.Image:
    """One below the other (0), or side by side (1)."""
    return Image.fromarray(np.concatenate([np.asarray(image) for image in images], axis))


@lru_cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def _draw_standing(now: pd.Series, title: str, width: int, size: int) -> Image.Image:
    """Score and time, what the person wants, the force, and its weights, in text of `size` pixels."""
    row = round(1.7 * size)
    weights = {text: now[name] for name, text in WEIGHTS.items() if np.isfinite(now[name])}
    image = Image.new("RGB", (width, round(row * (2.3 + bool(weights)))), PAPER)
    write, plain, bold = ImageDraw.Draw(image).text, _font(size), _font(round(1.3 * size), True)
    middle, line = width / 2, 0.7 * row
    write((size, line), title, INK, bold, anchor="lm")
    write((middle - size, line), f"{now['won']:.0f}", COLORS[LEFT], bold, anchor="rm")
    write((middle, line), ":", INK, bold, anchor="mm")
    write((middle + size, line), f"{now['lost']:.0f}", COLORS[RIGHT], bold, anchor="lm")
    write((width - size, line), f"{now['time_s']:.2f} s", INK, bold, anchor="rm")
    line += row
    wish = f"wants to {WISHES[now['intention']]}" if "intention" in now else ""
    write((size, line), "goal!" if now["goal"] else wish, INK, plain, anchor="lm")
    write((width - size, line), f"force {hypot(*_pair(now, 'force')):.1f} N", FORCE, _font(size, True), anchor="rm")
    line += row
    taken = sum(plain.getlength(f"{text} 0.00") + 2 * size for text in weights)
    bar = min((width - 2 * size - taken) / max(len(weights), 1), 7 * size)
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
def _draw_legend(scene: FilmInfo, width: int, size: int, scale: float) -> Image.Image:
    """What the marks mean in pictures of `scale` pixels per m before they are scaled down."""
    row, columns = round(1.8 * size), (0, 0.29 * width, 0.64 * width)
    image = Image.new("RGB", (SMOOTHING * width, SMOOTHING * (3 * row + size // 2)), PAPER)
    marks, unit = SceneDrawer(image, scale), scale / 400

    def paddle(at: Pixel, seat: int) -> None:
        marks.disc(at, 8, COLORS[seat])
        marks.disc(at, 4, PAPER)

    def puck(at: Pixel) -> None:
        marks.line([(at[0] - 20 * unit, at[1]), at], _mix(COLORS[PUCK], FELT, 0.35), 3)
        marks.disc(at, 6, COLORS[PUCK])

    entries = [
        (scene.player, lambda at: paddle(at, LEFT)),
        (scene.opponent, lambda at: paddle(at, RIGHT)),
        ("puck, its last 0.3 s", puck),
        *[("where the person wants to be", marks.cross)] * scene.simulated,
        ("force on the hand, here 1 N", lambda at: marks.arrow((at[0] - ARROW * scale / 2, at[1]), np.array([1.0, 0]))),
        ("ellipse: ± 1 STD of a target", lambda at: marks.ellipse(at, 14 * unit, 8 * unit, RIM, True)),
    ]
    for model in TARGETS:
        name = f"{model} action" + " (adapted)" * (scene.adapted and model == "predicted")
        name += ", not used" * (model not in scene.used)
        entries.append((name, partial(marks.target, model=model, color=_color(model, scene))))
    places = [(columns[i // 3] + 2.2 * size, row * (i % 3 + 0.7)) for i in range(len(entries))]
    for (x, y), (_, draw) in zip(places, entries, strict=True):
        draw((SMOOTHING * x, SMOOTHING * y))
    image = image.reduce(SMOOTHING)
    for (x, y), (text, _) in zip(places, entries, strict=True):
        ImageDraw.Draw(image).text((x + 1.9 * size, y), text, INK, _font(size), anchor="lm")
    return image
