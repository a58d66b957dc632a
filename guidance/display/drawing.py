"""Text, images and polygons on a pygame surface."""

import warnings
from functools import lru_cache
from math import inf
from pathlib import Path

import matplotlib
import numpy as np
import pygame
from matplotlib.ft2font import FT2Font
from PIL import Image

from airhockey_marl.envs.rendering import SMOOTHING
from guidance.display.scene import FORCE, GRAY, INK, Color, Pixel

MIN_SIZE = 9  # px, of texts that are made smaller to fit

DEJAVU = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
WITH_MORE_GLYPHS = (  # families with the scripts of East Asia, by the names that systems give them
    *("notosanscjkkr", "notosanscjkjp", "notosanscjksc", "notosanskr", "notosansjp", "notosanssc", "applesdgothicneo"),
    *("hiraginosans", "pingfangsc", "malgungothic", "yugothic", "microsoftyahei", "msgothic", "simhei"),
    *("nanumgothic", "ipaexgothic", "wenquanyizenhei", "wenquanyimicrohei", "droidsansfallback", "arialunicodems"),
)
_chosen: list[Path] = []  # the file of `use_font`, before all others


@lru_cache
def glyphs(file: Path) -> frozenset[str]:
    """The characters that a font has; a ValueError if the file is no font."""
    try:
        return frozenset(map(chr, FT2Font(str(file)).get_charmap()))
    except (OSError, RuntimeError) as error:
        raise ValueError(f"font = {file} must be a font file: {error}") from error


@lru_cache
def installed_fonts() -> tuple[Path, ...]:
    """The files of the installed fonts of `WITH_MORE_GLYPHS`."""
    with warnings.catch_warnings():  # of systems that cannot list their fonts
        warnings.simplefilter("ignore")
        files = map(pygame.font.match_font, WITH_MORE_GLYPHS)
        return tuple(dict.fromkeys(Path(file) for file in files if file))


def choose_font(text: str, file: Path | None = None) -> Path:
    """The font for a text: `file` if there is one, else DejaVu Sans or an installed font.

    Raises:
        ValueError: `file` is no font.
    """
    candidates = [DEJAVU, *installed_fonts()] if file is None else [file]
    return next((font for font in candidates if not lacking(text, font)), candidates[0])


def lacking(text: str, file: Path) -> list[str]:
    """The characters of a text for which a font has no glyph."""
    return sorted({letter for letter in text if not letter.isspace()} - glyphs(file))


def use_font(file: Path) -> None:
    """Draw texts with this font where it has their glyphs."""
    clear_caches()
    _chosen[:] = [file]


def font(size: int, bold: bool = False, text: str = "") -> pygame.font.Font:
    """The font for a text, which is that of `use_font` or DejaVu Sans if it has the glyphs; size in pixels."""
    return _open_font(_file_for(text), size, bold)


@lru_cache(maxsize=512)
def _file_for(text: str) -> Path:
    return next((file for file in (*_chosen, DEJAVU) if not lacking(text, file)), None) or choose_font(text)


@lru_cache(maxsize=128)
def _open_font(file: Path, size: int, bold: bool) -> pygame.font.Font:
    pygame.font.init()
    if file == DEJAVU and bold:
        return pygame.font.Font(DEJAVU.with_stem("DejaVuSans-Bold"), size)
    face = pygame.font.Font(file, size)
    face.bold = bold
    return face


@lru_cache(maxsize=512)
def render(text: str, size: int, color: Color, bold: bool = False) -> pygame.Surface:
    """A rendered line of text."""
    return font(size, bold, text).render(text, True, color)


def clear_caches() -> None:
    """Drop fonts and rendered texts, which are invalid once pygame quits."""
    _chosen.clear()
    _file_for.cache_clear()
    _open_font.cache_clear()
    render.cache_clear()


def write(
    surface: pygame.Surface,
    text: str,
    at: Pixel,
    size: int,
    color: Color,
    bold: bool = False,
    anchor: str = "midleft",
    width: float = inf,
) -> pygame.Rect:
    """Draw a line of text, smaller where it would be wider than `width`; the point `anchor` of its box is at `at`."""
    sizes = range(size, MIN_SIZE, -1)
    size = next((size for size in sizes if font(size, bold, text).size(text)[0] <= width), MIN_SIZE)
    picture = render(text, size, color, bold)
    return surface.blit(picture, picture.get_rect(**{anchor: at}))


def write_lines(
    surface: pygame.Surface,
    text: str,
    box: pygame.Rect,
    size: int,
    color: Color,
    bold: bool = False,
    anchor: str = "midleft",
) -> None:
    """Draw a text of one or more lines into a box, at its left or right (`anchor`), smaller where it has to be."""
    for smaller in range(size, MIN_SIZE - 1, -1):
        lines, apart = wrap(text, smaller, box.width, bold), 1.25 * smaller
        if len(lines) * apart <= box.height:
            break
    x, _ = getattr(box, anchor)
    for number, line in enumerate(lines):
        y = box.centery + (number - (len(lines) - 1) / 2) * apart
        write(surface, line, (x, y), smaller, color, bold, anchor)


def wrap(text: str, size: int, width: float, bold: bool = False) -> list[str]:
    """Split a text into lines of at most `width` pixels; its own line breaks are kept.

    A word that is wider, as a sentence without spaces, is split between two letters.
    """
    face, lines = font(size, bold, text), []
    for paragraph in text.splitlines():
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}".strip()
            if line and face.size(longer)[0] > width:
                lines.append(line)
                longer = word
            while face.size(longer)[0] > width and len(longer) > 1:
                fits = next(n for n in range(len(longer) - 1, 0, -1) if n == 1 or face.size(longer[:n])[0] <= width)
                lines.append(longer[:fits])
                longer = longer[fits:]
            line = longer
        lines.append(line)
    return lines


def picture_of(image: Image.Image) -> pygame.Surface:
    """Convert a Pillow image, drawn `SMOOTHING` times larger for smooth edges, to a surface."""
    small = image.reduce(SMOOTHING)
    surface = pygame.image.frombytes(small.tobytes(), small.size, small.mode)
    if pygame.display.get_surface() is None:  # a film: there is no screen whose format would be faster
        return surface
    return surface.convert_alpha() if small.mode == "RGBA" else surface.convert()


def write_weight(
    surface: pygame.Surface, name: str, weight: float, at: Pixel, size: int, width: float, height: float
) -> float:
    """Draw the name of a weight, and a bar of it; returns the right edge."""
    left = write(surface, name, at, size, INK).right + 6
    for share, color in ((1.0, GRAY), (weight, FORCE)):
        pygame.draw.rect(surface, color, (left, at[1] - height / 2, width * share, height))
    return left + width


def smooth_polygon(surface: pygame.Surface, corners: np.ndarray, color: Color, edge: Color) -> None:
    """Draw a filled polygon (n, 2) with a smooth edge."""
    places = [tuple(corner) for corner in corners]
    pygame.draw.polygon(surface, color, places)
    pygame.draw.aalines(surface, edge, True, places)
