"""A sweep as a table: what was varied is found, seeds are averaged, and the best comes first."""

import json
import sys

import pandas as pd
import pytest

from airhockey_marl.commands import sweep_table as grid
from airhockey_marl.experiment.command import run as start_command


def card(hidden: list[int], seed: int, error: float) -> dict:
    config = {"hidden": hidden, "seed": seed, "maml": {"lr": 0.001}, "resume": f"run {seed}"}
    return {"model": "made up", "seconds": 10.0 * seed, "on_others": {"error": error, "name": "x"}, "config": config}


@pytest.fixture
def sweep(tmp_path):
    for number, (hidden, seed, error) in enumerate(
        [([8], 0, 0.3), ([8], 1, 0.5), ([16, 16], 0, 0.1), ([16, 16], 1, 0.2)]
    ):
        folder = tmp_path / "sweep" / str(number)
        folder.mkdir(parents=True)
        (folder / "card.json").write_text(json.dumps(card(hidden, seed, error)))
    return tmp_path / "sweep"


def run(monkeypatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["grid", *arguments])
    start_command(grid.__name__)


def test_what_was_varied_stands_beside_what_came_of_it(sweep):
    rows, varied, scores = grid.tabulate(grid.read_cards([sweep]))
    assert varied == ["hidden", "seed"] and scores == ["error", "seconds"]
    assert rows["hidden"].tolist() == ["[8]", "[8]", "[16,16]", "[16,16]"]
    means = grid.over_seeds(rows, varied, scores, "error")
    assert means["hidden"].tolist() == ["[16,16]", "[8]"] and means["runs"].tolist() == [2, 2]
    assert means["error"].tolist() == pytest.approx([0.15, 0.4])
    only_seeds = grid.over_seeds(rows[:2], ["seed"], scores, "error")
    assert only_seeds["error"].tolist() == [0.3, 0.5]


def test_the_command_writes_every_run(sweep, monkeypatch, tmp_path, capsys):
    run(monkeypatch, f"runs={sweep}", "by=error", f"hydra.run.dir={tmp_path}/run")
    assert len(pd.read_csv(tmp_path / "run" / "sweep_table.csv")) == 4
    printed = capsys.readouterr().out
    assert printed.index("[16,16]") < printed.index("[8]")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs=nowhere"], "runs = nowhere: there is no card.json"),
        (["by=joy"], "by = joy must be one of error, seconds"),
    ],
)
def test_wrong_values_are_named(arguments, message, sweep, monkeypatch, tmp_path, capsys):
    places = [] if "runs" in arguments[0] else [f"runs={sweep}"]
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *places, *arguments, f"hydra.run.dir={tmp_path}/run")
    assert stop.value.code == 2 and message in capsys.readouterr().err


def test_cards_that_are_none_are_refused(sweep):
    (sweep / "0" / "card.json").write_text("{")
    with pytest.raises(ValueError, match=r"0/card\.json is not JSON"):
        grid.read_cards([sweep])
    (sweep / "0" / "card.json").write_text('{"model": 1}')
    with pytest.raises(ValueError, match="it has no config"):
        grid.read_cards([sweep])
    with pytest.raises(ValueError, match="no scores"):
        grid.tabulate({sweep: {"config": {}, "seconds": 1.0}})
