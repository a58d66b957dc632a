"""Read recorded play: folders of `airhockey collect`, `play` and `lab`, and tables of one's own.

A table has the columns of `guidance.user_model.dataset.COLUMNS`, in their units and frame (README.md in this folder):
`REQUIRED` ones, and `user` and `game` where it holds several. CSV is read as Excel and R write it, with commas,
semicolons or tabs. Whatever does not fit is refused by file, row and column; rows are numbered as a spreadsheet numbers
them, so that the header of a CSV is row 1.
"""

import csv
import hashlib
import re
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import torch

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.experiment.files import sha256
from guidance.user_model.data import Recordings, Samples
from guidance.user_model.dataset import AXES, BODIES, FRAME, ROWS

STATE = tuple(f"{body}_{axis}" for body in BODIES for axis in AXES)
ACTION = ("action_x", "action_y")
REQUIRED = ("time_s", *STATE, *ACTION)
OPTIONAL = {"scored": 1, "held": 1, "force_x": 0, "force_y": 0}  # of the tables of `play` and `lab`, and what is usual
NAMES = ("user", "game")  # text; without them a file is one game of one person
TICKS = "*_beh.tsv"  # tables of `play` and `lab`
MAX_SPEED = 20.0  # m/s, of anything
# median ratio of two columns that measure the same; a paddle's speed changes within a tick, and turns in a rally
FIT, FIT_OF_PADDLE = (0.2, 5.0), (-0.2, 5.0)
FIT_TICKS = 50  # in motion, at least, to compare them


def read_recordings(place: Path | str, shortest: int) -> tuple[Recordings, dict[str, Any]]:
    """The play without guidance in a file or folder, in pieces of contiguous ticks of one game.

    Args:
        place: a table (.csv, .tsv, .parquet), or a folder: with recordings of `play` or `lab` at or below it, of a run
            of `collect`, or with tables in it.
        shortest: ticks; shorter pieces are left out.

    Returns:
        The recordings, and facts for a card: people, games, ticks, what is left out, and the SHA-256 of the file, of
        several files that of their sorted hashes.

    Raises:
        ValueError: there is nothing to read, or a table does not fit; names file, row and column.
    """
    place, table = Path(place), TableSpec()
    people: dict[str, list[Samples]] = {}
    left_out = {"people": 0, "games_with_guidance": 0, "ticks_not_scored_or_not_held": 0, "ticks_in_short_pieces": 0}
    games, files, everybody = 0, find_tables(place), set()
    for file in files:
        ticks = read_table(file, _person(file, place))
        _check_values(file, ticks, table)
        everybody |= {*ticks["user"]}
        played = (ticks["scored"] == 1) & (ticks["held"] == 1)
        left_out["ticks_not_scored_or_not_held"] += int((~played).sum())
        by_game = [game for _, game in ticks[played].groupby([*NAMES], sort=False)]
        _check_times(file, by_game, table.tick)
        _check_fit(file, by_game, table)
        for game in by_game:
            if game[["force_x", "force_y"]].any(axis=None):
                left_out["games_with_guidance"] += 1
                continue
            games += 1
            piece = (game["time_s"].diff() > 1.25 * table.tick).cumsum()
            for _, part in game.groupby(piece):
                if len(part) < shortest:
                    left_out["ticks_in_short_pieces"] += len(part)
                    continue
                observation, action = (part[[*names]].to_numpy(np.float32) for names in (STATE, ACTION))
                samples = torch.from_numpy(observation), torch.from_numpy(action)
                people.setdefault(part["user"].iat[0], []).append(samples)
    left_out["people"] = len(everybody - {*people})
    if not people:
        raise ValueError(
            f"data = {place} must have {shortest} ticks in a row ({shortest * table.tick:g} s) without guidance; "
            f"left out: {words(left_out)}"
        )
    total = sum(len(action) for pieces in people.values() for _, action in pieces)
    facts = {"people": len(people), "games": games, "ticks": total, "left_out": left_out}
    hashes = sorted(map(sha256, files))
    one = hashes[0] if len(files) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return Recordings(people), facts | {"sha256": one}


