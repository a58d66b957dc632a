"""Diverged training stops with the reason, for every algorithm, and the last checkpoint remains."""

import math
import sys

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.divergence import name_divergence, require_finite_modules, require_sound_metrics
from airhockey_marl.algorithms.trpo import TRPOLearner
from airhockey_marl.commands import train
from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.files import load_tensors
from airhockey_marl.players.networks import GaussianPolicy
from guidance.commands import meta_train
from guidance.user_model.data import Demonstrations
from guidance.user_model.training import train_maml, train_supervised
from tests.airhockey_marl.algorithms.test_ppo import one_step_rounds

SOUND = {"kl": 0.01, "std": 0.3, "critic_loss": 1.0}


def test_sound_metrics_and_weights_pass():
    require_sound_metrics(SOUND)
    require_sound_metrics({"q_loss": 0.0, "std": 0.001})
    require_finite_modules({"policy": GaussianPolicy([4])})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"critic_loss": math.nan}, r"update/critic_loss = nan: training has diverged"),
        ({"q_loss": math.inf}, r"update/q_loss = inf"),
        ({"kl": 11.0}, r"update/kl = 11 nats in one update, must be at most 10"),
        ({"kl": math.nan}, r"update/kl = nan"),
        ({"std": 0.0}, r"update/std = 0: must be between 0.0001 and 0.9999"),
        ({"std": 1.0}, r"update/std = 1: must be between 0.0001 and 0.9999"),
    ],
)
def test_unsound_metrics_are_named(change, message):
    with pytest.raises(FloatingPointError, match=message):
        require_sound_metrics(SOUND | change)


def test_weights_and_optimizer_states_are_checked():
    policy = GaussianPolicy([4])
    optimizer = torch.optim.Adam(policy.parameters())
    policy(torch.zeros(2, 12))[0].sum().backward()
    optimizer.step()
    require_finite_modules({"policy": policy, "optimizer": optimizer})
    optimizer.state[policy.head.bias]["exp_avg"][1] = math.nan
    with pytest.raises(FloatingPointError, match=r"optimizer\.3\.exp_avg has values that are not finite"):
        require_finite_modules({"policy": policy, "optimizer": optimizer})
    policy.head.weight.data[0, 0] = math.inf
    with pytest.raises(FloatingPointError, match=r"policy\.head\.weight has values"):
        require_finite_modules({"policy": policy})


def test_message_names_the_phase_and_the_checkpoint(tmp_path):
    message = "stopped in generation 3: gone; nothing was written yet"
    with pytest.raises(FloatingPointError, match=message), name_divergence("generation 3", tmp_path / "none"):
        raise FloatingPointError("gone")


@pytest.mark.parametrize("algorithm", ["trpo", "ppo", "sac"])
def test_every_algorithm_detects_a_nan_reward(algorithm):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=[f"algorithm={algorithm}", "+preset/train=smoke"])
    if algorithm == "sac":
        cfg.algorithm.updates, cfg.algorithm.batch_size, cfg.algorithm.capacity = 20, 64, 1000
    torch.manual_seed(0)
    policy = GaussianPolicy([8], "paddle")
    learner = ALGORITHMS.build(cfg.algorithm, "algorithm").learner(policy, 0.99)
    batch = one_step_rounds(0.0, True)
    require_sound_metrics(learner.update(batch.clone()))
    require_finite_modules({"policy": policy, **learner.modules()})
    batch["next", "reward"][1, 5] = math.nan
    with pytest.raises((FloatingPointError, ValueError), match=r"nan|not finite"):
        require_sound_metrics(learner.update(batch))
        require_finite_modules({"policy": policy, **learner.modules()})


def test_trpo_takes_no_step_along_a_nan_gradient():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        settings = ALGORITHMS.build(compose("train").algorithm, "algorithm")
    learner = TRPOLearner(settings, GaussianPolicy([8]), 0.99)
    before = [parameter.clone() for parameter in learner.policy.parameters()]
    observation, action = torch.randn(50, 12), torch.randn(50, 2)
    metrics = learner.update_policy(observation, action, torch.full((50,), math.nan))
    assert metrics["step"] == 0.0
    assert all(torch.equal(a, b) for a, b in zip(before, learner.policy.parameters(), strict=True))


def test_diverged_training_ends_in_one_line_and_can_be_resumed(tmp_path, monkeypatch, capsys):
    """A reward of the third generation is NaN; the files of the second remain."""
    few = ["+preset=smoke", "generations=4", "steps_per_generation=500", f"hydra.run.dir={tmp_path}/run"]
    update, calls, kept = TRPOLearner.update, [], {}

    def spoiled(self, batch):
        calls.append(1)
        if len(calls) == 3:
            kept.update({path.name: path.read_bytes() for path in (tmp_path / "run").glob("*.safetensors")})
            batch["next", "reward"][0, 0] = math.nan
        return update(self, batch)

    monkeypatch.setattr(TRPOLearner, "update", spoiled)
    monkeypatch.setattr(sys, "argv", ["train", *few])
    with pytest.raises(SystemExit) as stopped:
        start_command(train.__name__)
    said = capsys.readouterr().err
    assert stopped.value.code == 1 and said.startswith("error: stopped in generation 3: update/critic_loss = nan"), said
    assert said.count("\n") == 1 and said.strip().endswith(
        f"{tmp_path}/run/state.safetensors holds the last good state"
    )
    assert kept == {path.name: path.read_bytes() for path in (tmp_path / "run").glob("*.safetensors")}
    assert load_tensors(tmp_path / "run" / "state.safetensors")[1]["generation"] == 2
    monkeypatch.setattr(TRPOLearner, "update", update)
    monkeypatch.setattr(sys, "argv", ["train", f"resume={tmp_path}/run", f"hydra.run.dir={tmp_path}/log"])
    start_command(train.__name__)
    assert (tmp_path / "run" / "card.json").is_file()


@pytest.mark.parametrize("training", [train_maml, train_supervised])
@pytest.mark.parametrize("spoil", [1e30, -1e30])
def test_diverged_user_models_keep_their_last_weights(training, spoil):
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(2, 2, 60, 12, generator=generator)
    data = Demonstrations(observation, torch.full((2, 2, 60, 2), spoil))
    model = GaussianPolicy([8])
    before = [parameter.clone() for parameter in model.parameters()]
    size = {"block": 20} if training is train_maml else {"batch_size": 20}
    with pytest.raises(FloatingPointError, match="must be finite"):
        list(training(model, data, epochs=2, **size))
    assert all(torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))


def test_diverged_meta_training_ends_in_one_line(tmp_path, monkeypatch, capsys):
    whole = train_maml

    def spoiled(*arguments, **options):
        for metrics in whole(*arguments, **options):
            yield metrics
            raise FloatingPointError("loss: nan, gradient nan in epoch 2, must be finite")

    monkeypatch.setattr("guidance.user_model.training.train_maml", spoiled)
    monkeypatch.setattr(sys, "argv", ["meta_train", "+preset=smoke", f"hydra.run.dir={tmp_path}/run"])
    with pytest.raises(SystemExit) as stopped:
        start_command(meta_train.__name__)
    said = capsys.readouterr().err
    assert stopped.value.code == 1 and "error: stopped in maml training: loss: nan, gradient nan" in said, said
    facts = load_tensors(tmp_path / "run" / "state.safetensors")[1]
    assert facts["done"] == {"maml": 1, "supervised": 0} and np.isfinite(facts["seconds"])
