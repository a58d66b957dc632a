"""Commands that are killed at random moments and resumed end with the same bits as undisturbed ones."""

import json
from pathlib import Path

import pytest

from airhockey_marl.experiment.files import load_tensors
from tests.airhockey_marl.commands.test_cli import pictures, scalars
from tests.robustness.kill_and_resume import kill_and_resume

TRAIN = ["train", "state.safetensors", "+preset=smoke", "steps_per_generation=500"]
META = ["meta_train", "state.safetensors", "+preset=smoke", "demonstrations.ticks=400"]
REPLICATE = ["replicate", "manifest.json", "+preset=smoke", "sensitivity.points=0", "together=1"]
CASES = {
    "train": [*TRAIN, "generations=30", "pictures_every=3"],
    "meta_train": [*META, "maml.epochs=100", "supervised.epochs=60"],
    "replicate": [*REPLICATE, "n=20", "controls=3"],
}
DIFFERENT = ("seconds", "date", "command", "resumed_by")  # also between two undisturbed runs


def results_of(run: Path) -> dict[str, object]:
    """Content of a run folder by file name, without times, names of runs and logs."""
    results: dict[str, object] = {}
    for file in sorted(path for path in run.rglob("*") if path.is_file()):
        name = str(file.relative_to(run))
        if name.startswith((".hydra", ".lock", "run.json")) or file.suffix == ".log":
            continue
        if file.suffix == ".safetensors":
            tensors, facts = load_tensors(file)
            facts = {key: value for key, value in facts.items() if key not in DIFFERENT}
            results[name] = {key: tensor.numpy().tobytes() for key, tensor in tensors.items()}, json.dumps(facts)
        elif file.suffix == ".json":
            facts = json.loads(file.read_text())
            facts["config"].pop("resume")
            results[name] = {key: value for key, value in facts.items() if key not in DIFFERENT}
        elif "tfevents" in name:
            part = file.parent.relative_to(run / "tensorboard")
            results[str(file.parent)[len(str(run)) :]] = scalars(run, str(part)), pictures(run, str(part))
        elif file.suffix != ".html":  # which has the manifest in it
            results[name] = file.read_bytes()
    return results


def assert_kills_leave_no_trace(tmp_path: Path, case: list[str], kills: int, seed: int) -> int:
    """Kill a command so often and compare: how many of its processes resumed another."""
    command, state, *arguments = case
    resumed = kill_and_resume(command, state, arguments, kills, seed, tmp_path)
    whole, killed = (results_of(tmp_path / name) for name in ("whole", "killed"))
    assert whole.keys() == killed.keys()
    for name, content in whole.items():
        assert content == killed[name], name
    return resumed


@pytest.mark.slow
def test_a_killed_replication_resumes(tmp_path):
    """Of a training, see `test_cli`."""
    assert_kills_leave_no_trace(tmp_path, [*REPLICATE, "n=2", "controls=0"], kills=1, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_twenty_kills_leave_no_trace(tmp_path, name):
    assert assert_kills_leave_no_trace(tmp_path, CASES[name], kills=20, seed=2) >= 5
