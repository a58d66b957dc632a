"""Recording a game of one person: a table with a row per tick, and its description.

    sub-P01_task-airhockey_acq-oahgut_run-3_beh.tsv     a row per tick, columns separated by tabs, n/a where missing
    sub-P01_task-airhockey_acq-oahgut_run-3_beh.json    units of the columns, results of the game, ratings

During a game, both are named `..._desc-partial_beh`, and appended ticks are on the disk. The game is complete once its
description with the results has its final name, which is one rename. The files of an interrupted game are renamed to
`..._desc-interrupted<k>_beh` and are not evaluated. Nothing here depends on the time of files.
"""

import math
import os
from collections.abc import Mapping, Sequence
from itertools import count
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from airhockey_marl.experiment.files import fsync_dir, name_write_errors, remove
from guidance.sessions.game import BEHAVIOR, MISSING, PARTIAL, RESULTS, Game, game_file
from guidance.sessions.json_files import rename_file, save_json
from guidance.study.metrics import COUNTS

Columns = Mapping[str, Mapping[str, str]]
"""Column -> its description in BIDS: `Description`, `Units`, and optionally more."""


class Recording:
    """The files of a running game; a context manager that interrupts the game if it is left before `finish`.

    Args:
        stem: path of its files without ending and suffix.
        name: of its condition, or `UNSCORED`.
        position: in the person's order, from 1; 0 for the unscored game.
        columns: descriptions of the columns, in their order; small letters, as the keys of BIDS have capitals.
        facts: any JSON to keep with the game, such as the device.
        games: receives the game under its name when it is complete.
    """

    def __init__(
        self, stem: Path, name: str, position: int, columns: Columns, facts: Mapping[str, Any], games: dict[str, Game]
    ) -> None:
        self.stem, self.name, self.position, self.games = stem, name, position, games
        self.columns, self.facts = {key: dict(description) for key, description in columns.items()}, dict(facts)
        self._handle: int | None = None
        self._size = 0  # bytes that are on the disk
        save_json(game_file(stem, PARTIAL, ".json"), self._description())
        path = game_file(stem, PARTIAL, ".tsv")
        try:
            with name_write_errors(path):
                self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
                fsync_dir(path.parent)
            self._write("\t".join(columns) + "\n")
        except OSError:
            self.close()
            raise

    @property
    def is_open(self) -> bool:
        """Whether ticks can be appended."""
        return self._handle is not None

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Append ticks, durably: all of them or, if it raises, none.

        Args:
            rows: a mapping per tick. An absent column, None and NaN are missing values.

        Raises:
            ValueError: a value that is not a number, or the game is over.
            OSError: they could not be written, as on a full disk; the same rows may be appended again.
        """
        cells = [[_cell(name, row.get(name)) for name in self.columns] for row in rows]
        self._write("".join("\t".join(row) + "\n" for row in cells))

    def finish(self, results: Mapping[str, float], facts: Mapping[str, Any] | None = None) -> Game:
        """Complete the game with these results. If this raises, it may be called again.

        Args:
            results: name in `RESULTS`, or in `guidance.study.metrics.COUNTS` -> value.
            facts: further ones, added to those from the start.

        Raises:
            ValueError: an infinite result, or the game is over already.
            OSError: they could not be saved.
        """
        self.facts |= facts or {}
        self._write("")  # drops a partial write after the last tick
        finite = {name: None if math.isnan(results[name]) else results[name] for name in RESULTS}
        description = game_file(self.stem, BEHAVIOR, ".json")
        # its rename completes the game; `recover_games` can repeat the rest
        counts = {name: int(results[name]) for name in COUNTS if name in results}
        numbers = {"Results": finite, "Counts": counts}
        save_json(description, self._description() | numbers | {"Ratings": None, "Interview": ""})
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

    def _description(self) -> dict[str, Any]:
        own = {"TaskName": "airhockey", "Condition": self.name, "Position": self.position, "Facts": self.facts}
        return own | self.columns

    def _write(self, text: str) -> None:
        """Append to the table durably, after the bytes that are on the disk: a failed partial write is overwritten."""
        if self._handle is None:
            raise ValueError(f"the game {self.name} is not running")
        content, written = memoryview(text.encode("ascii")), 0
        with name_write_errors(game_file(self.stem, PARTIAL, ".tsv")):
            os.ftruncate(self._handle, self._size)
            while written < len(content):
                written += os.pwrite(self._handle, content[written:], self._size + written)
            os.fsync(self._handle)
        self._size += len(content)


def recover_games(folder: Path) -> None:
    """Repair a person's folder after a crash: complete finished games and rename interrupted ones."""
    for stem in sorted({folder / file.name.partition(PARTIAL)[0] for file in folder.glob(f"*{PARTIAL}.*")}):
        described, table = (game_file(stem, PARTIAL, suffix) for suffix in (".json", ".tsv"))
        if game_file(stem, BEHAVIOR, ".json").exists():
            _complete(stem)
        elif not table.exists():  # no table yet: the game had not begun
            remove(described)
        else:
            names = (game_file(stem, f"_desc-interrupted{k}_beh", ".tsv") for k in count(1))
            kept = next(name for name in names if not name.exists())
            if described.exists():
                rename_file(described, kept.with_suffix(".json"))
            rename_file(table, kept)


def _complete(stem: Path) -> None:
    """Give the table of a finished game its final name; may repeat what was done already."""
    table = game_file(stem, PARTIAL, ".tsv")
    if table.exists():
        rename_file(table, game_file(stem, BEHAVIOR, ".tsv"))
    remove(game_file(stem, PARTIAL, ".json"))


def _cell(name: str, value: Any) -> str:
    """A number as text that is read back bit-identically; only numbers, so that no cell is a spreadsheet formula."""
    if value is None:
        return MISSING
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        number = float(value)
        return MISSING if math.isnan(number) else repr(number)
    raise ValueError(f"ticks.{name} = {value!r} must be a number, or None where it is missing")
