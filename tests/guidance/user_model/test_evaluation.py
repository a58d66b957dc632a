"""Predictors of a person, on made-up play with a known answer."""

import json
import math
import re
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.experiment.command import run
from airhockey_marl.experiment.plotting import save_png
from guidance.commands import prediction_report
from guidance.forces.lookahead import READINGS
from guidance.study import prediction
from guidance.study.models import Models
from guidance.user_model.data import Demonstrations
from guidance.user_model.evaluation import (
    SIGMAS,
    adapted_model,
    extrapolation,
    mean_interval,
    model_predictor,
    paddle_as_action,
    persistence,
    prediction_metrics,
    predictors,
    reliability,
    ticks_ahead,
    with_intervals,
)
from guidance.user_model.maml import parameters
from tests.guidance.user_model.test_training import ALPHA, Gaussian
from tests.pictures import faults

TABLE = TableSpec()
MIDDLE, HALF = (torch.tensor(part, dtype=torch.float32) for part in action_range(TABLE))


def gliding(ticks: int = 400, lead: float = 0.06) -> tuple[torch.Tensor, torch.Tensor]:
    """A paddle that goes round in an ellipse, and a hand that is `lead` s ahead of it."""
    seconds = TABLE.tick * torch.arange(ticks)

    def place(t: torch.Tensor) -> torch.Tensor:
        return torch.stack([0.5 * torch.sin(2 * t), 0.4 * torch.cos(2 * t)], dim=-1)

    velocity = torch.stack([torch.cos(2 * seconds), -0.8 * torch.sin(2 * seconds)], dim=-1)
    observation = torch.zeros(ticks, 12)
    observation[:, 0:2], observation[:, 2:4] = MIDDLE + HALF * place(seconds), HALF * velocity
    observation[:, 8] = 0.4
    return observation, place(seconds + lead)


def test_the_paddle_is_in_units_of_action():
    observation, action = gliding(lead=0.0)
    place, velocity = paddle_as_action(observation, TABLE)
    assert torch.allclose(place, action, atol=1e-5)
    assert torch.allclose((place[2:] - place[:-2]) / (2 * TABLE.tick), velocity[1:-1], atol=2e-2)


def test_extrapolation_fits_the_lead_and_persistence_does_not():
    observation, action = gliding()
    moved, stays = (make(observation, action, TABLE) for make in (extrapolation, persistence))
    for seconds, most in ((0.0, 0.01), (0.1, 0.05)):
        found = [prediction_metrics(predictor, observation, action, seconds, TABLE) for predictor in (moved, stays)]
        assert found[0]["rmse"] < most < found[1]["rmse"]
        assert found[0]["nll"] < found[1]["nll"]
    assert prediction_metrics(stays, observation, action, 0.0, TABLE)["rmse"] == pytest.approx(0.06 * 0.905, rel=0.05)


def test_ticks_ahead_stay_within_a_round():
    observation, _ = gliding(100)
    observation[40] = 0.0
    observation[40, 0], observation[40, 4] = -TABLE.length / 4, TABLE.length / 4  # a round begins
    now, then = ticks_ahead(observation, 0.1, TABLE)
    assert torch.equal(then, now + 5)
    assert set(range(95)) - set(now.tolist()) == {35, 36, 37, 38, 39}
    assert len(ticks_ahead(observation, 0.0, TABLE)[0]) == 100


def test_coverage_of_a_gaussian():
    torch.manual_seed(0)
    std = 0.05 + 0.1 * torch.rand(60_000, 2)
    observation, mean = torch.zeros(60_000, 12), 0.1 * torch.randn(60_000, 2)
    observation[:, 8] = 0.3
    action = mean + std * torch.randn_like(std)
    lookup = iter([(mean, std)] * 3)
    found = prediction_metrics(lambda seen, seconds: next(lookup), observation, action, 0.0, TABLE)
    for sigma, share in SIGMAS.items():
        assert found[f"within_{sigma}"] == pytest.approx(share, abs=0.006)
    reference = -torch.distributions.Normal(mean, std).log_prob(action).sum(-1).mean().item()
    assert found["nll"] == pytest.approx(reference, abs=1e-4)
    said, seen = reliability(lambda seen, seconds: next(lookup), observation, action)
    assert torch.allclose(said, seen, rtol=0.04) and (said[1:] > said[:-1]).all()
    overconfident, _ = reliability(lambda seen, seconds: (mean, std / 2), observation, action)
    assert torch.allclose(overconfident, said / 2, rtol=1e-5)


