"""One process has a run folder; and a disk that is full costs nothing that was finished."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import InputError
from airhockey_marl.experiment.command import run as run_command
from airhockey_marl.experiment.files import WriteError, load_tensors, save_tensors, write_text
from airhockey_marl.experiment.run_folder import lock_run_folder
from tests import ROOT
from tests.airhockey_marl.commands.test_cli import scalars
from tests.processes import start

TRAIN = ["airhockey_marl.train", "+preset=smoke", "steps_per_generation=500", "pictures_every=0"]


def one_line(done: subprocess.CompletedProcess, *parts: str) -> None:
    said = done.stderr
    assert said.startswith("error: ") and said.count("\n") == 1 and all(part in said for part in parts), said


def test_a_folder_that_is_in_use_is_refused_and_given_free_with_its_process(tmp_path):
    hold = "import sys, time; from airhockey_marl.experiment.run_folder import lock_run_folder\n"
    hold += "with lock_run_folder({'out': sys.argv[1]}):\n    print('held', flush=True)\n    time.sleep(600)"
    holder = subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        refused = rf"run = {tmp_path} is in use by process {holder.pid}; one at a time can have it"
        with pytest.raises(InputError, match=refused), lock_run_folder({"out": tmp_path}):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
    with lock_run_folder({"out": tmp_path}):
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"


def test_what_a_killed_process_left_half_written_is_removed_and_nothing_else(tmp_path):
    half, kept = tmp_path / "deep" / ".league.safetensors.ab12_z9x.safetensors", tmp_path / ".hidden.yaml"
    write_text(half, "half of the n")
    write_text(kept, "mine")
    with lock_run_folder({"out": tmp_path}):
        assert not half.exists() and kept.exists()


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run of two generations."""
    run = tmp_path_factory.mktemp("run") / "run"
    done = start(*TRAIN, "generations=2", f"hydra.run.dir={run}")
    assert done.returncode == 0, done.stderr
    return run


def copy_of(run: Path, to: Path) -> Path:
    subprocess.run(["cp", "-a", str(run), str(to)], check=True)
    return to


@pytest.fixture(scope="module")
def whole(trained, tmp_path_factory) -> Path:
    """The same, gone on with to six."""
    run = copy_of(trained, tmp_path_factory.mktemp("whole") / "run")
    done = start("airhockey_marl.train", f"resume={run}", "generations=6", f"hydra.run.dir={run}-log")
    assert done.returncode == 0, done.stderr
    return run


def state_of(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in ("league.safetensors", "matches.csv", "state.safetensors")}


