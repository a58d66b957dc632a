"""The table from above, in pixels."""

import os
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec, X, Y

# Okabe and Ito's palette, distinguishable by color-blind people.
FELT, LINE, RIM, GOAL_MOUTH = (245, 246, 248), (170, 190, 205), (70, 78, 88), (255, 255, 255)
COLORS = {LEFT: (0, 114, 178), RIGHT: (213, 94, 0), PUCK: (35, 35, 35)}
SMOOTHING = 3  # factor of supersampling: pictures are drawn larger and then scaled down
MARGIN = 0.04  # m of rim around the playing field


class View(NamedTuple):
    """Map from positions on the table to pixels of a picture that is supersampled by `SMOOTHING`."""

    table: TableSpec
    width: int  # of the final picture, in pixels

    @property
    def scale(self) -> float:
        """Pixels per m of the supersampled picture."""
        return SMOOTHING * self.width / (self.table.length + 2 * MARGIN)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the supersampled picture in pixels."""
        return SMOOTHING * self.width, round((self.table.width + 2 * MARGIN) * self.scale)

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        """Pixel (x, y) of a position in m."""
        return (x + self.table.length / 2 + MARGIN) * self.scale, (self.table.width / 2 + MARGIN - y) * self.scale

    def box(self, x: float, y: float, radius: float, radius_y: float | None = None) -> tuple[float, ...]:
        """Left, top, right and bottom in pixels of a circle, or with `radius_y` of an ellipse; lengths in m."""
        radius_y = radius if radius_y is None else radius_y
        return *self.pixel(x - radius, y + radius_y), *self.pixel(x + radius, y - radius_y)


@lru_cache(maxsize=4)
def _empty_table(view: View) -> Image.Image:
    table = view.table
    image = Image.new("RGB", view.size, RIM)
    pen = ImageDraw.Draw(image)
    pen.rectangle(view.box(0, 0, table.length / 2, table.width / 2), fill=FELT)
    for end in (-1, 1):
        inner, outer = sorted((end * table.length / 2, end * (table.length / 2 + MARGIN)))
        pen.rectangle((*view.pixel(inner, table.goal / 2), *view.pixel(outer, -table.goal / 2)), fill=GOAL_MOUTH)
        angles = (90, 270) if end > 0 else (270, 90)
        pen.arc(view.box(end * table.length / 2, 0.0, table.goal), *angles, fill=LINE, width=6)
    pen.line((view.pixel(0, table.width / 2), view.pixel(0, -table.width / 2)), fill=LINE, width=6)
    pen.ellipse(view.box(0, 0, 0.15), outline=LINE, width=6)
    return image


def empty_table(view: View) -> Image.Image:
    """A new picture of the table without bodies, supersampled by `SMOOTHING`."""
    return _empty_table(view).copy()


def draw_bodies(pen: ImageDraw.ImageDraw, view: View, bodies: np.ndarray) -> None:
    """Draw the puck and the paddles `bodies` (3, 4) or (3, 2): the left paddle blue, the right one orange."""
    for body in (PUCK, LEFT, RIGHT):
        radius = view.table.puck_radius if body == PUCK else view.table.paddle_radius
        pen.ellipse(view.box(bodies[body, X], bodies[body, Y], radius), fill=COLORS[body])
        if body != PUCK:  # the handle
            pen.ellipse(view.box(bodies[body, X], bodies[body, Y], radius / 2), fill=FELT)


def draw_table(bodies: np.ndarray, table: TableSpec, width: int = 640) -> np.ndarray:
    """Picture (height, width, 3) uint8 of one table with `bodies` (3, 4), see `draw_bodies`."""
    view = View(table, width)
    image = empty_table(view)
    draw_bodies(ImageDraw.Draw(image), view, bodies)
    return np.asarray(image.resize((width, image.height // SMOOTHING), Image.Resampling.BOX))


class TableWindow:
    """A window that shows one table.

    Args:
        fps: pictures per second.

    Raises:
        ValueError: there is no display.
    """

    def __init__(self, table: TableSpec, fps: float, width: int = 960) -> None:
        import pygame  # only where a window opens

        self.view, self.fps = View(table, width), fps
        try:
            pygame.display.init()
            # without a display SDL may fall back to a driver that draws nothing
            if pygame.display.get_driver() in ("dummy", "offscreen") and not os.environ.get("SDL_VIDEODRIVER"):
                raise pygame.error("there is none")
            self._window = pygame.Window("Air hockey", (width, self.view.size[1] // SMOOTHING))
        except pygame.error as error:
            raise ValueError(f"render_mode = 'human' needs a display: {error}") from error
        self._clock = pygame.time.Clock()

    def draw(self, bodies: np.ndarray) -> None:
        """Draw the table with `bodies` (3, 4)."""
        import pygame

        pygame.event.pump()
        picture = draw_table(bodies, self.view.table, self.view.width)
        pygame.surfarray.blit_array(self._window.get_surface(), picture.swapaxes(0, 1))
        self._window.flip()

    def wait(self) -> None:
        """Wait until a picture has been shown for its time."""
        self._clock.tick(self.fps)

    def close(self) -> None:
        self._window.destroy()
