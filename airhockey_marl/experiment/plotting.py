"""Style of all figures: the colors, the look of axes, and PNG and SVG files.

matplotlib is imported by the functions that draw, so that a module with figures can be imported without it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

from airhockey_marl.experiment.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

# the palette of Okabe and Ito, distinguishable with any kind of color vision
BLUE, ORANGE, GREEN, PINK, YELLOW, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
INK, GRAY, LIGHT_GRAY = "#222222", "#8C8C8C", "#E3E3E3"
LABEL_WIDTH = 44  # characters of a line of a legend
_LABEL = {"fontsize": 9, "color": "#444444"}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, size in inches, whose parts never overlap."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def despine(axes: Axes) -> None:
    """Remove the upper and the right side of the box."""
    axes.spines[["top", "right"]].set_visible(False)


def style_axes(axes: Axes) -> None:
    """Horizontal grid lines behind the data, no box, small tick labels."""
    axes.grid(axis="y", color=LIGHT_GRAY, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)
    despine(axes)


def label_axes(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    """Title on the left, axis labels, no box: for figures of a few large panels."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    despine(axes)


def label_panel(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    """Bold title and small axis labels, styled: for figures of many panels."""
    axes.set_title(title, fontsize=11, fontweight="bold")
    axes.set_xlabel(x, **_LABEL)
    axes.set_ylabel(y, **_LABEL)
    style_axes(axes)


def percent() -> PercentFormatter:
    """Tick format of shares from 0 to 1."""
    from matplotlib.ticker import PercentFormatter

    return PercentFormatter(1, symbol=" %")


def legend_below(figure: Figure, handles: Sequence[Artist]) -> None:
    """A legend below all panels, in as many columns as fit; long labels are broken into lines."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    labels = [fill(str(handle.get_label()), LABEL_WIDTH) for handle in handles]
    style = {"frameon": False, "fontsize": 8.5, "handlelength": 1.1, "columnspacing": 1.4, "handletextpad": 0.5}
    renderer = FigureCanvasAgg(figure).get_renderer()
    for columns in range(len(labels), 0, -1):
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=columns, **style)
        if legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        if columns > 1:
            legend.remove()


def png_bytes(figure: Figure, dpi: int = 150) -> bytes:
    """A figure as PNG; equal figures give equal bytes."""
    figure.savefig(content := io.BytesIO(), format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()


def save_png(figure: Figure, path: Path, dpi: int = 130) -> None:
    """Write a figure as PNG atomically."""
    write_bytes(path, png_bytes(figure, dpi))


def save_figure(draw: Callable[[], Figure], folder: Path, name: str, dpi: int) -> bytes:
    """Draw a figure, write it as `name`.png and `name`.svg, and return the SVG; equal figures give equal bytes."""
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": name, "font.family": "DejaVu Sans"}):
        figure, svg = draw(), io.BytesIO()
        save_png(figure, folder / f"{name}.png", dpi)
        figure.savefig(svg, format="svg", metadata={"Date": None})
    write_bytes(folder / f"{name}.svg", svg.getvalue())
    return svg.getvalue()
