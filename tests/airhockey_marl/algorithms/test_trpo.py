"""TRPO: conjugate gradient, Fisher-vector product, trust region, and learning."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.func import functional_call
from torch.nn.utils import parameters_to_vector
from torchrl.objectives.value import GAE

from airhockey_marl.algorithms.advantages import advantages
from airhockey_marl.algorithms.trpo import FisherVectorProduct, TRPOConfig, conjugate_gradient, kl_divergence, log_prob
from airhockey_marl.players.networks import BODY_SCALE, Critic, GaussianPolicy

SETTINGS = {
    "max_kl": 0.02,
    "cg_max_steps": 10,
    "damping": 0.1,
    "fisher_subsample": 1.0,
    "line_search_max_iter": 10,
    "line_search_shrink": 0.7,
    "gae_lambda": 0.95,
    "critic_hidden": [32],
    "critic_inputs": "paddle",
    "critic_epochs": 3,
    "critic_batch_size": 250,
    "critic_lr": 1e-3,
}


def test_conjugate_gradient_solves_a_positive_definite_system():
    torch.manual_seed(0)
    root = torch.randn(20, 20, dtype=torch.float64)
    matrix, b = root @ root.T + torch.eye(20), torch.randn(20, dtype=torch.float64)
    solution = conjugate_gradient(lambda v: matrix @ v, b, steps=60, tolerance=1e-20)
    assert torch.allclose(solution, torch.linalg.solve(matrix, b), atol=1e-6)


def test_densities_and_divergence_agree_with_torch():
    torch.manual_seed(0)
    mean, new_mean, action = torch.randn(3, 50, 2, dtype=torch.float64)
    std, new_std = torch.rand(2, 50, 2, dtype=torch.float64) + 0.1
    old, new = torch.distributions.Normal(mean, std), torch.distributions.Normal(new_mean, new_std)
    constant = torch.log(torch.tensor(2 * torch.pi, dtype=torch.float64))
    assert torch.allclose(log_prob(mean, std, action) - constant, old.log_prob(action).sum(-1))
    expected = torch.distributions.kl_divergence(old, new).sum(-1).mean()
    assert torch.allclose(kl_divergence(mean, std, new_mean, new_std), expected)


def test_fisher_vector_product_is_the_hessian_of_the_kl():
    torch.manual_seed(0)
    policy, observation = GaussianPolicy([5]).double(), torch.randn(30, 12, dtype=torch.float64)
    names, values = zip(*policy.named_parameters(), strict=True)
    start = parameters_to_vector(values).detach()

    def kl_at(vector: torch.Tensor) -> torch.Tensor:
        parts = vector.split([value.numel() for value in values])
        named = {n: p.view_as(v) for n, p, v in zip(names, parts, values, strict=True)}
        mean, std = (out.detach() for out in policy(observation))
        return kl_divergence(mean, std, *functional_call(policy, named, (observation,)))

    hessian = torch.autograd.functional.hessian(kl_at, start)
    vector = torch.randn_like(start)
    product = FisherVectorProduct(policy, observation, damping=0.3)(vector)
    assert torch.allclose(product, hessian @ vector + 0.3 * vector, atol=1e-9)


def test_advantages_agree_with_torchrl():
    torch.manual_seed(0)
    critic, scaled = Critic([16]), torch.randn(30, 21, 12)
    done = torch.rand(30, 20, 1) < 0.1
    terminated = done & (torch.rand(30, 20, 1) < 0.5)
    next_step = {
        "observation": torch.where(done, torch.randn(30, 20, 12), scaled[:, 1:]),  # a round begins elsewhere
        "reward": torch.randn(30, 20, 1),
        "done": done,
        "terminated": terminated,
    }
    batch = TensorDict({"observation": scaled[:, :-1], "next": TensorDict(next_step, [30, 20])}, [30, 20])
    advantage, target = advantages(critic, batch, 0.98, 0.95)
    value = TensorDictModule(critic, in_keys=["observation"], out_keys=["state_value"])
    with torch.no_grad():
        expected = GAE(gamma=0.98, lmbda=0.95, value_network=value)(batch)
    assert torch.allclose(advantage, expected["advantage"], atol=1e-6)
    assert torch.allclose(target, expected["value_target"], atol=1e-6)


def bandit(policy: GaussianPolicy, generator: torch.Generator, rounds: int = 2000) -> TensorDict:
    """Rounds of one decision; the best action is half of the first two numbers of the observation."""
    scaled = torch.randn(rounds, 1, 12, generator=generator)
    observation = scaled * torch.tensor(BODY_SCALE * 3)
    with torch.no_grad():
        mean, std = policy(observation)
    action = mean + std * torch.randn(mean.shape, generator=generator)
    reward = -((action - 0.5 * scaled[..., :2]) ** 2).sum(-1, keepdim=True)
    done = torch.ones(rounds, 1, 1, dtype=torch.bool)
    next_step = {"observation": observation, "reward": reward, "done": done, "terminated": done, "truncated": ~done}
    return TensorDict(
        {"observation": observation, "action": action, "next": TensorDict(next_step, [rounds, 1])}, [rounds, 1]
    )


@pytest.mark.parametrize("fisher_subsample", [1.0, 0.25])
def test_learning_stays_in_the_trust_region(fisher_subsample):
    torch.manual_seed(0)
    policy = GaussianPolicy([32])
    learner, generator = (
        TRPOConfig(**SETTINGS | {"fisher_subsample": fisher_subsample}).learner(policy, 0.9),
        torch.Generator(),
    )
    first = bandit(policy, generator)["next", "reward"].mean()
    metrics = [learner.update(bandit(policy, generator)) for _ in range(30)]
    assert all(0 < m["kl"] <= SETTINGS["max_kl"] for m in metrics)
    assert bandit(policy, generator)["next", "reward"].mean() > first / 5
    assert metrics[-1]["critic_loss"] < metrics[0]["critic_loss"]


def test_equal_advantages_change_nothing():
    policy = GaussianPolicy([8])
    learner = TRPOConfig(**SETTINGS).learner(policy, 0.9)
    before = parameters_to_vector(policy.parameters()).clone()
    batch = bandit(policy, torch.Generator().manual_seed(0))
    metrics = learner.update_policy(batch["observation"].squeeze(1), batch["action"].squeeze(1), torch.ones(2000))
    assert metrics["step"] == 0.0
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


@pytest.mark.parametrize(
    ("field", "value"),
    [("max_kl", 0.0), ("cg_max_steps", 0), ("damping", -1.0), ("line_search_shrink", 1.0), ("fisher_subsample", 0.0)],
)
def test_wrong_settings_are_named(field, value):
    with pytest.raises(ValueError, match=f"algorithm.{field} = {value}"):
        TRPOConfig(**{**SETTINGS, field: value})
