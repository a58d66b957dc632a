"""What the report pages have in common: how a template is filled, and how a number is written."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template


def template(folder: Path, name: str, **filters: Callable) -> Template:
    """A template of a folder, strict about what it is given, with these filters and the common ones."""
    environment = Environment(
        loader=FileSystemLoader(folder),
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


def number(value: float, digits: int = 2) -> str:
    """With a true minus; a dash for what is not a number."""
    return "–" if pd.isna(value) else f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # + 0.0: no −0.00
