"""The shipped models are what their cards say, and models find their way to files and back."""

import json
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl.experiment.config import CONF
from airhockey_marl.experiment.files import sha256
from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from guidance import pretrained
from guidance.study.models import Models, load_user_model, save_user_model
from guidance.study.setup import load_models
from guidance.user_model.maml import forward_stacked
from tests import ROOT

LEAGUE = ROOT / "airhockey_marl" / "pretrained"
USER = ROOT / "guidance" / "pretrained" / "now"
PREDICTORS = sorted(file.parent for file in USER.parent.glob("*/meta.safetensors"))


def test_the_shipped_league_is_the_one_on_its_card():
    card = json.loads((LEAGUE / "card.json").read_text())
    league = League.load(LEAGUE / "league.safetensors")
    assert league.hashes == card["hashes"] and len(league) == card["generations"] == 101
    assert league.policy.hidden == (64, 64)


@pytest.mark.parametrize("folder", PREDICTORS, ids=lambda folder: folder.name)
def test_the_shipped_user_models_were_trained_against_the_studys_opponent_of_that_league(folder):
    card = json.loads((folder / "card.json").read_text())
    assert card["opponents_sha256"] == sha256(LEAGUE / "opponents.safetensors")
    for name in ("user", "meta"):
        model, facts = load_user_model(folder / f"{name}.safetensors")
        assert model.hidden == (80, 80, 80, 80) and facts["seed"] == card["seed"]


def test_the_shipped_models_are_those_of_the_configured_predictor():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("evaluate")
    assert pretrained.models().hashes == load_models(cfg).hashes
    assert {Path(cfg.models[name]).parent.name for name in ("user", "meta")} == {cfg.guidance.predictor}
    with pytest.raises(ValueError, match=r"guidance\.predictor = never must be one of .*now"):
        pretrained.models("never")


def test_user_models_survive_being_written_down(tmp_path):
    model = GaussianPolicy([8, 8])
    save_user_model(tmp_path / "m.safetensors", model, {"inner_lr": 0.1})
    loaded, facts = load_user_model(tmp_path / "m.safetensors")
    seen = torch.randn(5, 12)
    assert all(torch.equal(a, b) for a, b in zip(model(seen), loaded(seen), strict=True))
    assert facts == {"inner_lr": 0.1, "hidden": [8, 8], "inputs": "table"}


def test_adaptation_is_each_users_own_however_long_the_game():
    torch.manual_seed(0)
    model = GaussianPolicy([8])
    models = Models(model, model, model, 0.1, {})
    games = [(torch.randn(ticks, 12), torch.randn(ticks, 2)) for ticks in (40, 70)]
    together, alone = models.adapted_to(games), models.adapted_to(games[1:])
    assert together.batch_size == (2,)
    seen = torch.randn(1, 3, 12)
    assert torch.equal(forward_stacked(model, together[1:], seen)[0], forward_stacked(model, alone, seen)[0])
    assert not torch.equal(forward_stacked(model, together[:1], seen)[0], forward_stacked(model, alone, seen)[0])


def test_a_model_without_meta_learning_cannot_adapt():
    with pytest.raises(ValueError, match="not meta-learned"):
        Models.load(LEAGUE / "league.safetensors", -1, USER / "user.safetensors", USER / "user.safetensors")
