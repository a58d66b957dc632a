"""Colors and symbols of games on a screen and in films."""

from math import hypot

import numpy as np

Pixel = tuple[float, float]
Color = tuple[int, int, int]

# colors of Okabe and Ito; the optimal action has that of OAHG in Figure 6
INK, PAPER, GRAY = (34, 34, 34), (255, 255, 255), (222, 226, 230)
HAND, FORCE = (86, 180, 233), (0, 158, 115)
TARGETS = {"optimal": (230, 159, 0), "predicted": (204, 121, 167)}
CORNERS = {"optimal": ((0, -8), (8, 0), (0, 8), (-8, 0)), "predicted": ((-6, -6), (6, -6), (6, 6), (-6, 6))}
ARROW = 0.07  # m of the table per N
STATE = [f"{body}_{part}" for body in ("own", "other", "puck") for part in ("x", "y", "vx", "vy")]  # columns of ticks
WEIGHT_LABELS = {"w_unc_optimal": "W_unc optimal", "w_unc_predicted": "W_unc predicted", "w_sim": "W_sim"}


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


def mix(color: Color, background: Color, opacity: float) -> Color:
    """A color of some opacity on a background."""
    return tuple(round(opacity * a + (1 - opacity) * b) for a, b in zip(color, background, strict=True))
