"""The files of one person's games: a table with a row per tick, and what describes it.

    sub-P01_task-airhockey_acq-oahgut_run-3_beh.tsv     a row per tick, columns separated by tabs, n/a where missing
    sub-P01_task-airhockey_acq-oahgut_run-3_beh.json    every column's unit, the game's results, its ratings

While a game is on, both are called `..._desc-partial_beh`, and what has been appended is on the disk. A game is whole
from the moment its description with the results has its final name, which is one rename. What a crash leaves of a game
that is not is kept as `..._desc-interrupted<k>_beh`, and counts for nothing. Nothing here asks what time it is.
"""

import json
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

from airhockey_marl.experiment.files import fsync_dir, name_write_errors, remove, write_text
from guidance.forces.conditions import GuidanceOutput
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.tests import METRICS

UNSCORED = "unscored"  # the game without guidance from which UA learns
OBJECTIVE = tuple(name for name, metric in METRICS.items() if metric.kind == "objective")
RESULTS = (
    *OBJECTIVE,
    "rounds",
    "duration_s",
    *(f"{w}_{part}" for w in GuidanceOutput._fields[1:] for part in ("mean", "sd")),
)
SCALE = range(1, 8)  # of the ratings
MISSING = "n/a"  # BIDS has it so
_PARTIAL, _BEHAVIOR = "_desc-partial_beh", "_beh"

Columns = Mapping[str, Mapping[str, str]]
"""Column -> its description as BIDS has it: `Description` and `Units`, and more if it helps."""


def save_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all, and for good."""
    with name_write_errors(path):
        write_text(path, text)
        fsync_dir(path.parent)


def save_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON without NaN to `path`, whole or not at all, and for good."""
    save_text(path, json.dumps(content, indent=2, default=str, allow_nan=False) + "\n")


def load_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        ValueError: there is another thing in it; the message names the file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # a UnicodeDecodeError is one too
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}, must be a JSON object")
    return content


def _rename(old: Path, new: Path) -> None:
    with name_write_errors(new):
        old.replace(new)
        fsync_dir(new.parent)


@dataclass(frozen=True)
class Game:
    """A whole game.

    Attributes:
        name: of its condition, or `UNSCORED`.
        position: in the person's order, from 1; 0 is the unscored game.
        results: `RESULTS` by name; NaN where undefined.
        ratings: `guidance.simulated_users.ratings.RATINGS` by name, 1 to 7; None until they were given.
        interview: what the person said about it, as it was written down.
        facts: whatever the game was begun with.
        description: the file that has all this.
    """

    name: str
    position: int
    results: dict[str, float]
    ratings: dict[str, int] | None
    interview: str
    facts: dict[str, Any]
    description: Path

    @classmethod
    def load(cls, description: Path) -> "Game":
        """The game that a final `..._beh.json` describes.

        Raises:
            ValueError: it is not one of `Recording.finish`, or its table is gone; the message names the file.
        """
        content = load_json(description)
        try:
            results = {name: content["Results"][name] for name in RESULTS}
            ratings = content["Ratings"] and {name: content["Ratings"][name] for name in RATINGS}
            name, position, interview = content["Condition"], content["Position"], content["Interview"]
            facts = content["Facts"]
        except (KeyError, TypeError) as error:
            raise ValueError(f"{description} does not describe a game: it lacks {error}") from error
        results = {result: math.nan if value is None else value for result, value in results.items()}
        game = cls(name, position, results, ratings, interview, facts, description)
        if not game.file.is_file():
            raise ValueError(f"{description} describes a table that is not there")
        return game

    @property
    def file(self) -> Path:
        """Of its ticks."""
        final = self.description.with_suffix(".tsv")
        partial = final.with_name(final.name.removesuffix(_BEHAVIOR + ".tsv") + _PARTIAL + ".tsv")
        return partial if partial.is_file() else final  # it is about to get its final name, see `rescue`

    def ticks(self) -> pd.DataFrame:
        """The table as it was appended, a row per tick; every float has the bits that it had."""
        return pd.read_csv(
            self.file, sep="\t", na_values=[MISSING], keep_default_na=False, float_precision="round_trip"
        )

    def rated(self, ratings: Mapping[str, int], interview: str) -> "Game":
        """The same game with ratings, which are saved with it. The same ratings may be saved again, with an interview.

        Raises:
            ValueError: other items than `RATINGS`, a value that is not a whole number from 1 to 7, a game that is not
                rated, or one that has other ratings.
            OSError: they could not be saved.
        """
        if self.name == UNSCORED:
            raise ValueError(f"ratings of {self.name}: this game is not rated")
        if set(ratings) != set(RATINGS):
            raise ValueError(f"ratings of {self.name} = {', '.join(map(str, ratings))} must be {', '.join(RATINGS)}")
        for name, value in ratings.items():
            if not isinstance(value, Integral) or isinstance(value, bool) or value not in SCALE:
                raise ValueError(f"ratings.{name} = {value!r} must be a whole number from {SCALE[0]} to {SCALE[-1]}")
        ratings = {name: int(ratings[name]) for name in RATINGS}
        if self.ratings is not None and (self.ratings != ratings or self.interview not in ("", interview)):
            raise ValueError(f"ratings of {self.name}: there are some already, {self.ratings}")
        save_json(self.description, load_json(self.description) | {"Ratings": ratings, "Interview": interview})
        return Game.load(self.description)


