"""One process has a run folder; and a disk that is full costs nothing that was finished."""

import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from airhockey_marl.experiment.command import InputError
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
    hold = "import sys, time; from pathlib import Path; "
    hold += "from airhockey_marl.experiment.run_folder import lock_run_folder\n"
    hold += "with lock_run_folder(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(600)"
    holder = subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        refused = rf"run = {tmp_path} is in use by process {holder.pid}; one at a time can have it"
        with pytest.raises(InputError, match=refused), lock_run_folder(tmp_path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
    with lock_run_folder(tmp_path):
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"


def test_what_a_killed_process_left_half_written_is_removed_and_nothing_else(tmp_path):
    half, kept = tmp_path / "deep" / ".league.safetensors.ab12_z9x.safetensors", tmp_path / ".hidden.yaml"
    write_text(half, "half of the n")
    write_text(kept, "mine")
    with lock_run_folder(tmp_path):
        assert not half.exists() and kept.exists()


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run that has come to its second generation, of six."""
    run = tmp_path_factory.mktemp("run") / "run"
    done = start(*TRAIN, "generations=2", f"hydra.run.dir={run}")
    assert done.returncode == 0, done.stderr
    file = run / ".hydra" / "config.yaml"
    file.write_text(file.read_text().replace("generations: 2\n", "generations: 6\n"))
    return run


def copy_of(run: Path, to: Path) -> Path:
    subprocess.run(["cp", "-a", str(run), str(to)], check=True)
    return to


@pytest.fixture(scope="module")
def whole(trained, tmp_path_factory) -> Path:
    """The same, gone on with to its end."""
    run = copy_of(trained, tmp_path_factory.mktemp("whole") / "run")
    assert start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={run}-log").returncode == 0
    return run


def state_of(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in ("league.safetensors", "matches.csv", "state.safetensors")}


def test_a_training_that_is_gone_on_with_twice_is_refused_while_it_runs(trained, tmp_path):
    run = copy_of(trained, tmp_path / "run")
    before = state_of(run)
    with lock_run_folder(run):
        done = start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log")
    assert done.returncode == 2
    one_line(done, f"run = {run} is in use by process {os.getpid()}; one at a time can have it")
    assert state_of(run) == before


def small_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


def test_a_file_that_becomes_too_large_stops_a_training_whose_state_stays(trained, whole, tmp_path):
    run = copy_of(trained, tmp_path / "run")
    before = state_of(run)
    file = run / ".hydra" / "config.yaml"
    for every, name in ((1, "tensorboard"), (0, "league.safetensors")):  # a film is larger than a league
        file.write_text(re.sub("pictures_every: .", f"pictures_every: {every}", file.read_text()))
        done = start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log", before=small_files)
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
        done = start("airhockey_marl.train", f"resume={run}", f"hydra.run.dir={tmp_path}/log")
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
