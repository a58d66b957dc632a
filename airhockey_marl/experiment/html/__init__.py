"""HTML report pages: load a template on top of the shared base page, and format numbers."""

import json
import math
from collections.abc import Callable
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template


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
    """Format a number with a typographic minus sign; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return "–"
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # + 0.0 turns -0.0 into 0.0
