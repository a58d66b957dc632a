"""What can be wrong with a figure that was drawn: labels that overlap or are cut off, legends over data."""

from itertools import pairwise

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def faults(figure: Figure) -> list[str]:
    """The tick labels that overlap, and the legends that leave the figure or lie over a panel."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer, found = canvas.get_renderer(), []
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            labels = [text for text in axis.get_ticklabels() if text.get_text() and text.get_visible()]
            boxes = sorted((text.get_window_extent(renderer) for text in labels), key=lambda box: (box.x0, box.y0))
            found += [f"{labels} overlap" for one, other in pairwise(boxes) if one.overlaps(other)]
        if axes.get_legend() is not None:
            found.append("a legend over a panel")
    for legend in figure.legends:
        box = legend.get_window_extent(renderer)
        if min(box.x0, box.y0) < 0 or box.x1 > figure.bbox.width or box.y1 > figure.bbox.height:
            found.append("a legend is cut off")
        found += ["a legend over a panel" for axes in figure.axes if box.overlaps(axes.get_window_extent(renderer))]
    return found
