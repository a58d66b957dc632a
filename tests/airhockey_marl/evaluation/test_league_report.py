"""The report of a tiny league: its files, its sentences for any outcome, and invalid input."""

import base64
import html
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from airhockey_marl.commands import league_report
from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.evaluation.figures import best_response_figure, payoff_figure
from airhockey_marl.evaluation.league_metrics import (
    EvaluationConfig,
    LeagueMetrics,
    Regressions,
    benchmark_generations,
    evaluate_league,
    payoff_players,
)
from airhockey_marl.evaluation.league_report import draw_figures, page, summary, write_report
from airhockey_marl.evaluation.matches import MatchResult
from airhockey_marl.evaluation.ratings import MATCH_COLUMNS, GoodnessOfFit, Proportion, RatingDifference
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.files import save_tensors, write_json
from airhockey_marl.league.league import League
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
from tests.airhockey_marl.league.test_league import league_of
from tests.pictures import faults

SIZES = {"every": 5, "rounds": 2, "match_rounds": 4, "save_tables": 3, "std_tables": 4, "std_seconds": 8.0}
CONFIG = EvaluationConfig(**SIZES, seed=1, frame_skip=2)
CARD = {"steps": 3000, "seed": 4, "note": "<script>alert(1)</script>", "config": {"env": {"tables": 4}}}
FILES = ["league_report.html", "league_report.json", "match.gif", "payoff.csv", "payoff.png", "precision.png"]
FILES += ["rating.png", "ratings.csv"]
BEST_RESPONSE = [(1_000_000, MatchResult(30, 70, 2)), (2_000_000, MatchResult(80, 20, 0))]
SECTIONS = ["Summary", "Ratings", "Payoff matrix", "Win rates during training", "Saves", "STD by situation"]
SECTIONS += ["Smoothness", "Exploitability", "Example match", "Methods and model card"]


def matches() -> pd.DataFrame:
    rows = [(1, 0, 3, 1, 0), (1, "random", 4, 0, 0), (1, "striker", 0, 4, 0), (2, 0, 2, 1, 1), (2, "random", 0, 0, 4)]
    return pd.DataFrame(rows, columns=list(MATCH_COLUMNS))


def text_of(written: str) -> str:
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<style>.*?</style>|<[^>]+>", " ", written, flags=re.DOTALL)))


@pytest.fixture(scope="module")
def league() -> League:
    return league_of(3)


@pytest.fixture(scope="module")
def written(league, tmp_path_factory) -> tuple[Path, LeagueMetrics]:
    """The folder of a report without matches, and its metrics."""
    folder = tmp_path_factory.mktemp("report")
    metrics = evaluate_league(league, None, CONFIG)
    write_report(folder, league, None, CARD, CONFIG, metrics)
    return folder, metrics


def shown(metrics: LeagueMetrics) -> str:
    """The text of the page."""
    names = ("payoff.png", "rating.png", "precision.png", "matches.png", "best_response.png", "match.gif")
    return text_of(page(metrics, dict.fromkeys(names, b"a picture"), {}, CONFIG))


