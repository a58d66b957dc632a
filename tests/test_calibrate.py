"""What may be set from unguided play, by rule."""

import sys

import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.cli import InputError
from guidance import calibrate
from guidance.calibrate import fitting_opponent, threshold
from guidance.forces import uncertainty_weight


@pytest.mark.parametrize("wanted", [0.25, 0.6, 0.751])
def test_thresholds_give_the_mean_weight_they_were_asked_for(wanted):
    std = torch.rand(5000, 2, generator=torch.Generator().manual_seed(0)) ** 2
    found = threshold(std, wanted, low_over_high=0.5)
    assert found["low"] == pytest.approx(found["high"] / 2, rel=1e-3)
    assert uncertainty_weight(std, found["low"], found["high"]).mean().item() == pytest.approx(wanted, abs=2e-3)
    assert found["mean_w_unc"] == pytest.approx(wanted, abs=1e-3)


def test_the_opponent_is_the_newest_within_both_ranges():
    trials = {
        0: {"win_rate": 0.9, "round_seconds": 15.0},
        5: {"win_rate": 0.45, "round_seconds": 15.0},
        10: {"win_rate": 0.40, "round_seconds": 20.0},
        15: {"win_rate": 0.40, "round_seconds": 60.0},
    }
    assert fitting_opponent(trials, [0.35, 0.55], [12, 25]) == 10
    with pytest.raises(InputError, match="no generation"):
        fitting_opponent(trials, [0.6, 0.7], [12, 25])


def test_the_command_writes_what_it_found_and_what_it_rests_on(monkeypatch, tmp_path, capsys):
    short = ["study.rounds=2", "study.extra_rounds=0", "study.min_seconds=0", "study.round_seconds=12", "games=2"]
    monkeypatch.setattr(sys, "argv", ["calibrate", "opponent=80", *short, f"hydra.run.dir={tmp_path}"])
    calibrate.main()
    found = OmegaConf.load(tmp_path / "calibration.yaml")
    assert found.opponent == 80 and 0 <= found.evidence.opponents[80].win_rate <= 1
    assert found.thresholds.optimal.mean_w_unc == pytest.approx(0.6, abs=0.01)
    assert found.thresholds.user.mean_w_unc == pytest.approx(0.751, abs=0.01)
    assert "thresholds" in capsys.readouterr().out