def test_a_training_that_is_gone_on_with_twice_is_refused_while_it_runs(trained, tmp_path):
    run = copy_of(trained, tmp_path / "run")
    before = state_of(run)
    with lock_run_folder({"out": run}):
        done = start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log")
    assert done.returncode == 2
    one_line(done, f"run = {run} is in use by process {os.getpid()}; one at a time can have it")
    assert state_of(run) == before


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("seed=8", "seed = 8 must be 0"),
        ("algorithm.max_kl=0.5", "algorithm.max_kl = 0.5 must be 0.02"),
        ("algorithm=ppo", "algorithm.name = ppo must be trpo"),
        ("generations=1", "generations = 1 must be 2"),
        ("steps_per_generation=1000", "steps_per_generation = 1000 must be 500"),
        ("+preset=smoke", "steps_per_generation = 1000 must be 500"),
        ("hidden=[8]", "hidden = [8] must be [64, 64]"),
        ("league.scripted_players=[idle]", "league.scripted_players = ['idle'] must be ['striker']"),
    ],
)
def test_another_value_of_what_a_run_is_is_refused_when_it_is_resumed(trained, tmp_path, capsys, argument, message):
    kept = {name: (trained / name).read_bytes() for name in ("run.json", "card.json", ".hydra/config.yaml")}
    with pytest.raises(SystemExit) as stopped:
        run_command("airhockey_marl.commands.train", [f"resume={trained}", argument, f"hydra.run.dir={tmp_path}/log"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err == f"error: {message}, as in the run that is resumed\n"
    assert kept == {name: (trained / name).read_bytes() for name in kept}


def test_what_may_change_holds_from_then_on_and_the_commands_add_up(trained, tmp_path):
    run = copy_of(trained, tmp_path / "run")
    changes = "pictures_every=2", "generations=3", "threads=2", "seed=0", "algorithm=trpo"
    for others in (changes, ("generations=4",)):
        done = start("airhockey_marl.train", f"resume={run}", *others, f"hydra.run.dir={tmp_path}/log{len(others)}")
        assert done.returncode == 0, done.stderr
    card, record = (json.loads((run / name).read_text()) for name in ("card.json", "run.json"))
    assert card["command"] == json.loads((trained / "card.json").read_text())["command"] == record["commands"][0]
    assert card["resumed_by"] == record["commands"][1:] and "resume=" in record["commands"][1]
    assert (record["status"], record["command"]) == ("done", "train") and "generations=4" in record["overrides"]
    config = OmegaConf.load(run / ".hydra" / "config.yaml")
    assert (config.generations, config.threads, config.pictures_every, config.resume) == (4, 2, 2, None)
    assert card["config"]["generations"] == 4 and card["config"]["pictures_every"] == 2
    assert len(load_tensors(run / "league.safetensors")[0]["head.bias"]) == 5  # and the untrained one


def small_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


def test_a_file_that_becomes_too_large_stops_a_training_whose_state_stays(trained, whole, tmp_path):
    run = copy_of(trained, tmp_path / "run")
    before = state_of(run)
    for every, name in ((1, "tensorboard"), (0, "league.safetensors")):  # a film is larger than a league
        more = f"resume={run}", "generations=6", f"pictures_every={every}", f"hydra.run.dir={tmp_path}/log"
        done = start("airhockey_marl.train", *more, before=small_files)
        assert done.returncode == 1
        one_line(done, f"{run}/{name} cannot be written: ", "What was saved before is as it was")
        assert state_of(run) == before and not list(run.glob(".*.safetensors"))
    assert start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log").returncode == 0
    assert load_tensors(run / "league.safetensors")[0].keys() == load_tensors(whole / "league.safetensors")[0].keys()
    assert state_of(run)["league.safetensors"] == state_of(whole)["league.safetensors"]
    assert scalars(run) == scalars(whole)


def mounted(folder: Path, size: str) -> bool:
    folder.mkdir()
    asked = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    return subprocess.run(asked, capture_output=True, check=False).returncode == 0


@pytest.mark.slow
def test_a_disk_that_is_full_stops_a_training_whose_state_stays(trained, whole, tmp_path):
    disk = tmp_path / "disk"
    if not mounted(disk, "600k"):
        pytest.skip("mounting is not allowed here")
    try:
        run = copy_of(trained, disk / "run")
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        (disk / "others").write_bytes(b"x" * (free - 40_000))
        before = state_of(run)
        done = start("airhockey_marl.train", f"resume={run}", "generations=6", f"hydra.run.dir={tmp_path}/log")
        assert done.returncode == 1
        one_line(done, "No space left on device")
        assert load_tensors(run / "state.safetensors") and state_of(run).keys() == before.keys()
        assert not list(run.glob(".*.safetensors"))
        (disk / "others").unlink()
        assert start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log").returncode == 0
        assert state_of(run)["league.safetensors"] == state_of(whole)["league.safetensors"]
        assert scalars(run) == scalars(whole)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_folder_that_may_not_be_written_to_is_named(tmp_path):
    disk = tmp_path / "disk"
    if not mounted(disk, "100k"):
        pytest.skip("mounting is not allowed here")
    try:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        done = start(*TRAIN, f"hydra.run.dir={disk}/run")
        assert done.returncode in (1, 2)
        one_line(done, "Read-only file system")
        with pytest.raises(WriteError, match=rf"{disk}/x cannot be written: Read-only file system"):
            write_text(disk / "x", "x")
        with pytest.raises(WriteError, match=rf"{disk}/x cannot be written: "):
            save_tensors(disk / "x", {})
    finally:
        subprocess.run(["umount", str(disk)], check=True)