@dataclass
class Recording:
    """A game that is on. A context manager: left without `finish`, its file is closed and the game is interrupted.

    Attributes:
        stem: the path of its files, without what follows the run.
        name, position, columns, facts, games: see `begin`.
    """

    stem: Path
    name: str
    position: int
    columns: dict[str, dict[str, str]]
    facts: dict[str, Any]
    games: dict[str, Game]
    _handle: int | None = field(default=None, repr=False)
    _size: int = field(default=0, repr=False)  # bytes that are known to be on the disk

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
        """Begin a game's files.

        Args:
            columns: what each column is, in their order.
            facts: any JSON that is worth keeping with the game, such as versions and the device.
            games: where the game goes by its name once it is whole.

        Raises:
            ValueError: a column without a name in small letters, a description or a unit.
            OSError: the files could not be made.
        """
        for column, description in columns.items():
            if not re.fullmatch(r"[a-z][a-z0-9_]*", column):  # BIDS' own keys stand beside it, in capitals
                raise ValueError(f"columns: {column!r} must be small letters, digits and underscores")
            if absent := [key for key in ("Description", "Units") if not description.get(key)]:
                raise ValueError(f"columns.{column} lacks {', '.join(absent)}")
        if not columns:
            raise ValueError("columns = {} must name at least one")
        described = {name: dict(description) for name, description in columns.items()}
        recording = cls(stem, name, position, described, dict(facts), games)
        save_json(recording._path(_PARTIAL, ".json"), recording._description())
        path = recording._path(_PARTIAL, ".tsv")
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
    def on(self) -> bool:
        """Whether ticks can be appended."""
        return self._handle is not None

    def append(self, rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> None:
        """Append ticks; when this returns they are on the disk. All of them or, if it raises, none.

        Args:
            rows: a table, or a mapping per tick. A column that is absent, None or NaN is missing.

        Raises:
            ValueError: an unknown column, a value that is no number, or the game is over.
            OSError: they could not be written, as on a full disk; the same rows may be appended again.
        """
        table = isinstance(rows, pd.DataFrame)
        names = list(rows) if table else list(dict.fromkeys(name for row in rows for name in row))
        if unknown := [str(name) for name in names if name not in self.columns]:
            raise ValueError(f"ticks have the columns {', '.join(unknown)}; allowed are {', '.join(self.columns)}")
        nothing = [None] * len(rows)
        if table:
            values = [rows[column].tolist() if column in rows else nothing for column in self.columns]
        else:
            values = [[row.get(column) for row in rows] for column in self.columns]
        cells = [[_cell(name, value) for value in column] for name, column in zip(self.columns, values, strict=True)]
        self._write("".join("\t".join(row) + "\n" for row in zip(*cells, strict=True)))

    def finish(self, results: Mapping[str, float], facts: Mapping[str, Any] | None = None) -> Game:
        """The game is over, with these results: from now on it is whole. If this raises, it may be called again.

        Args:
            results: `RESULTS` by name.
            facts: what else there is to say of the game now; joins those that it was begun with.

        Raises:
            ValueError: other results than `RESULTS`, an infinite one, or the game is over already.
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
        self._write("")  # nothing after the last tick that was appended
        known = {name: None if math.isnan(value) else value for name, value in numbers.items()}
        description = self._path(_BEHAVIOR, ".json")
        # this rename is the moment; what follows can be made up for, see `rescue`
        save_json(description, self._description() | {"Results": known, "Ratings": None, "Interview": ""})
        _complete(self.stem)
        self.close()
        self.games[self.name] = game = Game.load(description)
        return game

    def close(self) -> None:
        """Append no more; a game that was not finished is now an interrupted one."""
        if self._handle is not None:
            handle, self._handle = self._handle, None
            os.close(handle)

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _path(self, ending: str, suffix: str) -> Path:
        return _named(self.stem, ending, suffix)

    def _description(self) -> dict[str, Any]:
        own = {"TaskName": "airhockey", "Condition": self.name, "Position": self.position, "Facts": self.facts}
        return own | self.columns

    def _write(self, text: str) -> None:
        """Append to the table and have it on the disk, after what is known to be there: a part of a write is none."""
        if self._handle is None:
            raise ValueError(f"the game {self.name} is not on")
        content, written = memoryview(text.encode("ascii")), 0
        with name_write_errors(self._path(_PARTIAL, ".tsv")):
            os.ftruncate(self._handle, self._size)
            while written < len(content):
                written += os.pwrite(self._handle, content[written:], self._size + written)
            os.fsync(self._handle)
        self._size += len(content)


def rescue(folder: Path) -> list[Path]:
    """Put a person's folder in order after a crash: complete the games that were whole, set aside those that were not.

    Returns:
        The tables of interrupted games that were set aside now, whose names nothing else will have.

    Raises:
        OSError: a file could not be renamed; another call goes on.
    """
    aside = []
    for stem in sorted({folder / file.name.partition(_PARTIAL)[0] for file in folder.glob(f"*{_PARTIAL}.*")}):
        described, table = (_named(stem, _PARTIAL, suffix) for suffix in (".json", ".tsv"))
        if _named(stem, _BEHAVIOR, ".json").exists():
            _complete(stem)
        elif not table.exists():  # the game had not begun
            remove(described)
        else:
            k = 1
            while _named(stem, f"_desc-interrupted{k}_beh", ".tsv").exists():
                k += 1
            kept = _named(stem, f"_desc-interrupted{k}_beh", ".tsv")
            if described.exists():
                _rename(described, kept.with_suffix(".json"))
            _rename(table, kept)
            aside.append(kept)
    return aside


def games_in(folder: Path) -> dict[str, Game]:
    """The whole games in a person's folder that has been rescued, by name, in the order of their positions.

    Raises:
        ValueError: a file that is not as it was written; the message names it.
    """
    files = (file for file in folder.glob(f"*{_BEHAVIOR}.json") if "_desc-" not in file.name)
    games = sorted(map(Game.load, files), key=lambda game: game.position)
    return {game.name: game for game in games}


def _named(stem: Path, ending: str, suffix: str) -> Path:
    return stem.with_name(stem.name + ending + suffix)


def _complete(stem: Path) -> None:
    """Give the table of a whole game its final name; any part of it may have been done."""
    table = _named(stem, _PARTIAL, ".tsv")
    if table.exists():
        _rename(table, _named(stem, _BEHAVIOR, ".tsv"))
    remove(_named(stem, _PARTIAL, ".json"))


def _cell(name: str, value: Any) -> str:
    """A number as text from which the same bits can be read; numbers only, so that no cell is ever a formula."""
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
