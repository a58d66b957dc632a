"""Tables as CSV or TSV, as this project, R, Excel and other programs write them, read and checked cell by cell.

pandas is imported by the function that reads.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from airhockey_marl.experiment.registry import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

SEPARATORS = ",;\t"
NUMBER = r"[+-]?([0-9]+[.,]?[0-9]*|[.,][0-9]+)([eE][+-]?[0-9]+)?"
MAX_SHOWN = 40  # characters of a cell in a message


@dataclass(frozen=True)
class Column:
    """What the cells of a column must be: finite numbers, unless `text` or `names` is given.

    Attributes:
        low, high: least and largest number.
        whole: the numbers are whole.
        missing: cells may be empty.
        optional: the column may be absent.
        text: the cells are texts.
        names: spelling -> name: the cells are one of these, in any case and with any spaces around.
    """

    low: float = -inf
    high: float = inf
    whole: bool = False
    missing: bool = False
    optional: bool = False
    text: bool = False
    names: Mapping[str, str] | None = None

    @property
    def is_text(self) -> bool:
        """Whether the cells are texts."""
        return self.text or self.names is not None

    @property
    def allowed(self) -> str:
        """What a cell must be, in words."""
        if self.is_text:
            return "a name" if self.names is None else f"one of {', '.join(dict.fromkeys(self.names.values()))}"
        kind = "a whole number" if self.whole else "a number"
        if self.low > -inf and self.high < inf:
            kind += f" from {self.low:g} to {self.high:g}"
        elif self.low > -inf:
            kind += f" of at least {self.low:g}"
        return kind + (" or empty" if self.missing else "")


def read_table(path: Path | str, columns: Mapping[str, Column], float_precision: str | None = None) -> pd.DataFrame:
    """Read a table with a header.

    Cells are separated by commas, semicolons or tabs, and quoted where necessary; numbers have points or commas; the
    text is UTF-8 or UTF-16. Empty rows, and a column of row numbers as R writes it, are left out.

    Args:
        columns: those that are checked; others are kept as they are.
        float_precision: of `pandas.read_csv`; "round_trip" reads floats bit-identically.

    Raises:
        ValueError: the file is missing or is no such table, or a cell is not what it must be. The message names the
            file, the row as a spreadsheet counts it, the column, the value and what is allowed.
    """
    import pandas as pd
    from pandas.api.types import is_bool_dtype, is_numeric_dtype

    text = _decoded(Path(path))
    separator, header, lines = _split(path, text)
    header = _spelled_header(path, header, columns)
    if lines is not None:  # written by others: written again as this project does
        text, separator = _as_csv(header, [cells for _, cells in lines]), ","
    texts = {name: "str" for name in header if name in columns and columns[name].is_text}

    def refusal(row: int, name: str) -> ValueError:
        places = list(enumerate(_rows(path, text, separator), 1))[1:] if lines is None else lines
        number, cells = places[row]
        value, column = cells[header.index(name)].strip(), columns[name]
        near, shown = did_you_mean(value.casefold(), column.names or ()), repr(value[:MAX_SHOWN]) if value else "empty"
        return ValueError(f"{path}: row {number}, {name} = {shown} must be {column.allowed}{near}")

    options = {"names": header, "header": 0, "dtype": texts, "float_precision": float_precision, "low_memory": False}
    for decimal in ".,":
        table = pd.read_csv(io.StringIO(text), sep=separator, decimal=decimal, **options)
        numeric = {name: is_numeric_dtype(table[name]) and not is_bool_dtype(table[name]) for name in header}
        unread = [name for name in columns if name in header and name not in texts and not numeric[name]]
        if not unread:
            break
    for name in unread:
        cells = table[name].dropna().astype("str")
        if (wrong := ~cells.str.fullmatch(NUMBER)).any():
            raise refusal(wrong.idxmax(), name)
        if cells.str.contains(",").any() and cells.str.contains(".", regex=False).any():
            raise ValueError(f"{path}: {name} has decimal points and decimal commas, must have one of them")
        table[name] = cells.str.replace(",", ".").astype(float).reindex(table.index)
    for name, column in columns.items():
        if name in texts:
            values = table[name].str.strip()
            if column.names is not None:
                spelled = {_plain(spelling): known for spelling, known in column.names.items()}
                values = values.map(lambda value, known=spelled: known.get(_plain(value)), na_action="ignore")
            wrong, table[name] = values.isna() | values.eq(""), values
        elif name in header:
            values = table[name].astype(float)
            wrong = values.lt(column.low) | values.gt(column.high) | values.abs().eq(inf)
            wrong |= (values.mod(1).gt(0) | values.abs().ge(2.0**63)) & column.whole
            wrong |= values.isna() & (not column.missing)
        else:
            continue
        if wrong.any():
            raise refusal(wrong.idxmax(), name)
        if column.whole and not column.missing:
            table[name] = table[name].astype("int64")
    return table


def _plain(text: str) -> str:
    return " ".join(text.split()).casefold()


def _decoded(path: Path) -> str:
    """The text of a file in UTF-8 or, as Excel saves Unicode text, in UTF-16."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"no such file: {path}") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}: row {row} is not text in UTF-8: save it as CSV UTF-8") from error
    if not text.strip() or "\0" in text:
        raise ValueError(f"{path} must be a table, and is {'no text' if text.strip() else 'empty'}")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _rows(path: Path | str, text: str, separator: str) -> list[list[str]]:
    try:
        return list(csv.reader(io.StringIO(text), delimiter=separator, strict=True))
    except csv.Error as error:
        raise ValueError(f"{path} is not a table: {error}") from error


