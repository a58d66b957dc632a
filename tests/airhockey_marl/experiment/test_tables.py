"""Tables that commands read: checked cell by cell, without a warning, and ours to the bit."""

import warnings

import numpy as np
import pandas as pd
import pytest

from airhockey_marl.experiment.validation.tables import Column, read_table

NUMBERS = {"t": Column(), "force": Column(missing=True)}


def ticks(n: int = 300_000) -> str:
    """A recorded game, longer than what pandas reads at once."""
    table = pd.DataFrame({"t": 0.02 * np.arange(n), "force": np.random.default_rng(0).normal(size=n)})
    return table.assign(force=table["force"].where(table["t"] > 1)).to_csv(sep="\t", index=False, na_rep="n/a")


TICKS = ticks()


def test_recorded_ticks_are_read_to_the_bit(tmp_path):
    (tmp_path / "beh.tsv").write_text(TICKS)
    table = read_table(tmp_path / "beh.tsv", NUMBERS, float_precision="round_trip")
    assert table.to_csv(sep="\t", index=False, na_rep="n/a") == TICKS


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TICKS.replace("\n2.0\t", "\ntwo\t"), "beh.tsv: row 102, t = 'two' must be a number"),
        (TICKS.replace("\t-0.", "\t-inf", 1), "force = '-inf.*' must be a number or empty"),
        (TICKS.replace("\n2.0\t", "\nn/a\t"), "beh.tsv: row 102, t = 'n/a' must be a number"),
        (TICKS[: TICKS.rindex("\t")], "beh.tsv: row 300001 has 1 cells, must have 2, as the header"),
        (TICKS.replace("force", "t", 1), "beh.tsv: row 1, column t must be there once"),
        (TICKS.replace("force", "forces", 1), "beh.tsv lacks the columns force; did you mean forces?"),
    ],
)
def test_what_is_no_tick_is_named(tmp_path, text, message):
    (tmp_path / "beh.tsv").write_text(text)
    with warnings.catch_warnings(), pytest.raises(ValueError, match=message):
        warnings.simplefilter("error", pd.errors.DtypeWarning)
        read_table(tmp_path / "beh.tsv", NUMBERS)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no such file: .*nowhere\.csv"):
        read_table(tmp_path / "nowhere.csv", NUMBERS)
