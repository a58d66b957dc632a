"""The list of runs: what each is known by, and that nothing but what failed is ever removed."""

import os
import shutil
import socket
import subprocess
import sys
import time

import pytest

from airhockey_marl.commands import runs
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.run_folder import files_at_risk, note_headline
from airhockey_marl.experiment.run_record import RECORD, RunRecord, listing, process_start, read_run, runs_below
from tests.processes import start

HERE = socket.gethostname()


def gone() -> dict:
    """The process of a run that was killed."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    birth = process_start(process.pid)
    process.kill()
    process.wait()
    return {"host": HERE, "pid": process.pid, "birth": birth}


@pytest.fixture
def outputs(tmp_path):
    """One run of each kind, as they are found."""
    alive = {"host": HERE, "pid": os.getpid(), "birth": process_start(os.getpid())}
    kinds = {
        "done": {"status": "done", "seconds": 90.0},
        "failed": {"status": "failed", "seconds": 1.0, "error": "seed = -1 must be"},
        "on": {"status": "running", **alive},
        "elsewhere": {"status": "running", "host": "another", "pid": 1, "birth": "x"},
        "killed": {"status": "running", **gone()},
        "killed_later": {"status": "running", **gone()},
        "reborn": {"status": "running", **alive, "birth": "an earlier process of the number"},
        "failed_above": {"status": "failed", "seconds": 1.0},
        "failed_above/within": {"status": "done", "seconds": 1.0},
    }
    for number, (name, facts) in enumerate(kinds.items()):
        folder = tmp_path / "outputs" / name
        folder.mkdir(parents=True)
        RunRecord(
            folder, "train", ["seed=1", "hydra.verbose=true"], started=time.time() - 100 + number, **facts
        ).write()
    (tmp_path / "outputs" / "killed_later" / "state.safetensors").touch()
    old = tmp_path / "outputs" / "old" / ".hydra"
    old.mkdir(parents=True)
    (old / "config.yaml").write_text("seed: 1\n")
    return tmp_path / "outputs"


STATES = {
    "done": "done",
    "failed": "failed",
    "on": "running",
    "elsewhere": "running",
    "killed": "interrupted",
    "killed_later": "interrupted",
    "reborn": "interrupted",
    "failed_above": "failed",
    "within": "done",
    "old": "unknown",
}


def call(monkeypatch, *arguments: str, answer: str = "y") -> None:
    monkeypatch.setattr(sys, "argv", ["runs", *arguments])
    monkeypatch.setattr("builtins.input", lambda question: answer)
    start_command(runs.__name__)


def test_every_run_is_listed_with_what_became_of_it(monkeypatch, capsys, outputs):
    assert {run.folder.name: run.state for run in runs_below(outputs)} == STATES
    note_headline(outputs / "done", "beats generation 0 0.95, striker 0.5")
    assert capsys.readouterr().out == "beats generation 0 0.95, striker 0.5\n"
    call(monkeypatch, f"outputs={outputs}")
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert len(lines) == 1 + len(STATES)  # and a heading
    assert "done     " in lines["done"] and "90 s" in lines["done"] and lines["done"].endswith("striker 0.5")
    assert "seed=1" in lines["done"] and "hydra.verbose" not in lines["done"]
    assert lines["failed"].endswith("seed = -1 must be")
    assert f"pid {os.getpid()} on {HERE}" in lines["on"]
    assert f"resume={outputs}/killed_later goes on" in lines["killed_later"] and "resume" not in lines["killed"]


def test_a_fresh_run_in_the_folder_of_another_is_refused_before_anything_is_written(outputs):
    """And of a sweep's job; and of the very run that is gone on with, whose settings would be lost."""

    def content(folder) -> dict:
        return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}

    run = outputs / "done"
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").write_text("seed: 1\n")
    (run / "card.json").write_text("{}")
    (outputs / "sweep").mkdir()
    shutil.copytree(run, outputs / "sweep" / "7")
    before = content(outputs)
    sweep = ["-m", f"hydra.sweep.dir={outputs}/sweep"]
    for holder, key, arguments in ((run, "run", [f"hydra.run.dir={run}"]), (outputs / "sweep" / "7", "sweep", sweep)):
        refused = start("airhockey_marl.train", "+preset=smoke", *reversed(arguments))
        said = f"hydra.{key}.dir: {holder} holds a run that has left card.json; a run must have a folder of its own"
        assert (refused.returncode, refused.stderr) == (2, f"error: {said}\n")
        assert content(outputs) == before
    itself = outputs / "killed_later"
    refused = start("airhockey_marl.train", f"resume={itself}", f"hydra.run.dir={itself}")
    assert refused.returncode == 2 and "holds a run that can be gone on with" in refused.stderr
    assert content(outputs) == before


