"""What may be set from unguided play, by rule."""

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.experiment.command import InputError, run
from airhockey_marl.players.networks import GaussianPolicy
from guidance.commands import calibrate
from guidance.forces.equations import uncertainty_weight
from guidance.forces.lookahead import Lookahead
from guidance.study.calibration.unguided import max_stable_stiffness, select_opponent, target_lead, threshold
from guidance.study.models import Models


@pytest.mark.parametrize("wanted", [0.25, 0.6, 0.751])
def test_thresholds_give_the_mean_weight_they_were_asked_for(wanted):
    std = torch.rand(5000, 2, generator=torch.Generator().manual_seed(0)) ** 2
    found = threshold(std, wanted, low_over_high=0.5)
    assert found["low"] == pytest.approx(found["high"] / 2, rel=1e-3)
    assert uncertainty_weight(std, found["low"], found["high"]).mean().item() == pytest.approx(wanted, abs=2e-3)
    assert found["mean_w_unc"] == pytest.approx(wanted, abs=1e-3)


def test_the_opponent_is_the_newest_within_both_ranges():
    rows = [(0, 0.9, 15.0), (5, 0.45, 15.0), (10, 0.40, 20.0), (15, 0.40, 60.0)]
    trials = pd.DataFrame(rows, columns=["generation", "win_rate", "round_seconds"])
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


SHORT = [
    *("opponent=80", "games=2", "study.familiarization=0", "study.rounds=1", "study.extra_rounds=0"),
    *("study.min_seconds=0", "study.round_seconds=20", "stability.lookaheads=[0.05,0.2]"),
]


def calibrated(folder, *arguments):
    run(calibrate.__name__, [*SHORT, *arguments, f"hydra.run.dir={folder}"])
    return OmegaConf.load(folder / "calibration.yaml")


def test_the_former_rule_leaves_the_guidance_as_configured(tmp_path, capsys):
    result = calibrated(tmp_path, "guidance=stability", "pilot.people=[]", "pilot.left=[]")
    assert result.opponent == 80 and "pilot" not in result
    assert 0 <= result.evidence.opponents[0].win_rate <= 1
    assert result.thresholds.optimal.mean_w_unc == pytest.approx(0.6, abs=0.01)
    assert result.thresholds.user.mean_w_unc == pytest.approx(0.751, abs=0.01)
    rows = {row.lookahead: row for row in result.evidence.stable}
    assert rows[0.05].lead < rows[0.1].lead < rows[0.2].lead  # a longer look-ahead, a longer lead
    assert rows[0.05].stiffness > rows[0.2].stiffness > 0
    assert all(0 <= row.optimal_wins <= 1 for row in rows.values())
    assert "thresholds" in capsys.readouterr().out


def test_the_pilot_chooses_one_of_its_candidates_and_resumes(tmp_path):
    few = ["pilot.people=[2,3]", "pilot.left=[2]", "pilot.search.stiffness=[50.0,100.0]", "pilot.search.limit=[3.0]"]
    few += [
        "pilot.search.predictor=[now]",
        "pilot.search.lookahead=[0.0,0.1]",
        "pilot.unseen=1",
        "pilot.demonstrations.ticks=600",
    ]
    few += ["pilot.holding.seconds=1.0", "pilot.holding.wander=1.0", "pilot.together=20", "stability.lookaheads=[]"]
    result = calibrated(tmp_path, *few)
    standings = pd.read_csv(tmp_path / "candidates.csv")
    last = standings[standings["round"] == 2]
    assert len(last) == 2 and dict(result.pilot) == last.iloc[0][list(result.pilot)].to_dict()
    assert result.pilot.predictor == "now" and result.pilot.lookahead == 0.1  # the only horizon of at least .1 s
    assert (tmp_path / "pilot.png").stat().st_size > 10_000
    games, text = (tmp_path / "games.csv").read_bytes(), (tmp_path / "calibration.yaml").read_bytes()
    rows = games.splitlines(keepends=True)
    (tmp_path / "games.csv").write_bytes(b"".join(rows[: 1 + 2 * 5]))  # as if it had been killed after some batches
    for name in ("candidates.csv", "calibration.yaml"):
        (tmp_path / name).unlink()
    run(calibrate.__name__, [f"resume={tmp_path}", f"hydra.run.dir={tmp_path}/again"])
    assert (tmp_path / "games.csv").read_bytes() == games
    assert (tmp_path / "calibration.yaml").read_bytes() == text


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("pilot.left=[60]", "pilot.left = [60] must be a number for each of pilot.people but the last"),
        ("pilot.people=[12,0]", "pilot.people = [12, 0] must be whole numbers of at least 1"),
        ("pilot.search.limit=[0.0,-1.0]", "pilot.search.limit = [0.0, -1.0] must be numbers from 0.0 to 10000.0"),
        ("pilot.search.reading=[]", "pilot.search.reading = [] must hold at least one value"),
        ("pilot.search.predictor=[then]", "then"),
    ],
)
def test_a_pilot_that_cannot_be_is_refused_in_one_line(argument, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        run(calibrate.__name__, [argument, f"hydra.run.dir={tmp_path}/run"])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.count("\n") == 1 and message in error
    assert not (tmp_path / "run" / "opponents.csv").exists()