def test_a_model_predicts_from_the_lookahead_state():
    observation, _ = gliding()
    place, velocity = observation[:, 0:2], observation[:, 2:4]
    mean, _ = model_predictor(lambda seen: (seen[..., 0:2], seen[..., 0:2]))(observation, 0.2)
    assert torch.allclose(mean, place + 0.2 * velocity)


def test_ahead_of_time_the_state_is_moved_by_the_reading():
    """A paddle on its way to the wall is there under physics, and through it as printed."""
    observation = torch.zeros(1, 12)
    observation[0, :4], observation[0, 4], observation[0, 8] = torch.tensor([-0.8, 0.0, -2.0, 0.0]), 0.5, 0.1
    model = lambda seen: (seen[..., 0:2], seen[..., 0:2])  # noqa: E731
    found = {reading: model_predictor(model, 0.1, reading)(observation, 0.3)[0][0, 0].item() for reading in READINGS}
    wall = -TABLE.length / 2 + TABLE.paddle_radius
    assert found == pytest.approx({"printed": -1.2, "physics": wall, "consistent": wall})


def test_adaptation_lowers_the_loss_on_its_game():
    torch.manual_seed(0)
    meta, (observation, action) = Gaussian(), gliding(200)
    everybody = predictors(Gaussian(), meta, ALPHA, observation, action, TABLE)
    before, after = (
        prediction_metrics(everybody[name], observation, action, 0.0, TABLE) for name in ("before_ua", "after_ua")
    )
    assert after["loss"] < before["loss"]
    same = adapted_model(meta, parameters(meta))(observation)
    assert torch.equal(same[0], meta(observation)[0])


def test_the_mean_interval_is_students():
    values = np.array([1.0, 2.0, 3.0, 4.0])
    mean, low, high = mean_interval(values)
    assert (mean, high - mean) == pytest.approx((2.5, 3.182446 * values.std(ddof=1) / 2), rel=1e-5)
    assert low == pytest.approx(2 * mean - high)
    assert math.isnan(mean_interval(np.array([1.0]))[1])


def test_a_model_of_ones_own_is_found_better():
    matrix = np.array([[1.0, 5.0, 3.0], [4.0, 2.0, 4.0], [2.0, 3.0, 1.0]])
    found = prediction.for_whom(matrix)
    assert found["own"]["mean"] == pytest.approx(4 / 3)
    assert found["others"]["mean"] == pytest.approx((3 + 4 + 3.5) / 3)
    assert found["advantage"]["mean"] == pytest.approx((2 + 2 + 2.5) / 3)