def words(left_out: dict[str, int]) -> str:
    """What is left out, as text."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in left_out.items() if count) or "nothing"


def find_tables(place: Path) -> list[Path]:
    """The tables of a file or folder, see `read_recordings`; interrupted games of `lab` are none."""
    if place.is_file():
        return [place]
    if not place.is_dir():
        raise ValueError(f"data = {place}: no such file or folder")
    recorded = sorted(file for file in place.rglob(TICKS) if "_desc-" not in file.name)
    collected = [file for file in [place / ROWS] if file.is_file()]
    others = sorted(file for file in place.iterdir() if file.suffix.lower() in (".csv", ".tsv", ".parquet"))
    tables = recorded or collected or others
    if not tables:
        raise ValueError(f"data = {place} must have tables of ticks: {TICKS}, {ROWS}, or .csv, .tsv, .parquet")
    return tables


def _person(file: Path, place: Path) -> str:
    """Whose table it is, if no column says so: the label of `lab`, the folder of `play`, or the file's name."""
    if label := re.match(r"sub-([^_]+)_", file.name):
        return label[1]
    if not file.match(TICKS):
        return file.stem
    folder = file.parent.relative_to(place) if file != place else Path()
    return str(folder) if folder.parts else file.resolve().parent.name


def read_table(file: Path, person: str) -> pd.DataFrame:
    """The columns `NAMES`, `REQUIRED` and `OPTIONAL` of a table, numbers as float64, indexed by the file's rows.

    Args:
        person: the user, if the table has no such column.
    """
    suffix = file.suffix.lower()
    try:
        if suffix == ".parquet":
            header, separator = pq.read_schema(file).names, "."
            content = pq.read_table(file, columns=_known(file, header))
            ticks = content.to_pandas(ignore_metadata=True)  # no column is an index
            ticks.index += 1
        elif suffix in (".csv", ".tsv"):
            with file.open(encoding="utf-8-sig", newline="") as handle:
                first = handle.readline()
                delimiter = max("\t;,", key=first.count)
                header, second = (
                    next(csv.reader([line], delimiter=delimiter), []) for line in (first, handle.readline())
                )
            known = _known(file, header)
            if len(second) > len(header):  # pandas would take what is too much for an index
                raise ValueError(f"row 2 has {len(second)} cells, must be {len(header)}, as the header")
            separator = "," if delimiter == ";" else "."
            ticks = pd.read_csv(
                file,
                sep=delimiter,
                decimal=separator,
                encoding="utf-8-sig",
                dtype={name: str for name in known if _plain(name) in NAMES},
                skip_blank_lines=False,
                low_memory=False,
            )[known]
            ticks.index += 2
        else:
            raise ValueError(f"its name must end in .csv, .tsv or .parquet, and not in {suffix!r}")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file}: its text must be UTF-8: {error.reason} at byte {error.start}") from error
    except (ValueError, OSError) as error:  # of pandas and pyarrow
        text = str(error).removeprefix(f"{file}: ").strip()
        raise ValueError(f"{file}: {text.splitlines()[0] if text else type(error).__name__}") from error
    ticks.columns = [_plain(name) for name in ticks.columns]
    ticks = ticks.dropna(how="all")
    for name, default in (("user", person), ("game", "")):
        ticks[name] = ticks[name].astype(str).str.strip().where(ticks[name].notna()) if name in ticks else default
        if ticks[name].isna().any():
            raise ValueError(f"{file}: row {ticks.index[ticks[name].isna()][0]}, column {name} must not be empty")
    for name in (*REQUIRED, *OPTIONAL):
        ticks[name] = _numbers(file, ticks[name], separator) if name in ticks else OPTIONAL[name]
    return ticks


def _plain(name: str) -> str:
    return str(name).strip().lower()


def _known(file: Path, header: list[str]) -> list[str]:
    """The names of the header that are columns of ours; a ValueError names one that is missing or there twice."""
    plain = [_plain(name) for name in header]
    for name in REQUIRED:
        if name not in plain:
            near = get_close_matches(name, plain, 1)
            hint = f"is {near[0]} meant?" if near else f"there are {', '.join(plain)[:80]}"
            raise ValueError(f"{file}: column {name} is missing; {hint}")
    known = [name for name in header if _plain(name) in (*NAMES, *REQUIRED, *OPTIONAL)]
    for name in known:
        if plain.count(_plain(name)) > 1:
            raise ValueError(f"{file}: column {_plain(name)} must be there once")
    return known


