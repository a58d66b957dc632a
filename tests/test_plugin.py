"""A package of somebody else's adds one of each kind, and runs through the commands without a change of ours."""

import json

import pandas as pd
import pytest

from airhockey_marl.experiment.files import load_tensors
from tests.processes import smoke, start

PLUGIN = "--plugin=tests.example_plugin"


def test_train_takes_an_algorithm_a_sampler_and_a_scripted_player(tmp_path):
    chosen = "algorithm=hill_climbing", "algorithm.step=0.01", "league=latest", "league.sampler=oldest"
    smoke("airhockey_marl", "train", PLUGIN, *chosen, "league.scripted_players=[wall]", f"hydra.run.dir={tmp_path}")
    config = json.loads((tmp_path / "card.json").read_text())["config"]
    assert config["algorithm"] == {"name": "hill_climbing", "step": 0.01}
    assert config["league"]["sampler"] == "oldest" and config["league"]["scripted_players"] == ["wall"]
    weights, _ = load_tensors(tmp_path / "league.safetensors")
    change = (weights["head.weight"][1] - weights["head.weight"][0]).std()
    assert change == pytest.approx(0.01 * 2**0.5, rel=0.3)  # two batches, a random step each


def test_evaluate_takes_a_condition_and_a_metric(tmp_path):
    smoke("guidance", "evaluate", PLUGIN, "beyond=[half]", "metrics=[hand_path]", f"hydra.run.dir={tmp_path}")
    trials, tests = pd.read_csv(tmp_path / "trials.csv"), pd.read_csv(tmp_path / "tests.csv")
    assert list(trials["condition"].unique())[-1] == "half" and len(trials) == 40
    assert trials["hand_path"].between(0.1, 20.0).all()
    assert set(tests.loc[tests["test"] == "planned", "metric"]) >= {"win_rate", "hand_path"}
    planned = tests[tests["test"] == "planned"]
    assert set(planned["x"]) == {"b"} and set(planned["y"]) == {"m"}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for text in ("OAHG (half as strong)", "Hand path, in 1/s", "(m)"):
        assert text in page
    assert "#8855AA" in (tmp_path / "figure6.svg").read_text(encoding="utf-8").upper().replace("#8855aa", "#8855AA")


def test_a_condition_of_a_plugin_is_played_alone(tmp_path):
    smoke("guidance", "evaluate", PLUGIN, "condition=half", f"hydra.run.dir={tmp_path}")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert [c["name"] for c in manifest["conditions"]] == ["half"] and manifest["conditions"][0]["letter"] == "m"


def test_play_takes_a_device(tmp_path):
    options = "device=pen", "device.max_speed=0.5", "seconds=0.5", "breath=0", "condition=half"
    done = start("guidance", "play", PLUGIN, *options, f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    assert "OAHG (half as strong)" in done.stdout


def test_without_the_plugin_its_names_are_unknown(tmp_path):
    done = start("guidance", "evaluate", "condition=half", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 2 and done.stderr.startswith("error: condition = half must be one of"), done.stderr
