"""One smallest run of each command, for all tests that look at what commands write."""

from pathlib import Path

import pytest

from tests.processes import smoke


@pytest.fixture(scope="session")
def runs(tmp_path_factory) -> Path:
    """A folder with a run of each command under its name, and what it printed in <name>.txt: a league, its report, user
    models, and a study of all nine conditions with them."""
    folder = tmp_path_factory.mktemp("runs")
    files = {"league": "train/league", "user": "meta_train/user", "meta": "meta_train/meta"}
    models = [f"models.{name}={folder}/{file}.safetensors" for name, file in files.items()]
    for module, name, *arguments in (
        ("airhockey_marl", "train"),
        ("airhockey_marl", "league_report", f"run={folder}/train"),
        ("guidance", "meta_train", "seed=4"),
        ("guidance", "evaluate", "seed=3", *models),
    ):
        done = smoke(module, name, *arguments, f"hydra.run.dir={folder}/{name}")
        (folder / f"{name}.txt").write_text(done.stdout, encoding="utf-8")
    return folder