def test_there_is_something_to_lose_of_a_run_that_is_on_or_can_be_resumed_or_has_left_files(outputs):
    lost = {name: files_at_risk(outputs / name) for name in STATES if name != "within"}
    assert {name for name, what in lost.items() if what} == {"on", "elsewhere", "killed_later"}
    assert lost["killed_later"] == f"a run that can be gone on with: resume={outputs}/killed_later"
    (outputs / "old" / "train.log").touch()
    assert files_at_risk(outputs / "old") is None
    (outputs / "old" / "card.json").touch()
    assert files_at_risk(outputs / "old") == "a run that has left card.json"


def test_what_all_runs_have_in_common_stands_above_them(tmp_path):
    """No column is the same for all."""
    for seed in range(3):
        overrides = ["+preset/train=smoke", f"seed={seed}", "hydra.verbose=true"]
        folder = tmp_path / str(seed)
        RunRecord(folder, "train", overrides, status="done", seconds=10.0 + seed, headline=f"beats {seed}").write()
    text = listing(runs_below(tmp_path), tmp_path)
    assert text.splitlines() == [
        "all 3: done +preset/train=smoke",
        "run  took  settings",
        "0    10 s  seed=0    beats 0",
        "1    11 s  seed=1    beats 1",
        "2    12 s  seed=2    beats 2",
    ]


def test_one_command_or_status_can_be_asked_for(monkeypatch, capsys, outputs):
    call(monkeypatch, f"outputs={outputs}", "status=unknown")
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["run", "old"]
    call(monkeypatch, f"outputs={outputs}", "command=evaluate")
    assert capsys.readouterr().out == f"no such runs in {outputs}\n"


def test_only_what_failed_is_removed_and_only_after_a_yes(monkeypatch, capsys, outputs, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    RunRecord(elsewhere, "train", status="failed").write()
    (outputs / "link").symlink_to(elsewhere)
    (outputs / "failed" / "link").symlink_to(elsewhere)
    before = {path.name for path in outputs.iterdir()}
    for answer in ("n", "", "yess"):
        call(monkeypatch, f"outputs={outputs}", "--clean", answer=answer)
        assert {path.name for path in outputs.iterdir()} == before
    capsys.readouterr()
    call(monkeypatch, f"outputs={outputs}", "--clean")
    assert capsys.readouterr().out.endswith("removed 3 of 3\n")
    assert before - {path.name for path in outputs.iterdir()} == {"failed", "killed", "reborn"}
    assert (elsewhere / RECORD).is_file() and (outputs / "failed_above" / "within" / RECORD).is_file()


def test_a_run_taken_up_again_while_one_was_asked_is_kept(outputs):
    lost = runs.removable([read_run(outputs / "killed"), read_run(outputs / "failed")])
    now = {"host": HERE, "pid": os.getpid(), "birth": process_start(os.getpid())}
    RunRecord(outputs / "killed", "train", status="running", **now).write()
    assert [run.folder.name for run in runs.remove(lost)] == ["failed"]
    assert (outputs / "killed").is_dir()


@pytest.mark.parametrize("text", ["{", "[]", '{"command": 1}', '{"command": "train", "status": "odd"}', "null"])
def test_a_record_that_is_none_makes_the_run_unknown(outputs, text):
    (outputs / "failed" / RECORD).write_text(text)
    run = read_run(outputs / "failed")
    assert run.state == "unknown" and runs.removable([run]) == []


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("outputs=nowhere", "outputs = nowhere must be a folder"),
        ("status=lost", "status = lost must be one of running, done, failed, interrupted, unknown"),
        ("clean=perhaps", "clean = perhaps must be true or false"),
    ],
)
def test_wrong_values_are_named(monkeypatch, capsys, outputs, argument, message):
    with pytest.raises(SystemExit) as stopped:
        call(monkeypatch, *([] if "outputs" in argument else [f"outputs={outputs}"]), argument)
    assert stopped.value.code == 2 and message in capsys.readouterr().err
