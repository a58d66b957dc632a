"""Recording a game of one person: a table with a row per tick, and its description.

    sub-P01_task-airhockey_acq-oahgut_run-3_beh.tsv     a row per tick, columns separated by tabs, n/a where missing
    sub-P01_task-airhockey_acq-oahgut_run-3_beh.json    units of the columns, results of the game, ratings

During a game, both are named `..._desc-partial_beh`, and appended ticks are on the disk. The game is complete once its
description with the results has its final name, which is one rename. The files of an interrupted game are renamed to
`..._desc-interrupted<k>_beh` and are not evaluated. Nothing here depends on the time of files.
"""

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from airhockey_marl.experiment.files import fsync_dir, name_write_errors, remove
from guidance.sessions.game import BEHAVIOR, MISSING, PARTIAL, RESULTS, Game, game_file
from guidance.sessions.json_files import rename_file, save_json

Columns = Mapping[str, Mapping[str, str]]
"""Column -> its description in BIDS: `Description`, `Units`, and optionally more."""


@dataclass
class Recording:
    """The files of a running game; a context manager that interrupts the game if it is left before `finish`.

    Attributes:
        stem: path of its files without ending and suffix.
        name, position, columns, facts, games: see `begin`.
    """

    stem: Path
    name: str
    position: int
    columns: dict[str, dict[str, str]]
    facts: dict[str, Any]
    games: dict[str, Game]
    _handle: int | None = field(default=None, repr=False)
    _size: int = field(default=0, repr=False)  # bytes that are on the disk

    @classmethod
    def begin(
        cls,
        stem: Path,
        name: str,
        position: int,
        columns: Columns,
        facts: Mapping[str, Any],
        games: dict[str, Game],
    ) -> "Recording":
        """Create the files of a game.

        Args:
            columns: descriptions of the columns, in their order.
            facts: any JSON to keep with the game, such as the device.
            games: receives the game under its name when it is complete.
        """
        for column, description in columns.items():
            if not re.fullmatch(r"[a-z][a-z0-9_]*", column):  # the keys of BIDS beside it begin with capitals
                raise ValueError(f"columns: {column!r} must be small letters, digits and underscores")
            if absent := [key for key in ("Description", "Units") if not description.get(key)]:
                raise ValueError(f"columns.{column} lacks {', '.join(absent)}")
        if not columns:
            raise ValueError("columns = {} must name at least one")
        described = {name: dict(description) for name, description in columns.items()}
        recording = cls(stem, name, position, described, dict(facts), games)
        save_json(recording._path(PARTIAL, ".json"), recording._description())
        path = recording._path(PARTIAL, ".tsv")
        try:
            with name_write_errors(path):
                recording._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
                fsync_dir(path.parent)
            recording._write("\t".join(columns) + "\n")
        except OSError:
            recording.close()
            raise
        return recording

    @property
    def is_open(self) -> bool:
        """Whether ticks can be appended."""
        return self._handle is not None

    def append(self, rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> None:
        """Append ticks, durably: all of them or, if it raises, none.

        Args:
            rows: a table, or a mapping per tick. An absent column, None and NaN are missing values.

        Raises:
            ValueError: an unknown column, a value that is not a number, or the game is over.
            OSError: they could not be written, as on a full disk; the same rows may be appended again.
        """
        is_table = isinstance(rows, pd.DataFrame)
        names = list(rows) if is_table else list(dict.fromkeys(name for row in rows for name in row))
        if unknown := [str(name) for name in names if name not in self.columns]:
            raise ValueError(f"ticks have the columns {', '.join(unknown)}; allowed are {', '.join(self.columns)}")
        missing = [None] * len(rows)
        if is_table:
            values = [rows[column].tolist() if column in rows else missing for column in self.columns]
        else:
            values = [[row.get(column) for row in rows] for column in self.columns]
        cells = [[_cell(name, value) for value in column] for name, column in zip(self.columns, values, strict=True)]
        self._write("".join("\t".join(row) + "\n" for row in zip(*cells, strict=True)))

    def finish(self, results: Mapping[str, float], facts: Mapping[str, Any] | None = None) -> Game:
        """Complete the game with these results. If this raises, it may be called again.

        Args:
            results: name in `RESULTS` -> value.
            facts: further ones, added to those of `begin`.

        Raises:
            ValueError: results other than `RESULTS`, an infinite one, or the game is over already.
            OSError: they could not be saved.
        """
        if set(results) != set(RESULTS):
            wrong = ", ".join(sorted(set(results) ^ set(RESULTS)))
            raise ValueError(f"results of {self.name}: {wrong} must be there or not: they are {', '.join(RESULTS)}")
        plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in results.items()}
        numbers = {name: plain[name] for name in RESULTS}
        for name, value in numbers.items():
            if not isinstance(value, Real) or isinstance(value, bool) or math.isinf(value):
                raise ValueError(f"results.{name} = {value!r} must be a finite number, or NaN where undefined")
        self.facts |= facts or {}
        self._write("")  # drops a partial write after the last tick
        finite = {name: None if math.isnan(value) else value for name, value in numbers.items()}
        description = self._path(BEHAVIOR, ".json")
        # its rename completes the game; `recover_games` can repeat the rest
        save_json(description, self._description() | {"Results": finite, "Ratings": None, "Interview": ""})
        _complete(self.stem)
        self.close()
        self.games[self.name] = game = Game.load(description)
        return game

    def close(self) -> None:
        """Close the table; a game that was not finished is now interrupted."""
        if self._handle is not None:
            handle, self._handle = self._handle, None
            os.close(handle)

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _path(self, ending: str, suffix: str) -> Path:
        return game_file(self.stem, ending, suffix)

    def _description(self) -> dict[str, Any]:
        own = {"TaskName": "airhockey", "Condition": self.name, "Position": self.position, "Facts": self.facts}
        return own | self.columns

    def _write(self, text: str) -> None:
        """Append to the table durably, after the bytes that are on the disk: a failed partial write is overwritten."""
        if self._handle is None:
            raise ValueError(f"the game {self.name} is not running")
        content, written = memoryview(text.encode("ascii")), 0
        with name_write_errors(self._path(PARTIAL, ".tsv")):
            os.ftruncate(self._handle, self._size)
            while written < len(content):
                written += os.pwrite(self._handle, content[written:], self._size + written)
            os.fsync(self._handle)
        self._size += len(content)


