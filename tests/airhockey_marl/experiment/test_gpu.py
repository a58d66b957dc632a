"""Training on a GPU agrees with training on the CPU up to rounding. Skipped without a GPU."""

import copy
import math

import pytest
import torch
from hydra import compose, initialize_config_dir
from tensordict import TensorDict

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from guidance.user_model.data import Demonstrations
from guidance.user_model.training import train_maml, train_supervised

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def batch(tables: int = 50, steps: int = 20) -> TensorDict:
    """A random batch of transitions as `Learner.update` takes it."""
    draw = torch.Generator().manual_seed(0)
    done = torch.rand(tables, steps, 1, generator=draw) < 0.02
    next_step = {
        "observation": torch.randn(tables, steps, 12, generator=draw),
        "reward": torch.randn(tables, steps, 1, generator=draw),
        **{name: done.clone() for name in ("done", "terminated")},
        "truncated": torch.zeros_like(done),
    }
    observation = torch.randn(tables, steps, 12, generator=draw)
    action = torch.randn(tables, steps, 2, generator=draw)
    return TensorDict({"observation": observation, "action": action, "next": next_step}, [tables, steps])


@pytest.mark.parametrize("algorithm", ["trpo", "ppo", "sac"])
def test_an_update_on_a_gpu_agrees_with_the_cpu(algorithm):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=[f"algorithm={algorithm}"])
    moved = {}
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        policy = GaussianPolicy([16]).to(device)
        before = copy.deepcopy(policy).cpu()
        learner = ALGORITHMS.build(cfg.algorithm, "algorithm").learner(policy, cfg.gamma)
        metrics = learner.update(batch().to(device))
        assert all(map(math.isfinite, metrics.values()))
        league = League(before)
        league.add(policy)  # a frozen copy on the CPU
        after = league.player(0)
        pairs = zip(after.parameters(), before.parameters(), strict=True)
        moved[device] = torch.cat([(a - b).flatten() for a, b in pairs]).detach()
    assert moved["cpu"].abs().max() > 1e-4
    if algorithm == "sac":  # draws actions on the device, with another generator
        assert moved["cuda"].norm().item() == pytest.approx(moved["cpu"].norm().item(), rel=0.5)
    else:
        assert torch.allclose(moved["cuda"], moved["cpu"], atol=0.05 * moved["cpu"].abs().max().item())


@pytest.mark.parametrize("train", [train_maml, train_supervised])
def test_user_model_training_on_a_gpu_agrees_with_the_cpu(train):
    draw = torch.Generator().manual_seed(0)
    data = Demonstrations(torch.randn(3, 2, 400, 12, generator=draw), torch.randn(3, 2, 400, 2, generator=draw))
    kwargs = {"block": 200} if train is train_maml else {"batch_size": 200}
    losses = {}
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        model = GaussianPolicy([16, 16]).to(device)
        shuffled = torch.Generator().manual_seed(1)
        epochs = train(model, data.to(device), epochs=3, generator=shuffled, **kwargs)
        losses[device] = [metrics["loss"] for metrics in epochs]
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=1e-3)
