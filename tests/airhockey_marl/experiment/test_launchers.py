"""Sweeps on many processes: whoever runs the jobs, they come out alike, apart, and whole where others fail."""

import json
from importlib.util import find_spec
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from airhockey_marl.experiment import command as cli
from airhockey_marl.experiment.run_record import runs_below
from guidance.statistics.groups import gather
from tests.processes import start

SEEDS = "seed=1,-1"  # the second is refused
SWEEP = ["guidance.evaluate", "-m", "+preset=smoke", "condition=nhg,oahg"]


@pytest.fixture(scope="module")
def one_after_another(tmp_path_factory) -> dict[str, str]:
    """What the jobs give in this order without any launcher."""
    folder = tmp_path_factory.mktemp("basic")
    jobs = sweep(folder, SEEDS)
    assert jobs.returncode == 2
    return trials_of(folder)


def sweep(folder: Path, *more: str, **environment: str) -> CompletedProcess:
    return start(*SWEEP, *more, f"hydra.sweep.dir={folder}", env=environment)


def trials_of(folder: Path) -> dict[str, str]:
    """The trials of each job that has any, by its folder's name."""
    return {file.parent.name: file.read_text() for file in folder.glob("*/trials.csv")}


def check_sweep(folder: Path, done: CompletedProcess, expected: dict[str, str]) -> None:
    """All jobs had folders of their own; those with a right seed are whole and alike, the others are said to fail."""
    assert done.returncode == 2, done.stderr
    assert "\nerror: a job failed: seed = -1 must be a whole number of at least 0;" in "\n" + done.stderr
    assert "Traceback" not in done.stderr
    assert trials_of(folder) == expected and set(expected) == {"0", "2"}
    states = {run.folder.name: run.state for run in runs_below(folder)}
    assert states == {str(job): "failed" if job % 2 else "done" for job in range(4)}
    for job in (1, 3):
        assert "seed = -1" in json.loads((folder / str(job) / "run.json").read_text())["error"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("launcher", "needs", "processes"),
    [(["cores", "hydra.launcher.n_jobs=2"], "joblib", 2), (["slurm_here"], "submitit", 4)],
)
def test_a_launcher_runs_them_in_processes_of_their_own(one_after_another, tmp_path, launcher, needs, processes):
    pytest.importorskip(needs)
    done = sweep(tmp_path, SEEDS, f"hydra/launcher={launcher[0]}", *launcher[1:])
    check_sweep(tmp_path, done, one_after_another)
    pids = {json.loads((tmp_path / str(job) / "run.json").read_text())["pid"] for job in range(4)}
    assert len(pids) == processes


@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")  # before the fixture is made
def test_a_ray_cluster_runs_them(one_after_another, tmp_path, monkeypatch):
    import ray

    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # or Ray writes a token into the home folder
    address = ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False).address_info["gcs_address"]
    try:
        done = sweep(tmp_path, SEEDS, "hydra/launcher=ray", f"hydra.launcher.init.address={address}")
    finally:
        ray.shutdown()
    check_sweep(tmp_path, done, one_after_another)


@pytest.mark.slow
def test_what_a_sweep_left_is_merged_where_it_is_of_one_study(tmp_path):
    done = sweep(tmp_path / "s", "users=default,novice", "seed=range(1,3)", "hydra/launcher=cores")
    assert done.returncode == 0, done.stderr
    refused = start("guidance", "report", f"runs={tmp_path}/s", f"hydra.run.dir={tmp_path}/r")
    assert refused.returncode == 2 and "are of different studies and cannot be merged" in refused.stderr
    assert gather([tmp_path / "s" / job for job in ("0", "1", "4", "5")]).size == 8  # default, seeds 1 and 2
    merged = start("guidance", "report", f"runs={tmp_path}/s", "mixed=true", f"hydra.run.dir={tmp_path}/r")
    assert merged.returncode == 0, merged.stderr
    assert gather([tmp_path / "s"], mixed=True).size == 16


@pytest.mark.parametrize(
    ("argument", "extra"),
    [
        ("hydra/launcher=cores", "joblib"),
        ("hydra/launcher=slurm", "submitit"),
        ("hydra/launcher=slurm_here", "submitit"),
        ("hydra/launcher=ray", "ray"),
        ("hydra/sweeper=optuna", "optuna"),
    ],
)
def test_what_is_not_installed_is_named(monkeypatch, argument, extra):
    monkeypatch.setattr(cli, "find_spec", lambda name: None)
    assert f"airhockey-haptics[{extra}]" in cli.missing_extra(["seed=1", argument])
    monkeypatch.setattr(cli, "find_spec", lambda name: name)
    assert cli.missing_extra(["seed=1", argument]) is None