def test_models_of_the_action_ahead_are_judged_by_the_action_ahead():
    """A model that says at once where the hand will be in 0.1 s is right about it, and its own player's."""
    lead = TABLE.tick * 5
    observation, action = gliding(400, lead=0.0)
    data = Demonstrations(*(part.repeat(2, 2, 1, 1) for part in (observation, action)))

    class Prophet(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shift = nn.Parameter(torch.zeros(2))

        def forward(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            place, velocity = paddle_as_action(seen, TABLE)
            turned = math.cos(2 * lead) * place + math.sin(2 * lead) / 2 * velocity  # exact, on an ellipse
            return turned + self.shift, torch.full_like(place, 0.01)

    prophet = Prophet()
    models = Models(prophet, prophet, prophet, 1e-9, {}, ahead=lead)
    matrix = prediction.everybody_by_everybody(models, data, TABLE)
    assert matrix.shape == (2, 2) and matrix.max() < 0.03
    found = prediction.reliabilities(models, data, TABLE)
    assert np.median(found["after_ua"]["seen"]) < 1e-3
    late = prediction.everybody_by_everybody(replace(models, ahead=0.0), data, TABLE)
    assert late.min() > 0.05


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prediction")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["prediction_report", "+preset=smoke", f"hydra.run.dir={folder}"])
        run(prediction_report.__name__)
    return folder


def test_the_report_is_whole(reported):
    found = json.loads((reported / "prediction.json").read_text())
    assert len(found["ahead"]) == 5 * 4 and found["people"] == 4
    assert np.array(found["matrix"]).shape == (4, 4)
    assert [row["minutes"] for row in found["minutes"]] == [0.05, 0.1] and len(found["steps"]) == 2
    at = {(row["predictor"], row["ahead_s"]): row["rmse"]["mean"] for row in found["ahead"]}
    assert at["persistence", 0.0] > at["extrapolation", 0.0] > 0
    assert at["extrapolation", 0.3] > at["extrapolation", 0.0]
    page = (reported / "prediction_report.html").read_text()
    text, pictures = re.subn(r"data:image/png;base64,[A-Za-z0-9+/=]*", "", page)
    assert pictures == 3 and "http" not in text.replace("http-equiv", "")
    for name in ("ahead", "adaptation", "reliability"):
        assert (reported / f"{name}.png").stat().st_size > 10_000


def test_numbers_of_any_magnitude_fit(reported, tmp_path, monkeypatch, capsys):
    """UA may diverge: a likelihood of 29 digits, infinite and undefined errors."""
    results = json.loads((reported / "prediction.json").read_text())
    facts = {key: results.pop(key) for key in ("people", "models", "config")}
    huge, none = {"mean": 7.9e28, "low": -1e300, "high": 1e300}, dict.fromkeys(("mean", "low", "high"))
    for row in results["ahead"]:
        if row["predictor"] == "after_ua":
            row |= {"nll": huge, "loss": huge, "rmse": none, "gain": none}
    for key, values in (("minutes", (0.167, 0.5, 1.0, 2.0, 4.0, 8.0)), ("steps", (1, 2, 3, 5, 10))):
        one = results[key][0]
        results[key] = [one | {key: value} for value in values[:-2]] + [
            one | {key: value, "rmse": error} for value, error in zip(values[-2:], (huge, none), strict=True)
        ]
    results["matrix"][0][1] = float("nan")
    results["reliability"]["after_ua"]["seen"][-1] = float("inf")
    figures = []
    monkeypatch.setattr("guidance.user_model.figures.save_png", lambda f, path: figures.append(f) or save_png(f, path))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        prediction_report.write(tmp_path, results, facts)
    assert len(figures) == 3 and not [fault for figure in figures for fault in faults(figure)]
    table = re.search("<tbody>(.*?)</tbody>", (tmp_path / "prediction_report.html").read_text(), re.DOTALL)[1]
    cells = re.sub(r"&#39;|<[^>]+>|[\[\],]", " ", table)
    assert "7.9e28" in cells and not [word for word in cells.split() if any(map(str.isdigit, word)) and len(word) > 8]
    assert max(map(len, capsys.readouterr().out.splitlines()[:6])) <= 110


def test_intervals_of_diverged_models_warn_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = with_intervals({"rmse": np.array([1.0, np.inf]), "nll": np.array([1e300, -1e300, 1.7e308])})
    assert found["rmse"] == {"mean": None, "low": None, "high": None} and found["nll"]["high"] is None


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("participants=1", "participants = 1 must be a whole number of at least 2"),
        ("ahead=[-1]", "ahead = [-1] must be numbers of at least 0.0"),
        ("minutes=[99]", "minutes = [99] must hold one of at most"),
        ("models.meta=guidance/pretrained/now/user.safetensors", "was not meta-learned"),
    ],
)
def test_wrong_values_are_named(argument, message, monkeypatch, tmp_path, capsys):
    arguments = ["prediction_report", "+preset=smoke", f"hydra.run.dir={tmp_path}", argument]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stop:
        run(prediction_report.__name__)
    assert stop.value.code == 2 and message in capsys.readouterr().err
