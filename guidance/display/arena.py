"""The table on a screen: paddles, puck, force on the hand, and predictions of the models."""

from collections.abc import Collection
from itertools import pairwise
from math import dist

import numpy as np
import pygame
from PIL import Image, ImageDraw

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec, action_range
from airhockey_marl.envs.rendering import COLORS, FELT, SMOOTHING, View, empty_table
from guidance.display.drawing import Pixel, picture_of, smooth_polygon
from guidance.display.scene import CORNERS, FORCE, HAND, PAPER, TARGETS, Color, arrow_outline, mix
from guidance.forces.conditions import Prediction
from guidance.haptics.screen import DisplayState

TRAIL = 15  # frames of the puck's trail
MAX_PUCK_STEP = 0.4  # m between two frames; a puck that moves further was served
BODIES = (LEFT, RIGHT, PUCK)  # in the order of a state


class Arena:
    """Draws a game on a table of `width` pixels.

    Args:
        guiding_models: those whose predictions enter the force; the predictions of others are pale.

    Attributes:
        size: width and height in pixels.
        marks: model -> symbol of its prediction.
        trail: the last places of the puck.
    """

    def __init__(self, table: TableSpec, width: int, guiding_models: Collection[str] = tuple(TARGETS)) -> None:
        self.view, self.table = View(table, width), table
        self.middle, self.half = action_range(table)
        self.scale = self.view.scale / SMOOTHING  # pixels per m
        self._table = picture_of(empty_table(self.view))
        self.size = self._table.get_size()
        radii = {LEFT: table.paddle_radius, RIGHT: table.paddle_radius, PUCK: table.puck_radius}
        self._bodies = {body: self._disc(radius, body) for body, radius in radii.items()}
        self.colors = {
            model: color if model in guiding_models else mix(color, FELT, 0.4) for model, color in TARGETS.items()
        }
        self.marks = {model: self._mark(CORNERS[model], color) for model, color in self.colors.items()}
        self.trail: list[Pixel] = []

    def pixel(self, position: np.ndarray) -> Pixel:
        """The pixel of a position (2,) in m on the table."""
        x, y = self.view.pixel(*position)
        return x / SMOOTHING, y / SMOOTHING

    def of_action(self, action: np.ndarray) -> Pixel:
        """The pixel of the paddle position that an action (2,) requests."""
        return self.pixel(self.middle + self.half * action)

    def action_at(self, pixel: Pixel) -> np.ndarray:
        """(2,) the action that requests the position of a pixel; beyond -1 and 1 outside the left side."""
        origin = np.array(self.pixel(np.zeros(2)))
        place = (np.array(pixel) - origin) / self.scale * np.array([1.0, -1.0])
        return (place - self.middle) / self.half

    def draw(self, surface: pygame.Surface, display: DisplayState, overlay: bool, force: bool) -> None:
        """Draw a frame, with the predictions of the models if `overlay`, and the force if `force`."""
        surface.blit(self._table, (0, 0))
        if display.state is None:
            self.trail = []
            return
        previous, now = display.previous_state.reshape(3, 4)[:, :2], display.state.reshape(3, 4)[:, :2]
        places = [self.pixel(place) for place in previous + display.tick_fraction * (now - previous)]
        self._draw_trail(surface, places[2])
        if overlay:
            for model, target in (("optimal", display.optimal), ("predicted", display.predicted)):
                if target is not None:
                    self._draw_target(surface, model, target)
        for body, at in reversed(list(zip(BODIES, places, strict=True))):
            picture = self._bodies[body]
            surface.blit(picture, picture.get_rect(center=at))
        hand = self.of_action(display.hand)
        pygame.draw.aaline(surface, HAND, places[0], hand)
        pygame.draw.aacircle(surface, HAND, hand, 0.011 * self.scale, 3)
        if force:
            self.draw_force(surface, places[0], display.force)

    def _draw_trail(self, surface: pygame.Surface, puck: Pixel) -> None:
        is_serve = self.trail and dist(puck, self.trail[-1]) > MAX_PUCK_STEP * self.scale
        self.trail = [puck] if is_serve else [*self.trail[-TRAIL:], puck]
        for start, end in pairwise(self.trail):
            pygame.draw.aaline(surface, mix(COLORS[PUCK], FELT, 1 / 3), start, end, 3)

    def _draw_target(self, surface: pygame.Surface, model: str, target: Prediction) -> None:
        mean, std = target.mean[0].numpy(), target.std[0].numpy()
        draw_ellipse(surface, self.of_action(mean), 2 * self.half * std * self.scale, self.colors[model])
        mark = self.marks[model]
        inside = np.clip(self.of_action(mean), 10, np.array(self.size) - 10)  # a prediction may lie off the table
        surface.blit(mark, mark.get_rect(center=tuple(inside)))

    def draw_force(self, surface: pygame.Surface, start: Pixel, force: np.ndarray) -> None:
        """Draw the arrow of a force (2,) in N."""
        outline = arrow_outline(start, force, self.scale)
        if outline:
            smooth_polygon(surface, np.array(outline), FORCE, PAPER)

    def _disc(self, radius: float, body: int) -> pygame.Surface:
        size = 2 * round(radius * self.scale) + 4
        image = Image.new("RGBA", (SMOOTHING * size,) * 2, (*COLORS[body], 0))
        middle, pen = SMOOTHING * size / 2, ImageDraw.Draw(image)
        for share, color in ((1.0, COLORS[body]), *((0.5, FELT),) * (body != PUCK)):
            far = share * radius * self.view.scale
            pen.ellipse((middle - far, middle - far, middle + far, middle + far), fill=(*color, 255))
        return picture_of(image)

    def _mark(self, corners: tuple[Pixel, ...], color: Color) -> pygame.Surface:
        unit = self.view.scale / 400
        far = max(abs(number) for corner in corners for number in corner) * unit + 9
        side = SMOOTHING * round(2 * far / SMOOTHING)
        image = Image.new("RGBA", (side, side), (*PAPER, 0))
        outline = [(side / 2 + unit * x, side / 2 + unit * y) for x, y in (*corners, *corners[:2])]
        for ink, width in ((PAPER, 5), (color, 2.5)):
            ImageDraw.Draw(image, "RGBA").line(outline, fill=ink, width=round(width * unit), joint="curve")
        return picture_of(image)


def draw_ellipse(surface: pygame.Surface, at: Pixel, size: np.ndarray, color: Color) -> None:
    """Draw a translucent ellipse of this width and height (2,) in pixels, unless it is too small to see."""
    box = pygame.Rect((0, 0), size)
    if min(box.size) >= 3:
        layer = pygame.Surface(box.size, pygame.SRCALPHA)
        pygame.draw.ellipse(layer, (*color, 45), layer.get_rect())
        pygame.draw.ellipse(layer, (*color, 170), layer.get_rect(), 2)
        surface.blit(layer, layer.get_rect(center=at))
