"""Commands that were killed at random moments and gone on with end with the same bits as if nobody had touched them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from airhockey_marl.experiment.files import load_tensors
from tests import ROOT
from tests.airhockey_marl.commands.test_cli import pictures, scalars

TRAIN = ["airhockey_marl.train", "state.safetensors", "+preset=smoke", "steps_per_generation=500"]
META = ["guidance.commands.meta_train", "state.safetensors", "+preset=smoke", "demonstrations.ticks=400"]
REPLICATE = ["guidance.commands.replicate", "manifest.json", "+preset=smoke", "sensitivity.points=0", "together=1"]
CASES = {
    "train": [*TRAIN, "generations=30", "pictures_every=3"],
    "meta_train": [*META, "maml.epochs=100", "supervised.epochs=60"],
    "replicate": [*REPLICATE, "n=20", "controls=3"],
}
UNLIKE = ("seconds", "date", "command")  # of two runs with the same bits


def kept(run: Path) -> dict[str, object]:
    """All that a run leaves, but for what the clock says, its name, and logs."""
    found: dict[str, object] = {}
    for file in sorted(path for path in run.rglob("*") if path.is_file()):
        name = str(file.relative_to(run))
        if name.startswith((".hydra", ".lock", "run.json")) or file.suffix == ".log":
            continue
        if file.suffix == ".safetensors":
            tensors, facts = load_tensors(file)
            facts = {key: value for key, value in facts.items() if key not in UNLIKE}
            found[name] = {key: tensor.numpy().tobytes() for key, tensor in tensors.items()}, json.dumps(facts)
        elif file.suffix == ".json":
            facts = json.loads(file.read_text())
            facts["config"].pop("resume")
            found[name] = {key: value for key, value in facts.items() if key not in UNLIKE}
        elif "tfevents" in name:
            part = file.parent.relative_to(run / "tensorboard")
            found[str(file.parent)[len(str(run)) :]] = scalars(run, str(part)), pictures(run, str(part))
        elif file.suffix != ".html":  # which has the manifest in it
            found[name] = file.read_bytes()
    return found


def ends_alike(tmp_path: Path, case: list[str], kills: int, seed: int) -> tuple[int, int]:
    """Kill a command so often, and compare: how often it was killed, and how often gone on with."""
    module, state, *arguments = case
    command = [
        sys.executable,
        "-m",
        "tests.robustness.kill_and_resume",
        module,
        kills,
        seed,
        tmp_path / "runs",
        state,
        *arguments,
    ]
    done = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    whole, killed = (kept(tmp_path / "runs" / name) for name in ("whole", "killed"))
    assert whole.keys() == killed.keys()
    for name, content in whole.items():
        assert content == killed[name], name
    return tuple(map(int, done.stdout.split()[-2:]))


@pytest.mark.slow
def test_a_replication_that_was_killed_goes_on(tmp_path):
    """That a training does, is in `test_cli`."""
    ends_alike(tmp_path, [*REPLICATE, "n=2", "controls=0"], kills=1, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_twenty_kills_leave_no_trace(tmp_path, name):
    killed, resumed = ends_alike(tmp_path, CASES[name], kills=20, seed=2)
    assert killed == 20 and resumed >= 5
