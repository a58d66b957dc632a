"""Colors, letters and lines for a pygame surface."""

from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
import pygame
from PIL import Image

from airhockey_marl.envs.rendering import SMOOTHING

Color = tuple[int, int, int]
Place = tuple[float, float]


@lru_cache
def font(size: int, bold: bool = False) -> pygame.font.Font:
    """DejaVu, which has the letters of most languages, of a size in pixels."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return pygame.font.Font(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


@lru_cache(maxsize=512)
def letters(text: str, size: int, color: Color, bold: bool = False) -> pygame.Surface:
    """A line of text as a picture."""
    return font(size, bold).render(text, True, color)


def forget() -> None:
    """Drop all letters: none outlives the pygame that drew it."""
    font.cache_clear()
    letters.cache_clear()


def write(
    surface: pygame.Surface,
    text: str,
    at: Place,
    size: int,
    color: Color,
    bold: bool = False,
    anchor: str = "midleft",
) -> pygame.Rect:
    """Write a line of text; `anchor` is the point of its box that comes to lie `at`."""
    picture = letters(text, size, color, bold)
    return surface.blit(picture, picture.get_rect(**{anchor: at}))


def wrapped(text: str, size: int, width: float, bold: bool = False) -> list[str]:
    """A text as lines that are no wider than `width` pixels; its own line breaks stay."""
    face, lines = font(size, bold), []
    for paragraph in text.splitlines():
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}".strip()
            if line and face.size(longer)[0] > width:
                lines.append(line)
                longer = word
            line = longer
        lines.append(line)
    return lines


def picture_of(image: Image.Image) -> pygame.Surface:
    """A pillow image, drawn `SMOOTHING` times too large, as a surface of the right size."""
    small = image.reduce(SMOOTHING)
    surface = pygame.image.frombytes(small.tobytes(), small.size, small.mode)
    return surface.convert_alpha() if small.mode == "RGBA" else surface.convert()


def veil(surface: pygame.Surface, box: pygame.Rect, color: tuple[int, int, int, int]) -> None:
    """Lay a translucent color over a box."""
    layer = pygame.Surface(box.size, pygame.SRCALPHA)
    layer.fill(color)
    surface.blit(layer, box)


def smooth_polygon(surface: pygame.Surface, corners: np.ndarray, color: Color, edge: Color) -> None:
    """A filled polygon (n, 2) with a smooth edge."""
    places = [tuple(corner) for corner in corners]
    pygame.draw.polygon(surface, color, places)
    pygame.draw.aalines(surface, edge, True, places)