def recover_games(folder: Path) -> list[Path]:
    """Repair a person's folder after a crash: complete finished games and rename interrupted ones.

    Returns:
        The tables of the interrupted games found now, under their final names.
    """
    interrupted = []
    for stem in sorted({folder / file.name.partition(PARTIAL)[0] for file in folder.glob(f"*{PARTIAL}.*")}):
        described, table = (game_file(stem, PARTIAL, suffix) for suffix in (".json", ".tsv"))
        if game_file(stem, BEHAVIOR, ".json").exists():
            _complete(stem)
        elif not table.exists():  # no table yet: the game had not begun
            remove(described)
        else:
            k = 1
            while game_file(stem, f"_desc-interrupted{k}_beh", ".tsv").exists():
                k += 1
            kept = game_file(stem, f"_desc-interrupted{k}_beh", ".tsv")
            if described.exists():
                rename_file(described, kept.with_suffix(".json"))
            rename_file(table, kept)
            interrupted.append(kept)
    return interrupted


def _complete(stem: Path) -> None:
    """Give the table of a finished game its final name; may repeat what was done already."""
    table = game_file(stem, PARTIAL, ".tsv")
    if table.exists():
        rename_file(table, game_file(stem, BEHAVIOR, ".tsv"))
    remove(game_file(stem, PARTIAL, ".json"))


def _cell(name: str, value: Any) -> str:
    """A number as text that is read back bit-identically; only numbers, so that no cell is a spreadsheet formula."""
    if value is None or value is pd.NA:
        return MISSING
    if isinstance(value, bool | np.bool_):
        return str(int(value))
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        number = float(value)
        return MISSING if math.isnan(number) else repr(number)
    raise ValueError(f"ticks.{name} = {value!r} must be a number, or None where it is missing")
