"""PPO: that it learns, looks ahead, says what is wrong with its settings, and can be stopped and resumed exactly."""

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
    "minibatch": 700,
    "lr": 5e-3,
    "entropy_coef": 0.0,
    "critic_coef": 0.5,
    "max_grad_norm": 0.5,
    "gae_lambda": 0.95,
    "critic_hidden": [32],
    "critic_inputs": "paddle",
}
STEPS = 3  # of a round of `foresight`
SCALE = torch.tensor(BODY_SCALE * 3)  # of what a policy is used to see


def foresight(policy: GaussianPolicy, generator: torch.Generator, tables: int = 100, rounds: int = 7) -> TensorDict:
    """Rounds of three steps in which the first action alone counts, and the reward comes at the end.

    The first action, cut to [-1, 1] as at the table, chooses a place, and the reward is minus its squared distance
    from half of the first two numbers that were seen. What is seen: those, the place, and the steps to go.

    Returns:
        (tables, 3 rounds) what `learner.Learner.update` takes.
    """
    moments = []
    for _ in range(rounds):
        wish, place = torch.randn(tables, 2, generator=generator), torch.zeros(tables, 2)
        for step in range(STEPS):
            here = seen(wish, place, step) * SCALE
            with torch.no_grad():
                mean, std = policy(here)
            action = mean + std * torch.randn(mean.shape, generator=generator)
            place = action.clamp(-1.0, 1.0) if step == 0 else place
            over = torch.full((tables, 1), step == STEPS - 1)
            following = {
                "observation": seen(wish, place, step + 1) * SCALE,
                "reward": -((place - 0.5 * wish) ** 2).sum(-1, keepdim=True) * over,
                "terminated": over,
                "truncated": torch.zeros_like(over),
                "done": over,
            }
            moments.append(TensorDict({"observation": here, "action": action, "next": following}, [tables]))
    return torch.stack(moments, dim=1)


def seen(wish: torch.Tensor, place: torch.Tensor, step: int) -> torch.Tensor:
    """What is observed (n, 12), before scaling."""
    to_go = torch.full((len(wish), 1), 1.0 - step / STEPS)
    return torch.cat([wish, place, to_go, torch.zeros(len(wish), 7)], dim=1)


def regret(policy: GaussianPolicy) -> float:
    """Mean squared distance from the wish, of sampled actions."""
    view = foresight(policy, torch.Generator().manual_seed(99), rounds=20)
    return -view["next", "reward"][view["next", "done"]].mean().item()


def learned(algorithm: Algorithm, batches: int) -> tuple[GaussianPolicy, list[dict[str, float]]]:
    """A policy after so many batches of `foresight`, and what was logged."""
    torch.manual_seed(0)
    policy, generator = GaussianPolicy([32]), torch.Generator().manual_seed(0)
    learner = algorithm.learner(policy, 0.98)
    return policy, [learner.update(foresight(policy, generator)) for _ in range(batches)]


def always(reward: float, terminated: bool) -> TensorDict:
    """(50, 10) play in one place in which every step ends the round, by a goal or because it is cut off."""
    over = torch.ones(50, 10, 1, dtype=torch.bool)
    following = {
        "observation": torch.zeros(50, 10, 12),
        "reward": torch.full((50, 10, 1), reward),
        "terminated": over & terminated,
        "truncated": over & (not terminated),
        "done": over,
    }
    play = {"observation": torch.zeros(50, 10, 12), "action": 0.3 * torch.randn(50, 10, 2), "next": following}
    return TensorDict(play, [50, 10])


def check_resuming(algorithm: Algorithm) -> None:
    """Learn on in two learners, one of them new and given the state of the other: same metrics, same weights."""
    torch.manual_seed(0)
    policy, generator = GaussianPolicy([8]), torch.Generator().manual_seed(0)
    learner = algorithm.learner(policy, 0.9)
    for _ in range(3):
        learner.update(foresight(policy, generator))
    assert fit_for_a_checkpoint(learner.parts())
    kept = {name: copy.deepcopy(part.state_dict()) for name, part in learner.parts().items()}
    kept_policy, random_numbers = copy.deepcopy(policy.state_dict()), torch.get_rng_state()
    batch = foresight(policy, generator)
    metrics = learner.update(batch.clone())

    torch.manual_seed(1)
    policy_again = GaussianPolicy([8])
    again = algorithm.learner(policy_again, 0.9)
    policy_again.load_state_dict(kept_policy)
    for name, part in again.parts().items():
        part.load_state_dict(kept[name])
    torch.set_rng_state(random_numbers)
    assert again.update(batch.clone()) == metrics
    assert same(policy.state_dict(), policy_again.state_dict())
    for name, part in learner.parts().items():
        assert same(part.state_dict(), again.parts()[name].state_dict()), name


def fit_for_a_checkpoint(parts: Mapping[str, nn.Module | Optimizer]) -> bool:
    """Whether all there is are tensors that share no memory, as safetensors wants them, below names without dots."""
    tensors = []
    for part in parts.values():
        held = part.state_dict()
        groups = [held] if isinstance(part, nn.Module) else held["state"].values()
        tensors += [tensor for group in groups for tensor in group.values()]
    places = {tensor.untyped_storage().data_ptr() for tensor in tensors}
    return len(places) == len(tensors) and not any("." in name for name in parts)


def same(one: Any, other: Any) -> bool:
    """Whether two state dicts are equal, bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(same(*pair) for pair in zip(one, other, strict=True))
    return one == other


def test_it_learns_what_pays_later():
    policy, metrics = learned(PPOConfig(**SETTINGS), batches=20)
    assert regret(policy) < regret(GaussianPolicy([32])) / 6
    assert all(0 < m["kl"] < 0.2 for m in metrics)
    assert metrics[-1]["std"] < metrics[0]["std"] - 0.1
    assert metrics[-1]["critic_loss"] < metrics[0]["critic_loss"] / 20


@pytest.mark.parametrize(("terminated", "value"), [(True, 1.0), (False, 2.0)])
def test_a_round_that_is_cut_off_is_not_over(terminated, value):
    """With 1 a step and a discount of one half, two is what an endless round is worth."""
    torch.manual_seed(0)
    learner = PPOConfig(**SETTINGS).learner(GaussianPolicy([8]), gamma=0.5)
    for _ in range(25):
        learner.update(always(1.0, terminated))
    assert learner.critic(torch.zeros(12)).item() == pytest.approx(value, abs=0.1)


def test_the_entropy_coefficient_keeps_the_std_up():
    stds = []
    for coefficient in (0.0, 0.1):
        _, metrics = learned(PPOConfig(**{**SETTINGS, "entropy_coef": coefficient}), batches=8)
        stds.append(metrics[-1]["std"])
    assert stds[0] < stds[1] - 0.05


def test_it_can_be_resumed_exactly():
    check_resuming(PPOConfig(**SETTINGS))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("clip_epsilon", 0),
        ("clip_epsilon", 2.0),
        ("epochs", 0),
        ("minibatch", 0),
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


def test_the_yaml_is_a_ppo():
    assert isinstance(ALGORITHMS.build(OmegaConf.load(CONF / "algorithm" / "ppo.yaml"), "algorithm"), PPOConfig)
