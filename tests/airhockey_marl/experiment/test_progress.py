"""Progress in a log: a line a minute and nothing else, on a clock that the test moves."""

import pytest

from airhockey_marl.experiment.progress import ProgressBar


@pytest.fixture
def wait(monkeypatch):
    """A function that lets time pass."""
    now = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_a_log_gets_a_line_a_minute(wait, capsys):
    progress = ProgressBar()
    for percent in range(101):
        progress("games", percent / 100)
        wait(3.0)
    progress.close()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "games: 20 of 100 %, 01:00, 04:00 left" and len(lines) == 5


def test_short_work_leaves_no_line(wait, capsys):
    progress = ProgressBar()
    for phase in ("one", "two"):
        for percent in range(101):
            progress(phase, percent / 100)
            wait(0.1)
    progress.close()
    assert capsys.readouterr().err == ""
