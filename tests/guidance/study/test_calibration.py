"""What may be set from unguided play, by rule."""

import sys

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.experiment.command import InputError, run
from airhockey_marl.players.networks import GaussianPolicy
from guidance.commands import calibrate
from guidance.forces.equations import uncertainty_weight
from guidance.forces.lookahead import Lookahead
from guidance.study.calibration import max_stable_stiffness, select_opponent, target_lead, threshold
from guidance.study.models import Models


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
    assert select_opponent(trials, [0.35, 0.55], [12, 25]) == 10
    with pytest.raises(InputError, match="no generation"):
        select_opponent(trials, [0.6, 0.7], [12, 25])


def test_the_stiffest_spring_leaves_the_least_damped_hand_its_share():
    lead, damping = np.array([0.1, 0.05, -0.02]), np.array([8.0, 3.0, 1.0])
    assert max_stable_stiffness(lead, damping, share=0.8, of_people=0.95, step=1.0) == 48.0  # 0.8 * 3 / 0.05
    assert max_stable_stiffness(lead, damping, share=0.8, of_people=0.5, step=1.0) == 64.0
    assert max_stable_stiffness(lead, damping, share=0.8, of_people=0.95, step=10.0) == 40.0


def test_the_lead_of_a_model_that_extrapolates_is_its_look_ahead():
    """A hand that its paddle follows at once, and a model that says: where the paddle is."""
    table, tick = TableSpec(), TableSpec().tick
    at = 0.5 * torch.sin(torch.arange(2000)[:, None] * torch.tensor([[0.02, 0.03]]))
    middle, half = (torch.tensor(part, dtype=torch.float32) for part in action_range(table))
    paddle = middle + at * half
    observation = torch.zeros(2000, 12)
    observation[:, 4], observation[:, 8] = table.length / 4, 0.9 * table.length / 2  # out of the way
    observation[0, :2], observation[1:, :2], observation[1:, 2:4] = middle, paddle[:-1], paddle.diff(dim=0) / tick
    linear = GaussianPolicy([4])
    with torch.no_grad():  # four ReLUs for plus and minus x and y; the mean is their difference
        for parameter in linear.parameters():
            parameter.zero_()
        for axis in (0, 1):
            linear.layers[0].weight[2 * axis, axis], linear.layers[0].weight[2 * axis + 1, axis] = 1.0, -1.0
            scale = linear.inputs.scale[axis] / half[axis]
            linear.head.weight[axis, 2 * axis], linear.head.weight[axis, 2 * axis + 1] = scale, -scale
            linear.head.bias[axis] = -middle[axis] / half[axis]
    models = Models(linear, linear, linear, 1e-9, {})
    for seconds in (0.0, 0.1):
        (lead,) = target_lead(models, [(observation, at)] * 2, 2, Lookahead(seconds))
        assert lead == pytest.approx(seconds, abs=2e-3)
        (lead,) = target_lead(models, [(observation, at)] * 2, 2, Lookahead(seconds, "consistent"))
        assert lead == pytest.approx(0.0, abs=2e-3)  # such a spring does not push along the motion


def test_the_command_writes_what_it_found_and_what_it_rests_on(monkeypatch, tmp_path, capsys):
    short = ["study.rounds=2", "study.extra_rounds=0", "study.min_seconds=0", "study.round_seconds=12", "games=2"]
    short += ["stability.lookaheads=[0.05,0.2]"]
    monkeypatch.setattr(sys, "argv", ["calibrate", "opponent=80", *short, f"hydra.run.dir={tmp_path}"])
    run(calibrate.__name__)
    found = OmegaConf.load(tmp_path / "calibration.yaml")
    assert found.opponent == 80 and 0 <= found.evidence.opponents[80].win_rate <= 1
    assert found.thresholds.optimal.mean_w_unc == pytest.approx(0.6, abs=0.01)
    assert found.thresholds.user.mean_w_unc == pytest.approx(0.751, abs=0.01)
    assert found.evidence.stable[0.05].lead < found.evidence.stable[0.2].lead  # a longer look-ahead, a longer lead
    assert found.stiffness == found.evidence.stable[0.1].stiffness > found.evidence.stable[0.2].stiffness > 0
    assert all(0 <= row.optimal_wins <= 1 for row in found.evidence.stable.values())
    assert "thresholds" in capsys.readouterr().out