def test_report_writes_all_files(written):
    folder, metrics = written
    assert sorted(path.name for path in folder.iterdir()) == FILES
    for name in ("payoff", "rating", "precision"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    payoff, ratings = pd.read_csv(folder / "payoff.csv"), pd.read_csv(folder / "ratings.csv")
    k = 3 + len(SCRIPTED_PLAYERS)
    assert len(payoff) == k * (k - 1) and (payoff[["won", "lost", "undecided"]].sum(axis=1) == 2).all()
    assert list(ratings["member"]) == ["0", "1", "2", *SCRIPTED_PLAYERS] and set(ratings["source"]) == {"payoff"}
    assert (ratings["low"] <= ratings["rating"]).all() and (ratings["rating"] <= ratings["high"]).all()
    facts = json.loads((folder / "league_report.json").read_text(), parse_constant=pytest.fail)
    assert facts["config"] == SIZES | {"seed": 1, "frame_skip": 2} and facts["player_ids"] == [
        0,
        1,
        2,
        *SCRIPTED_PLAYERS,
    ]
    assert facts["win_rates"]["0"]["trials"] == metrics.win_rates[0].trials


def test_film_has_ten_seconds(written):
    with Image.open(written[0] / "match.gif") as film:
        assert film.n_frames > 100  # pictures that do not change share a longer one
        assert film.width == 320 and film.info["loop"] == 0
        lasts = 0
        for frame in range(film.n_frames):
            film.seek(frame)
            lasts += film.info["duration"]
    assert lasts == 10_000


def test_page_has_all_sections_and_loads_nothing(written):
    folder, _ = written
    written_page = (folder / "league_report.html").read_text(encoding="utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", written_page) == SECTIONS
    assert not re.search(r"<(script|link|iframe|object)\b|@import|url\(", written_page)
    sources = re.findall(r'(?:src|href)="([^"]*)"', written_page)
    inlined = {base64.b64decode(source.partition("base64,")[2]) for source in sources}
    assert inlined == {(folder / name).read_bytes() for name in FILES if name.endswith(("png", "gif"))}
    assert "&lt;script&gt;alert(1)" in written_page


def test_page_prints_no_nan(written, league):
    folder, metrics = written
    none = float("nan")
    numbers = metrics.std.columns.drop(["situation", "decisions", "share"])
    empty = replace(
        metrics,
        score=np.where(np.arange(3) == 2, metrics.score.sum(axis=-1, keepdims=True), 0),
        goodness_of_fit=GoodnessOfFit(none, none),
        win_rates={0: Proportion.from_counts(0, 0), metrics.strongest_script: Proportion.from_counts(0, 0)},
        saves={name: Proportion.from_counts(0, 0) for name in metrics.saves},
        std=metrics.std.assign(**dict.fromkeys(numbers, none)),
        std_maps=tuple(np.full_like(values, none) for values in metrics.std_maps),
        smoothness={name: dict.fromkeys(values, none) for name, values in metrics.smoothness.items()},
    )
    for text in (text_of((folder / "league_report.html").read_text()), shown(empty)):
        assert not re.search(r"\b([Nn]a[Nn]|None|inf|Undefined)\b|\[\s*,|\{\{|  ", text)
    assert "The scripted striker made no shot on either goal, so the save rates cannot be compared." in shown(empty)
    assert "There are too few decisions before a save" in shown(empty) and "too small to test" in shown(empty)
    assert all(picture.startswith(b"\x89PNG") for picture in draw_figures(empty, None).values())
    json.dumps(empty.as_dict(), allow_nan=False)


def test_report_is_reproducible(written, league, tmp_path):
    folder, _ = written
    write_report(tmp_path, league, None, CARD, CONFIG, evaluate_league(league, None, CONFIG))
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


def test_a_single_best_response_has_an_interval():
    figure = best_response_figure([(2000, Proportion.from_counts(3, 9))])
    assert not faults(figure)
    (bar,) = figure.axes[0].containers[0].lines[2][0].get_segments()
    assert bar[:, 1] == pytest.approx(Proportion.from_counts(3, 9)[1:3])


def test_matches_and_best_response_are_shown(written, league):
    folder, metrics = written
    with_more = evaluate_league(league, matches(), CONFIG, BEST_RESPONSE)
    assert (with_more.score == metrics.score).all() and with_more.win_rates == metrics.win_rates
    assert list(with_more.training_ratings["member"]) == [0, 1, 2, "random", "striker"]
    assert set(with_more.ratings_table()["source"]) == {"payoff", "matches"}
    text = shown(with_more)
    expected = {"matches.png", "best_response.png", *(file for file in FILES if "png" in file)}
    assert set(draw_figures(with_more, matches())) == expected
    assert "when it was the newest, against" in text and "has no matches.csv" not in text
    assert "trained for 2,000,000 steps" in text and "wins 80 % [71, 87] of the decided rounds" in text
    without = text_of((folder / "league_report.html").read_text())
    assert "has no matches.csv with the matches of its training" in without and "is not known" in without


def test_heat_map_has_numbers_in_its_cells_while_they_are_few():
    score = np.zeros((3, 3, 3), dtype=int)
    score[0, 1], score[1, 0], score[0, 2], score[2, 0] = (996, 4, 0), (4, 996, 0), (20, 20, 9), (20, 20, 9)
    axes = payoff_figure([0, 1, "random"], score).axes[0]
    assert [text.get_text() for text in axes.texts] == ["1", ".50", ".00", ".50"]  # nothing where nobody met
    many = np.ones((101, 101, 3), dtype=int)
    axes = payoff_figure([*range(100), "random"], many).axes[0]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert not axes.texts and labels[0] == "0" and labels[-2:] == ["99", "random"] and len(labels) < 30


def of(value: float, half: float) -> RatingDifference:
    return RatingDifference(value, value - half, value + half)


@pytest.mark.parametrize(
    ("changes", "says", "line"),
    [
        (
            {"gain_since_midpoint": of(90, 10), "midpoint": 1},
            "The rating rose since generation 1, the middle of the training: the last generation is rated 90 [80, 100]",
            None,
        ),
        (
            {"gain_since_midpoint": of(-90, 10), "midpoint": 1},
            "The rating fell since generation 1, the middle of the training: the last generation is rated 90 [80, 100]",
            None,
        ),
        (
            {"gain_since_midpoint": of(5, 10), "midpoint": 1},
            "The rating did not change significantly since generation 1, the middle of the training: the last "
            "generation is rated 5 [−5, 15]",
            None,
        ),
        ({"lead_over_script": of(70, 9)}, "70 points above the strongest script", None),
        ({"lead_over_script": of(-70, 9)}, "70 points below the strongest script", None),
        ({"goodness_of_fit": GoodnessOfFit(1.1, 0.3)}, "yes, the deviations are compatible with chance", None),
        ({"goodness_of_fit": GoodnessOfFit(4.0, 1e-9)}, "(p < .001): no, strength is not fully transitive", None),
        ({"regressions": Regressions({}, 0)}, "The league has no generation after 20 to compare", None),
        ({"regressions": Regressions({}, 7)}, "none of 7 generations after 20 is rated below generation 10.", "yes"),
        (
            {"regressions": Regressions({30: of(-5, 9)}, 7)},
            "1 of 7 generations after 20 is rated below generation 10 (30), none of them by more than the 95 %",
            "open",
        ),
        (
            {"regressions": Regressions({30: of(-5, 9), 40: of(-50, 9)}, 7)},
            "2 of 7 generations after 20 are rated below generation 10 (30 and 40), 1 of them by more than the 95 % "
            "interval of the difference (40).",
            "no",
        ),
        (
            {"saves": {"last": Proportion.from_counts(90, 100), "defender": Proportion.from_counts(60, 100)}},
            "the last generation defends better",
            "yes",
        ),
        (
            {"saves": {"last": Proportion.from_counts(50, 100), "defender": Proportion.from_counts(80, 100)}},
            "the script defends better",
            "no",
        ),
        (
            {"saves": {"last": Proportion.from_counts(50, 100), "defender": Proportion.from_counts(52, 100)}},
            "the difference is not significant.",
            "open",
        ),
        ({"best_response": [(9, Proportion.from_counts(80, 100))]}, "the last generation can be exploited.", None),
        ({"best_response": [(9, Proportion.from_counts(20, 100))]}, "no weakness was found.", None),
        ({"best_response": [(9, Proportion.from_counts(50, 100))]}, "about as strong as the last generation.", None),
    ],
)
def test_sentences_follow_from_the_numbers(written, changes, says, line):
    metrics = replace(written[1], **changes)
    assert says in shown(metrics)
    if line:
        topic = "after 20" if "regressions" in changes else "saves more"
        assert [row.outcome for row in summary(metrics) if topic in row.claim] == [line]


@pytest.mark.parametrize(
    ("above", "says", "holds"),
    [(-0.05, "lower", "yes"), (0.05, "higher", "no"), (0.0, "not significantly different", "open")],
)
def test_sentences_about_the_std_follow_from_the_numbers(written, above, says, holds):
    ends = {"difference_low": above - 0.01, "difference_high": above + 0.01}
    metrics = replace(written[1], std=written[1].std.assign(std=0.2, difference=above, **ends))
    text = shown(metrics)
    for situation in ("Before a save", "Before a strike"):
        expected = f"{situation} the STD is {says} than with the puck far away: STD 0.200 against {0.2 - above:.3f}"
        assert expected in text
    assert [line.outcome for line in summary(metrics) if "STD is lower" in line.claim] == [holds] * 2


def test_benchmark_generations_fit_the_league():
    assert benchmark_generations(100) == benchmark_generations(51) == [0, 25, 50]
    assert benchmark_generations(50) == [0, 12, 25, 37] and benchmark_generations(1) == [0]
    assert payoff_players(101, 10) == [0, 10, 20, 25, 30, 40, 50, 60, 70, 80, 90, 100, *SCRIPTED_PLAYERS]
    assert payoff_players(30, 20) == [0, 7, 10, 14, 20, 21, 29, *SCRIPTED_PLAYERS]
    assert payoff_players(3, 5) == [0, 1, 2, *SCRIPTED_PLAYERS]


TINY = ["rounds=1", "match_rounds=1", "save_tables=1", "std_tables=2", "std_seconds=2", "exploit_generations=0"]


def ship(folder: Path, league: League, **card) -> Path:
    save_tensors(folder / "league.safetensors", league.stacked_weights(), {"hidden": [8]})
    write_json(folder / "card.json", {"hashes": league.hashes, "steps": 2000, **card})
    return folder


def test_the_command_reports_a_run(monkeypatch, capsys, league, tmp_path):
    """Of a league behind a hand: all its players are behind one in the report, too."""
    config = {"env": {"frame_skip": 2, "arm": {"mass": 2.0}}}
    run, out = ship(tmp_path / "run", league, config=config), tmp_path / "out"
    matches().to_csv(run / "matches.csv", index=False)
    monkeypatch.setattr(sys, "argv", ["league_report", f"run={run}", f"hydra.run.dir={out}", *TINY])
    start_command(league_report.__name__)
    assert {*FILES, "matches.png"} <= {path.name for path in out.iterdir()}
    assert list(out.glob("tensorboard/events*"))
    shown = capsys.readouterr().out
    assert "The last generation (2) beats generation 0: wins" in shown and f"report: {out}" in shown
    assert (out / "league_report.html").read_text().count(league.hashes[-1]) == 1
    reported = json.loads((out / "league_report.json").read_text())["config"]
    assert reported["arm"] == HandArm(mass=2.0)._asdict() and reported["frame_skip"] == 2


def complaint(monkeypatch, capsys, tmp_path, *arguments: str) -> str:
    """What the command says when it refuses: one line, no traceback, and nothing is written."""
    monkeypatch.setattr(sys, "argv", ["league_report", f"hydra.run.dir={tmp_path}/refused", *arguments])
    with pytest.raises(SystemExit) as stopped:
        start_command(league_report.__name__)
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and said.startswith("error: ") and len(said) < 300
    assert not list((tmp_path / "refused").rglob("*.html"))
    return said


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("run=nowhere", "no such file: nowhere/league.safetensors"),
        ("rounds=0", "rounds = 0 must be a whole number of at least 1"),
        ("every=2.5", "every = 2.5 must be a whole number"),
        ("std_seconds=-1", "std_seconds = -1 must be a finite number above 0"),
        ("seed=-1", "seed = -1"),
        ("generation=3", "generation"),
    ],
)
def test_wrong_values_end_in_one_line(monkeypatch, capsys, tmp_path, argument, message):
    assert message in complaint(monkeypatch, capsys, tmp_path, argument)


