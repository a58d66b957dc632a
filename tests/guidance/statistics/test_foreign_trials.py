"""`trials.csv` as other programs write it: dialects that are read, and cells that are refused in one line."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.groups import Group, gather, merge
from guidance.statistics.report import screen_table
from tests.guidance.statistics.test_report import synthetic_trials

TRIALS = synthetic_trials(users=3)


def saved(folder: Path, text: str | bytes) -> Path:
    (folder / "trials.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def as_r(trials: pd.DataFrame, **options) -> str:
    """As `write.csv` and `write.csv2` of R: texts in quotes, NA, and names of rows."""
    options = {"index_label": "", "na_rep": "NA", "quoting": 2} | options
    return trials.set_axis(range(1, len(trials) + 1)).to_csv(**options)


DIALECTS = {
    "ours": lambda t: t.to_csv(index=False),
    "R write.csv": as_r,
    "R write.csv2": lambda t: as_r(t, sep=";", decimal=","),
    "R write.table": lambda t: as_r(t, sep="\t").replace('""\t', "", 1),  # no name for the names of rows
    "R row.names=FALSE": lambda t: t.to_csv(index=False, na_rep="NA", quoting=2),
    "Excel, German": lambda t: "\ufeff" + t.to_csv(index=False, sep=";", decimal=",", lineterminator="\r\n"),
    "Excel, points": lambda t: t.to_csv(index=False, sep=";", lineterminator="\r\n"),
    "Excel, Unicode text": lambda t: t.to_csv(index=False, sep="\t", decimal=",").encode("utf-16"),
    "Excel, hint": lambda t: "sep=;\r\n" + t.to_csv(index=False, sep=";", lineterminator="\r\n"),
    "Excel, cleared cells": lambda t: t.to_csv(index=False).replace("\n", ",,\n") + "," * (t.shape[1] + 1) + "\n\n",
    "Excel, old Mac": lambda t: t.to_csv(index=False, lineterminator="\r"),
    "Sheets, German": lambda t: t.to_csv(index=False, decimal=",", quoting=1),
    "spaces": lambda t: t.to_csv(index=False).replace(",", " , "),
    "capitals": lambda t: t.assign(condition=t["condition"].str.upper() + " ").to_csv(index=False),
    "labels": lambda t: t.assign(condition=[CONDITIONS[c].label.lower() for c in t["condition"]]).to_csv(index=False),
    "header": lambda t: t.rename(columns=str.upper).to_csv(index=False),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_are_read_alike(tmp_path, dialect):
    read = merge([saved(tmp_path, DIALECTS[dialect](TRIALS))])
    pd.testing.assert_frame_equal(read, TRIALS, check_dtype=False, check_exact=dialect == "ours", rtol=1e-15)


def test_our_own_tables_are_read_as_pandas_does(tmp_path):
    file = saved(tmp_path, TRIALS.to_csv(index=False)) / "trials.csv"
    expected = pd.read_csv(file, dtype={"user": "str", "condition": "str"})
    pd.testing.assert_frame_equal(merge([tmp_path]), expected, check_exact=True)


def changed(row: int, column: str, value: str) -> str:
    """The trials with another text in one cell; rows as a spreadsheet counts them."""
    trials = TRIALS.astype("object")
    trials.loc[row - 2, column] = value
    return trials.to_csv(index=False)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("user", "", "row 5, user = empty must be a name"),
        ("user", "NA", "row 5, user = 'NA' must be a name"),
        ("user", "  ", "row 5, user = empty must be a name"),
        ("user", "s02", "user = 'S02' must differ from 's02' in more than capitals"),
        ("condition", "", "row 5, condition = empty must be one of nhg, oahg, oahg_ut, "),
        ("condition", "nhgg", "row 5, condition = 'nhgg' must be one of .*; did you mean nhg?"),
        ("condition", "OAGH (UT)", "row 5, condition = 'OAGH (UT)' must be one of .*; did you mean oahg_ut?"),
        ("condition", "<b>\nmine", "row 5, condition = '<b>\\\\nmine' must be one of"),
        ("win_rate", "much", "row 5, win_rate = 'much' must be a number from 0 to 1 or empty"),
        ("win_rate", "53 %", "row 5, win_rate = '53 %' must be"),
        ("win_rate", "TRUE", "row 5, win_rate = 'TRUE' must be"),
        ("win_rate", "1.01", "row 5, win_rate = '1.01' must be a number from 0 to 1 or empty"),
        ("defense_rate", "-0.1", "row 5, defense_rate = '-0.1' must be a number from 0 to 1 or empty"),
        ("mean_smash_speed", "inf", "row 5, mean_smash_speed = 'inf' must be a number of at least 0 or empty"),
        ("mean_smash_speed", "1e400", "row 5, mean_smash_speed = '1e400' must be"),
        ("mean_disagreement", "1,5", "mean_disagreement has decimal points and decimal commas, must have one of them"),
        ("mean_disagreement", "1.234,5", "row 5, mean_disagreement = '1.234,5' must be"),
        ("comfort", "0", "row 5, comfort = '0' must be a number from 1 to 7 or empty"),
        ("comfort", "8", "row 5, comfort = '8' must be"),
        ("comfort", "05. Mrz", "row 5, comfort = '05. Mrz' must be"),
        ("position", "1.5", "row 5, position = '1.5' must be a whole number of at least 1 or empty"),
        ("seed", "", "row 5, seed = empty must be a whole number"),
        ("seed", "9" * 30, "row 5, seed = '9{30}' must be a whole number"),
    ],
)
def test_a_cell_that_does_not_fit_is_named(tmp_path, column, value, message):
    with pytest.raises(ValueError, match="trials.csv: " + message.replace("(", r"\(").replace(")", r"\)")) as refused:
        gather([saved(tmp_path, changed(5, column, value))])
    assert "\n" not in str(refused.value)


TEXT = TRIALS.to_csv(index=False)
HEADER, FIRST = TEXT.splitlines()[:2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be a table, and is empty"),
        (TEXT.encode("utf-16")[:-1], "is not text in UTF-8"),
        ("user,condition\nMüller,nhg\n".encode("latin-1"), "row 2 is not text in UTF-8: save it as CSV UTF-8"),
        (b"PK\x03\x04\0\0", "must be a table, and is no text"),
        (TEXT.replace("win_rate", "comfort", 1), "row 1, column comfort must be there once"),
        (TEXT.replace("win_rate", "winrate", 1), "lacks the columns win_rate; did you mean winrate?"),
        (TEXT.replace("seed", "Seeds", 1), "lacks the columns seed; did you mean Seeds?"),
        (f"{HEADER}\n{FIRST}\n\nS09,nhg,1\n", "row 4 has 3 cells, must have 20, as the header"),
        (f"{HEADER}\n{FIRST},1\n{FIRST}\n", "row 2 has 21 cells, must have 20, as the header"),
        (TEXT[: TEXT.rindex(",")], "row 28 has 19 cells, must have 20"),
        (f'{HEADER}\n"S01,nhg', "is not a table: unexpected end of data"),
        (HEADER, "holds no games"),
    ],
)
def test_a_table_that_does_not_fit_is_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        gather([saved(tmp_path, text)])
    assert "trials.csv" in str(refused.value) and "\n" not in str(refused.value)


def test_rows_are_those_of_a_spreadsheet(tmp_path):
    """Empty rows, line breaks in cells and a column of row numbers do not shift them."""
    text = as_r(TRIALS.assign(comment="two\nlines"))
    lines = text.replace('"S01"', '"S01"', 1).split("\n")
    lines.insert(1, "")  # an empty row
    broken = "\n".join(lines).replace('"oahg_ut"', '"oagh_ut"', 1)
    with pytest.raises(ValueError, match="row 5, condition = 'oagh_ut'"):
        merge([saved(tmp_path, broken)])


def test_a_condition_of_the_manifest_is_known(tmp_path):
    mine = {"name": "mine", "letter": "q", "label": "My own"}
    (tmp_path / "manifest.json").write_text(f'{{"conditions": [{str(mine).replace(chr(39), chr(34))}]}}')
    trials = TRIALS.replace({"condition": {"nhg": "my own", "oahg": "Product"}})
    assert {"mine", "product"} < set(merge([saved(tmp_path, trials.to_csv(index=False))])["condition"])


def test_trials_without_the_columns_that_only_simulations_have(tmp_path):
    """Weights, positions and rounds; a metric without a value is a dash."""
    trials = TRIALS[["user", "condition", "seed", *METRICS]].assign(comfort=np.nan)
    group = gather([saved(tmp_path, trials.to_csv(index=False))])
    assert screen_table(Group(group.trials, {})).splitlines()[2].split()[-1] == "–"
