"""Searches for settings: trials lie in a file, with what their runs found, and a search goes on from there."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from tests import ROOT

optuna = pytest.importorskip("optuna")
pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")


TRPO = ["airhockey_marl.train", "-m", "+sweep=trpo", "+preset=smoke", "steps_per_generation=500", "pictures_every=0"]
MAML = ["guidance", "meta_train", "-m", "+sweep=maml", "+preset=smoke", "demonstrations.ticks=200", "maml.epochs=20"]


def begin(outputs, *command: str) -> subprocess.Popen:
    env = os.environ | {"AIRHOCKEY_OUTPUTS": str(outputs)}
    how = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-m", *command], cwd=ROOT, env=env, **how)


def search(outputs, *command: str) -> None:
    process = begin(outputs, *command)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said


def study_of(outputs, name: str):
    return optuna.load_study(study_name=name, storage=f"sqlite:///{outputs}/sweep_{name}.db")


def test_a_search_is_written_down_and_gone_on_with(tmp_path):
    outputs = tmp_path / "new"
    search(outputs, *TRPO, "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=2", "hydra/launcher=cores")
    search(outputs, *TRPO, "hydra.sweeper.n_trials=1", "hydra.sweeper.sampler.seed=2")
    study = study_of(outputs, "trpo")
    cards = [json.loads(file.read_text()) for file in outputs.glob("train/*/*-sweep/*/card.json")]
    assert len(study.trials) == len(cards) == 3
    assert study.direction == optuna.study.StudyDirection.MAXIMIZE
    found = {card["config"]["gamma"]: card["win_rate_of_last_against"]["striker"] for card in cards}
    assert len(found) == 3
    for trial in study.trials:
        assert trial.state == optuna.trial.TrialState.COMPLETE
        assert trial.value == pytest.approx(found[trial.params["gamma"]], abs=1e-3)


def test_a_search_that_was_killed_is_gone_on_with(tmp_path):
    """SIGKILL in the middle of the second trial: the first is as it was, the second never ends, others follow."""
    outputs = tmp_path / "new"
    process = begin(outputs, *MAML, "hydra.sweeper.n_trials=3")
    while not list(outputs.glob("meta_train/*/*-sweep/1/state.safetensors")):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    first, second = study_of(outputs, "maml").trials
    assert (first.state, second.state) == (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.RUNNING)

    search(outputs, *MAML, "hydra.sweeper.n_trials=2", "hydra.sweeper.sampler.seed=2")
    study = study_of(outputs, "maml")
    assert study.direction == optuna.study.StudyDirection.MINIMIZE
    assert (study.trials[0].params, study.trials[0].value) == (first.params, first.value)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "RUNNING", "COMPLETE", "COMPLETE"]
    cards = [json.loads(file.read_text()) for file in outputs.glob("meta_train/*/*-sweep/*/card.json")]
    found = {card["config"]["maml"]["inner_lr"]: card["on_nine_others"]["after_ua_loss"] for card in cards}
    assert len(found) == 3
    for trial in study.get_trials(states=[optuna.trial.TrialState.COMPLETE]):
        assert trial.value == pytest.approx(found[trial.params["maml.inner_lr"]], abs=1e-3)


@pytest.mark.parametrize(("sweep", "command"), [("trpo", "train"), ("maml", "meta_train")])
def test_what_is_searched_for_exists(sweep, command):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose(command, overrides=[f"+sweep/{command}={sweep}"], return_hydra_config=True)
    names = list(cfg.hydra.sweeper.params)
    assert names and all(isinstance(OmegaConf.select(cfg, name), float) for name in names)
