"""The table from above, as pixels."""

import numpy as np
from PIL import Image, ImageDraw

from airhockey_marl.table import LEFT, PUCK, RIGHT, Table, X, Y

# Okabe and Ito's palette: told apart by colour-blind people too.
FELT, LINE, RIM, GOAL_MOUTH = (245, 246, 248), (170, 190, 205), (70, 78, 88), (255, 255, 255)
COLOURS = {LEFT: (0, 114, 178), RIGHT: (213, 94, 0), PUCK: (35, 35, 35)}
SMOOTHING = 3  # drawn so many times larger, then scaled down


def draw_table(bodies: np.ndarray, table: Table, width: int = 640) -> np.ndarray:
    """Draw one table's `bodies` (3, 4); the left seat is blue, the right one orange.

    Returns:
        (height, width, 3) uint8.
    """
    margin = 0.04  # m of rim around the playing field
    scale = SMOOTHING * width / (table.length + 2 * margin)
    size = (SMOOTHING * width, round((table.width + 2 * margin) * scale))

    def pixel(x: float, y: float) -> tuple[float, float]:
        return (x + table.length / 2 + margin) * scale, (table.width / 2 + margin - y) * scale

    def box(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        left, top = pixel(x - radius, y + radius)
        right, bottom = pixel(x + radius, y - radius)
        return left, top, right, bottom

    image = Image.new("RGB", size, RIM)
    pen = ImageDraw.Draw(image)
    pen.rectangle((*pixel(-table.length / 2, table.width / 2), *pixel(table.length / 2, -table.width / 2)), fill=FELT)
    for end in (-1, 1):
        inner, outer = sorted((end * table.length / 2, end * (table.length / 2 + margin)))
        pen.rectangle((*pixel(inner, table.goal / 2), *pixel(outer, -table.goal / 2)), fill=GOAL_MOUTH)
        pen.arc(
            box(end * table.length / 2, 0.0, table.goal), *((90, 270) if end > 0 else (270, 90)), fill=LINE, width=6
        )
    pen.line((pixel(0, table.width / 2), pixel(0, -table.width / 2)), fill=LINE, width=6)
    pen.ellipse(box(0, 0, 0.15), outline=LINE, width=6)
    for body in (PUCK, LEFT, RIGHT):
        radius = table.puck_radius if body == PUCK else table.paddle_radius
        pen.ellipse(box(bodies[body, X], bodies[body, Y], radius), fill=COLOURS[body])
        if body != PUCK:  # the handle
            pen.ellipse(box(bodies[body, X], bodies[body, Y], radius / 2), fill=FELT)
    return np.asarray(image.resize((width, size[1] // SMOOTHING), Image.Resampling.BOX))
