"""Searches for settings: trials lie in a file, with what their runs found, and a search goes on from there."""

import json
import os
import subprocess
import sys

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from airhockey_marl.cli import CONF
from tests.test_cli import ROOT

optuna = pytest.importorskip("optuna")
pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")


def search(outputs, *arguments: str) -> None:
    tiny = ["+sweep=trpo", "+preset=smoke", "steps_per_generation=500", *arguments]
    command = [sys.executable, "-m", "airhockey_marl.train", "-m", *tiny]
    env = os.environ | {"AIRHOCKEY_OUTPUTS": str(outputs)}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


def test_a_search_is_written_down_and_gone_on_with(tmp_path):
    outputs = tmp_path / "new"
    search(outputs, "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=2", "hydra/launcher=cores")
    search(outputs, "hydra.sweeper.n_trials=1", "hydra.sweeper.sampler.seed=2")
    study = optuna.load_study(study_name="trpo", storage=f"sqlite:///{outputs}/sweep_trpo.db")
    cards = [json.loads(file.read_text()) for file in outputs.glob("train/*/*-sweep/*/card.json")]
    assert len(study.trials) == len(cards) == 3
    assert study.direction == optuna.study.StudyDirection.MAXIMIZE
    found = {card["config"]["gamma"]: card["win_rate_of_last_against"]["striker"] for card in cards}
    assert len(found) == 3
    for trial in study.trials:
        assert trial.state == optuna.trial.TrialState.COMPLETE
        assert trial.value == pytest.approx(found[trial.params["gamma"]], abs=1e-3)


@pytest.mark.parametrize(("sweep", "command"), [("trpo", "train"), ("maml", "meta_train")])
def test_what_is_searched_for_exists(sweep, command):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose(command, overrides=[f"+sweep={sweep}"], return_hydra_config=True)
    names = list(cfg.hydra.sweeper.params)
    assert names and all(isinstance(OmegaConf.select(cfg, name), float) for name in names)
