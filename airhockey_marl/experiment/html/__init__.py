"""HTML report pages: load a template on top of the shared base page, and format numbers."""

import json
import math
from collections.abc import Callable
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

WIDTH = 8  # characters of a number


def template(folder: Path, name: str, **filters: Callable) -> Template:
    """Load a page template, which may extend `base.html` and import from `macros.html`.

    `filters` come beside the common ones, `number` and `pretty` (indented JSON). An undefined variable raises.
    """
    environment = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "pretty": lambda value: json.dumps(value, indent=2, default=str),
        **filters,
    }
    return environment.get_template(name)


def number(value: float | None, digits: int = 2) -> str:
    """Format a number of any size in at most `WIDTH` characters, with a typographic minus; a dash for None and NaN.

    It has `digits` decimals, fewer if it would be too long, and an exponent if these would not show what it is.
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    size, error = abs(value), max(0.5 * 10.0**-digits, 0.05 * abs(value))
    mantissa, _, exponent = f"{size:.1e}".partition("e")
    texts = (f"{round(size, n):.{n}f}" for n in range(digits, -1, -1))
    short = (text for text in texts if len(text) < WIDTH and abs(float(text) - size) <= error)
    text = next(short, f"{mantissa}e{int(exponent)}")
    return f"−{text}" if value < 0 and text.strip("0.") else text