def test_invalid_runs_are_named(monkeypatch, capsys, tmp_path, league):
    lone = ship(tmp_path / "lone", league_of(1))
    assert "at least 2" in complaint(monkeypatch, capsys, tmp_path, f"run={lone}")
    other = ship(tmp_path / "other", league, hashes=["0"])
    assert "card of another league" in complaint(monkeypatch, capsys, tmp_path, f"run={other}")
    (other / "card.json").write_text("{")
    assert "card.json is not JSON" in complaint(monkeypatch, capsys, tmp_path, f"run={other}")
    run = ship(tmp_path / "run", league)
    matches().assign(generation=9).to_csv(run / "matches.csv", index=False)
    assert "generation = 9 must be below 3" in complaint(monkeypatch, capsys, tmp_path, f"run={run}")
    matches().replace({"opponent": {"random": "wall"}}).to_csv(run / "matches.csv", index=False)
    assert "scripted player = 'wall' must be one of" in complaint(monkeypatch, capsys, tmp_path, f"run={run}")
    (run / "matches.csv").write_text("a,b\n1,2\n")
    assert "lacks the columns generation, opponent, won" in complaint(monkeypatch, capsys, tmp_path, f"run={run}")
    save_tensors(run / "league.safetensors", league.stacked_weights(), {})
    with pytest.raises(ValueError, match="not a file of this project"):
        League.load(run / "league.safetensors")
    save_tensors(run / "league.safetensors", league.stacked_weights(), {"hidden": [9]})
    with pytest.raises(ValueError, match=r"league\.safetensors: .* the model has"):
        League.load(run / "league.safetensors")
