"""Text, images and polygons on a pygame surface."""

from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
import pygame
from PIL import Image

from airhockey_marl.envs.rendering import SMOOTHING
from guidance.display.scene import FORCE, GRAY, INK, Color, Pixel


@lru_cache
def font(size: int, bold: bool = False) -> pygame.font.Font:
    """The font DejaVu Sans, which covers most languages; size in pixels."""
    pygame.font.init()
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return pygame.font.Font(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


@lru_cache(maxsize=512)
def render(text: str, size: int, color: Color, bold: bool = False) -> pygame.Surface:
    """A rendered line of text."""
    return font(size, bold).render(text, True, color)


def clear_caches() -> None:
    """Drop fonts and rendered texts, which are invalid once pygame quits."""
    font.cache_clear()
    render.cache_clear()


def write(
    surface: pygame.Surface, text: str, at: Pixel, size: int, color: Color, bold: bool = False, anchor: str = "midleft"
) -> pygame.Rect:
    """Draw a line of text; the point `anchor` of its box is placed at `at`."""
    picture = render(text, size, color, bold)
    return surface.blit(picture, picture.get_rect(**{anchor: at}))


def wrap(text: str, size: int, width: float, bold: bool = False) -> list[str]:
    """Split a text into lines of at most `width` pixels; its own line breaks are kept."""
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


def veil(surface: pygame.Surface, box: pygame.Rect, color: tuple[int, int, int, int]) -> None:
    """Fill a box with a translucent color."""
    layer = pygame.Surface(box.size, pygame.SRCALPHA)
    layer.fill(color)
    surface.blit(layer, box)


def smooth_polygon(surface: pygame.Surface, corners: np.ndarray, color: Color, edge: Color) -> None:
    """Draw a filled polygon (n, 2) with a smooth edge."""
    places = [tuple(corner) for corner in corners]
    pygame.draw.polygon(surface, color, places)
    pygame.draw.aalines(surface, edge, True, places)
