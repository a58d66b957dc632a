"""PPO: learning of delayed rewards, wrong settings, and exact resuming."""

import copy
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn
from torch.optim import Optimizer

from airhockey_marl.algorithms.base import ALGORITHMS, Algorithm
from airhockey_marl.algorithms.ppo import PPOConfig
from airhockey_marl.experiment.command import CONF
from airhockey_marl.players.networks import BODY_SCALE, GaussianPolicy

SETTINGS = {
    "clip_epsilon": 0.2,
    "epochs": 5,
    "batch_size": 700,
    "lr": 5e-3,
    "entropy_coef": 0.0,
    "critic_coef": 0.5,
    "max_grad_norm": 0.5,
    "gae_lambda": 0.95,
    "critic_hidden": [32],
    "critic_inputs": "paddle",
}
STEPS = 3  # of a round of `foresight`
SCALE = torch.tensor(BODY_SCALE * 3)  # of observations


def foresight(policy: GaussianPolicy, generator: torch.Generator, tables: int = 100, rounds: int = 7) -> TensorDict:
    """Rounds of three steps with a reward at the end that depends on the first action only.

    The first action, clipped to [-1, 1] as by the table, chooses a place; the reward is minus its squared distance from
    half of the goal. The observation has the goal, the place, and the fraction of steps left.

    Returns:
        (tables, 3 rounds) a batch for `base.Learner.update`.
    """
    steps = []
    for _ in range(rounds):
        goal, place = torch.randn(tables, 2, generator=generator), torch.zeros(tables, 2)
        for step in range(STEPS):
            observation = observe(goal, place, step) * SCALE
            with torch.no_grad():
                mean, std = policy(observation)
            action = mean + std * torch.randn(mean.shape, generator=generator)
            place = action.clamp(-1.0, 1.0) if step == 0 else place
            done = torch.full((tables, 1), step == STEPS - 1)
            next_step = {
                "observation": observe(goal, place, step + 1) * SCALE,
                "reward": -((place - 0.5 * goal) ** 2).sum(-1, keepdim=True) * done,
                "terminated": done,
                "truncated": torch.zeros_like(done),
                "done": done,
            }
            steps.append(TensorDict({"observation": observation, "action": action, "next": next_step}, [tables]))
    return torch.stack(steps, dim=1)


def observe(goal: torch.Tensor, place: torch.Tensor, step: int) -> torch.Tensor:
    """Observations (n, 12) before scaling."""
    remaining = torch.full((len(goal), 1), 1.0 - step / STEPS)
    return torch.cat([goal, place, remaining, torch.zeros(len(goal), 7)], dim=1)


def regret(policy: GaussianPolicy) -> float:
    """Mean squared distance of sampled actions from the best one."""
    batch = foresight(policy, torch.Generator().manual_seed(99), rounds=20)
    return -batch["next", "reward"][batch["next", "done"]].mean().item()


def train(algorithm: Algorithm, batches: int) -> tuple[GaussianPolicy, list[dict[str, float]]]:
    """A policy after so many batches of `foresight`, and the metrics of the updates."""
    torch.manual_seed(0)
    policy, generator = GaussianPolicy([32]), torch.Generator().manual_seed(0)
    learner = algorithm.learner(policy, 0.98)
    return policy, [learner.update(foresight(policy, generator)) for _ in range(batches)]


def one_step_rounds(reward: float, terminated: bool) -> TensorDict:
    """A batch (50, 10) in which every step ends a round, terminated or truncated, in the same state."""
    done = torch.ones(50, 10, 1, dtype=torch.bool)
    next_step = {
        "observation": torch.zeros(50, 10, 12),
        "reward": torch.full((50, 10, 1), reward),
        "terminated": done & terminated,
        "truncated": done & (not terminated),
        "done": done,
    }
    batch = {"observation": torch.zeros(50, 10, 12), "action": 0.3 * torch.randn(50, 10, 2), "next": next_step}
    return TensorDict(batch, [50, 10])


