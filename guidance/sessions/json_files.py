"""Text and JSON files that are replaced atomically and are on the disk when a function returns."""

import json
from pathlib import Path
from typing import Any

from airhockey_marl.experiment.files import fsync_dir, name_write_errors, write_text


def save_text(path: Path, text: str) -> None:
    """Write `text` to `path`, atomically and durably."""
    with name_write_errors(path):
        write_text(path, text)
        fsync_dir(path.parent)


def save_json(path: Path, content: Any) -> None:
    """Write `content` to `path` as indented JSON without NaN, atomically and durably."""
    save_text(path, json.dumps(content, indent=2, default=str, allow_nan=False) + "\n")


def rename_file(source: Path, target: Path) -> None:
    """Rename a file durably."""
    with name_write_errors(target):
        source.replace(target)
        fsync_dir(target.parent)