def _numbers(file: Path, column: pd.Series, separator: str) -> pd.Series:
    """A column as float64, its cells finite numbers."""
    name, text = _plain(column.name), not pd.api.types.is_numeric_dtype(column)
    cells = column.astype(str).str.replace(separator, ".", regex=False) if text else column
    numbers = pd.to_numeric(cells, errors="coerce").astype(np.float64)
    if name in ("force_x", "force_y"):  # absent where there was none
        numbers = numbers.fillna(0.0)
    if not (finite := np.isfinite(numbers)).all():
        row = finite.idxmin()
        cell = "an empty cell" if pd.isna(column[row]) else repr(column[row] if text else float(column[row]))
        raise ValueError(f"{file}: row {row}, column {name}: {cell} must be a finite number")
    return numbers


def _check_values(file: Path, ticks: pd.DataFrame, table: TableSpec) -> None:
    """Raise a ValueError for a body off the table or on the wrong side of it, one too fast, and a wrong action."""
    rounding, length, width, frame = 1e-3, table.length / 2, table.width / 2, FRAME.partition(";")[0]
    bounds = {name: (-MAX_SPEED, MAX_SPEED, "m/s", "") for name in STATE if name[-2] == "v"}
    bounds |= {f"{body}_y": (-width, width, "m", frame) for body in BODIES}
    bounds |= {"own_x": (-length, 0.0, "m", frame), "other_x": (0.0, length, "m", frame)}
    bounds |= {"puck_x": (-length - 0.1, length + 0.1, "m", frame)}  # behind a goal line
    bounds |= dict.fromkeys(ACTION, (-1.0, 1.0, "", "1 is the end of the hand's reach"))
    for name, (low, high, unit, meaning) in bounds.items():
        outside = ~ticks[name].between(low - rounding, high + rounding)
        if outside.any():
            row = outside.idxmax()
            value = ticks[name][row]
            hint = f"; is it in m{unit} or c{unit}?" if unit and ticks[name].abs().max() > 5 * max(-low, high) else ""
            allowed = f"must be from {low:g} to {high:g} {unit}".rstrip() + (f" ({meaning})" if meaning else "")
            raise ValueError(f"{file}: row {row}, column {name}: {value:g} {allowed}{hint}")


def _check_times(file: Path, games: list[pd.DataFrame], tick: float) -> None:
    """Raise a ValueError unless the rows of each game follow one another at the distance of a tick, pauses aside."""
    steps = pd.concat([pd.Series(dtype=float), *(game["time_s"].diff().iloc[1:] for game in games)])
    if steps.empty:
        return
    usual = steps.median()
    if not abs(usual - tick) < 0.1 * tick:
        raise ValueError(f"{file}: column time_s: rows are {usual:g} s apart (median), must be {tick:g} s")
    if (early := steps < 0.75 * tick).any():
        row = early.idxmax()
        raise ValueError(
            f"{file}: row {row}, column time_s: {steps[row]:g} s after the row before of its game, must be {tick:g} s"
        )


def _check_fit(file: Path, games: list[pd.DataFrame], table: TableSpec) -> None:
    """Raise a ValueError for a velocity or an action that is in other units, or of another frame, than positions."""

    def pairs() -> Iterator[tuple[str, str, pd.Series, float, tuple[float, float]]]:
        for body, fit in (("own", FIT_OF_PADDLE), ("puck", FIT)):
            for axis in "xy":
                place = f"{body}_{axis}"
                moved = pd.concat([game[place].diff() / game["time_s"].diff() for game in games])
                yield f"{body}_v{axis}", f"how {place} changes", moved.where(moved.abs() < MAX_SPEED), 0.05, fit
        for name, middle, half in zip(ACTION, *action_range(table), strict=True):
            place = name.replace("action", "own")
            yield name, f"{place}, the paddle's place", (rows[place] - middle) / half, 0.1, FIT

    if not games:
        return
    rows = pd.concat(games)
    for name, other, expected, least, (low, high) in pairs():
        moving = expected.abs() > least
        ratio = (rows[name][moving] / expected[moving]).median()
        if moving.sum() >= FIT_TICKS and not low < ratio < high:
            raise ValueError(
                f"{file}: column {name} does not fit {other}: it is {ratio:.3g} times as large (median), "
                f"must be about as large; units or axes differ"
            )