def _split(path: Path | str, text: str) -> tuple[str, list[str], list[tuple[int, list[str]]] | None]:
    """Separator, header, and the rows that are not empty, each with its number in a spreadsheet.

    The rows are None if all lines are as this project writes them: unquoted, and with as many cells as the header.
    """
    hint = re.match("sep=(.)\n", text)  # a line for Excel, which does not show it
    text = text[hint.end() :] if hint else text
    first = text.lstrip("\n").partition("\n")[0]
    separator = hint[1] if hint else max(SEPARATORS, key=first.count)
    header, lines = first.split(separator), text.removesuffix("\n").split("\n")
    is_ours = not hint and '"' not in text and all(name and name == name.strip() for name in header)
    if is_ours and all(line.strip(separator) and line.count(separator) == len(header) - 1 for line in lines):
        return separator, header, None
    rows = [(n, row) for n, row in enumerate(_rows(path, text, separator), 1) if any(map(str.strip, row))]
    header = [name.strip() for name in rows.pop(0)[1]]
    while header and not header[-1]:
        header.pop()
    if rows and all(len(row) == len(header) + 1 and row[-1] for _, row in rows):  # row numbers, without a name
        header.insert(0, "")
    for n, row in rows:
        if len(row) < len(header) or any(map(str.strip, row[len(header) :])):
            raise ValueError(f"{path}: row {n} has {len(row)} cells, must have {len(header)}, as the header")
    kept = [place for place, name in enumerate(header) if name]
    return separator, [header[place] for place in kept], [(n, [row[place] for place in kept]) for n, row in rows]


def _as_csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows([header, *([cell.strip() for cell in row] for row in rows)])
    return written.getvalue()


def _spelled_header(path: Path | str, header: Sequence[str], columns: Mapping[str, Column]) -> list[str]:
    """The header with known names spelled as in `columns`; each must be there, and none twice."""
    spelled = {name.casefold(): name for name in columns}
    header = [spelled.get(name.casefold(), name) for name in header]
    if twice := next((name for name in header if header.count(name) > 1), None):
        raise ValueError(f"{path}: row 1, column {twice} must be there once")
    if absent := [name for name, column in columns.items() if name not in header and not column.optional]:
        near = did_you_mean(absent[0], [name for name in header if name not in columns])
        raise ValueError(f"{path} lacks the columns {', '.join(absent)}{near}")
    return header