def check_resuming(algorithm: Algorithm) -> None:
    """A learner and a new one with the state of the first have equal metrics and weights after the next update."""
    torch.manual_seed(0)
    policy, generator = GaussianPolicy([8]), torch.Generator().manual_seed(0)
    learner = algorithm.learner(policy, 0.9)
    for _ in range(3):
        learner.update(foresight(policy, generator))
    assert is_checkpointable(learner.modules())
    states = {name: copy.deepcopy(module.state_dict()) for name, module in learner.modules().items()}
    policy_state, rng_state = copy.deepcopy(policy.state_dict()), torch.get_rng_state()
    batch = foresight(policy, generator)
    metrics = learner.update(batch.clone())

    torch.manual_seed(1)
    resumed_policy = GaussianPolicy([8])
    resumed = algorithm.learner(resumed_policy, 0.9)
    resumed_policy.load_state_dict(policy_state)
    for name, module in resumed.modules().items():
        module.load_state_dict(states[name])
    torch.set_rng_state(rng_state)
    assert resumed.update(batch.clone()) == metrics
    assert is_equal(policy.state_dict(), resumed_policy.state_dict())
    for name, module in learner.modules().items():
        assert is_equal(module.state_dict(), resumed.modules()[name].state_dict()), name


def is_checkpointable(modules: Mapping[str, nn.Module | Optimizer]) -> bool:
    """Whether the states are tensors that share no memory, as safetensors requires, under names without dots."""
    tensors = []
    for module in modules.values():
        state = module.state_dict()
        groups = [state] if isinstance(module, nn.Module) else state["state"].values()
        tensors += [tensor for group in groups for tensor in group.values()]
    storages = {tensor.untyped_storage().data_ptr() for tensor in tensors}
    return len(storages) == len(tensors) and not any("." in name for name in modules)


def is_equal(one: Any, other: Any) -> bool:
    """Whether two state dicts are equal, bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(is_equal(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(is_equal(*pair) for pair in zip(one, other, strict=True))
    return one == other


def test_delayed_rewards_are_learned():
    policy, metrics = train(PPOConfig(**SETTINGS), batches=20)
    assert regret(policy) < regret(GaussianPolicy([32])) / 6
    assert all(0 < m["kl"] < 0.2 for m in metrics)
    assert metrics[-1]["std"] < metrics[0]["std"] - 0.1
    assert metrics[-1]["critic_loss"] < metrics[0]["critic_loss"] / 20


@pytest.mark.parametrize(("terminated", "value"), [(True, 1.0), (False, 2.0)])
def test_truncated_rounds_bootstrap_the_value(terminated, value):
    """With a reward of 1 per step and a discount of one half, an endless round has the value 2."""
    torch.manual_seed(0)
    learner = PPOConfig(**SETTINGS).learner(GaussianPolicy([8]), gamma=0.5)
    for _ in range(25):
        learner.update(one_step_rounds(1.0, terminated))
    assert learner.critic(torch.zeros(12)).item() == pytest.approx(value, abs=0.1)


def test_entropy_coefficient_increases_the_std():
    stds = []
    for coefficient in (0.0, 0.1):
        _, metrics = train(PPOConfig(**{**SETTINGS, "entropy_coef": coefficient}), batches=8)
        stds.append(metrics[-1]["std"])
    assert stds[0] < stds[1] - 0.05


def test_resuming_is_exact():
    check_resuming(PPOConfig(**SETTINGS))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("clip_epsilon", 0),
        ("clip_epsilon", 2.0),
        ("epochs", 0),
        ("batch_size", 0),
        ("lr", -1.0),
        ("entropy_coef", -0.1),
        ("critic_coef", 0.0),
        ("max_grad_norm", 0.0),
        ("gae_lambda", 1.5),
    ],
)
def test_wrong_settings_are_named(field, value):
    with pytest.raises(ValueError, match=rf"algorithm\.{field} = {value} must be "):
        PPOConfig(**{**SETTINGS, field: value})


def test_yaml_configures_ppo():
    assert isinstance(ALGORITHMS.build(OmegaConf.load(CONF / "algorithm" / "ppo.yaml"), "algorithm"), PPOConfig)
