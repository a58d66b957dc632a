"""Colors and symbols that the window and the films share."""

from math import hypot

import numpy as np
from PIL import Image, ImageDraw

Pixel = tuple[float, float]
Color = tuple[int, int, int]

# colors of Okabe and Ito; the optimal action has that of OAHG in Figure 6
INK, PAPER, GRAY = (34, 34, 34), (255, 255, 255), (222, 226, 230)
HAND, FORCE = (86, 180, 233), (0, 158, 115)
TARGETS = {"optimal": (230, 159, 0), "predicted": (204, 121, 167)}
CORNERS = {"optimal": ((0, -8), (8, 0), (0, 8), (-8, 0)), "predicted": ((-6, -6), (6, -6), (6, 6), (-6, 6))}
ARROW = 0.07  # m of the table per N
WEIGHT_LABELS = {"w_unc_optimal": "W_unc optimal", "w_unc_predicted": "W_unc predicted", "w_sim": "W_sim"}


class SceneDrawer:
    """Draws lines, symbols and arrows on an image of `scale` pixels per m, at positions in pixels."""

    def __init__(self, image: Image.Image, scale: float) -> None:
        self.pen, self.scale = ImageDraw.Draw(image, "RGBA"), scale
        self.unit = scale / 400  # of widths and symbols: one pixel of an image that is scaled down to a width of 800

    def line(self, points: list[Pixel], color: Color, width: float) -> None:
        self.pen.line(points, fill=color, width=round(width * self.unit), joint="curve")

    def disc(self, at: Pixel, radius: float, color: Color) -> None:
        self.pen.ellipse(_box(at, radius * self.unit, radius * self.unit), fill=color)

    def ellipse(self, at: Pixel, radius_x: float, radius_y: float, color: Color, filled: bool) -> None:
        """An ellipse of two radii in pixels."""
        fill, width = (*color, 50 * filled), round(1.5 * self.unit)
        self.pen.ellipse(_box(at, radius_x, radius_y), fill=fill, outline=(*color, 170), width=width)

    def target(self, at: Pixel, model: str, color: Color) -> None:
        corners = [(at[0] + self.unit * x, at[1] + self.unit * y) for x, y in CORNERS[model]]
        for ink, width in ((PAPER, 5), (color, 2.5)):
            self.line([*corners, *corners[:2]], ink, width)

    def cross(self, at: Pixel) -> None:
        x, y, arm = *at, 6 * self.unit
        for ink, width in ((PAPER, 6.5), (HAND, 3.5)):
            for sign in (-1, 1):
                self.line([(x - arm, y - sign * arm), (x + arm, y + sign * arm)], ink, width)

    def arrow(self, start: Pixel, force: np.ndarray) -> None:
        """An arrow from a position for a force (2,) in N, whose y is up."""
        outline = arrow_outline(start, force, self.scale)
        if outline:
            self.pen.polygon(outline, fill=FORCE)
            self.line([*outline, outline[0]], PAPER, 1)


def arrow_outline(start: Pixel, force: np.ndarray, scale: float) -> list[Pixel]:
    """Corners of the arrow of a force (2,) in N on an image of `scale` pixels per m; none if it is too short to see."""
    length, unit = hypot(*force) * ARROW * scale, scale / 400
    if length < unit:
        return []
    head = min(0.6 * length, 13 * unit)
    half = [(0, 2.5), (length - head, 2.5), (length - head, 7), (length, 0)]
    right, up = force / hypot(*force)
    return [
        (start[0] + along * right - across * unit * up, start[1] - along * up - across * unit * right)
        for along, across in [*half, *((along, -across) for along, across in half[::-1])]
    ]


def _box(at: Pixel, radius_x: float, radius_y: float) -> tuple[float, ...]:
    return at[0] - radius_x, at[1] - radius_y, at[0] + radius_x, at[1] + radius_y


def mix(color: Color, background: Color, opacity: float) -> Color:
    """A color of some opacity on a background."""
    return tuple(round(opacity * a + (1 - opacity) * b) for a, b in zip(color, background, strict=True))
