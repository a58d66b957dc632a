"""TRPO's mathematics: the solver, the Fisher matrix, the trust region, and that it learns."""

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call
from torch.nn.utils import parameters_to_vector

from airhockey_marl.policy import Critic, GaussianPolicy
from airhockey_marl.trpo import TRPO, FisherVectorProduct, conjugate_gradient, kl_divergence, log_prob

SETTINGS = {
    "max_kl": 0.02,
    "cg_steps": 10,
    "damping": 0.1,
    "backtracks": 10,
    "shrink": 0.7,
    "critic_passes": 3,
    "critic_minibatch": 250,
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


def bandit(policy: GaussianPolicy, generator: torch.Generator) -> TensorDict:
    """The best action is half of the first two numbers that the policy sees."""
    seen = torch.randn(2000, 12, generator=generator)
    observation = seen * policy.scale
    with torch.no_grad():
        mean, std = policy(observation)
    action = mean + std * torch.randn(mean.shape, generator=generator)
    reward = -((action - 0.5 * seen[:, :2]) ** 2).sum(-1, keepdim=True)
    batch = {"observation": observation, "action": action, "advantage": reward, "value_target": reward}
    return TensorDict(batch, [2000])


def test_it_learns_and_stays_in_the_trust_region():
    torch.manual_seed(0)
    policy, critic, algorithm = GaussianPolicy([32]), Critic([32]), TRPO(**SETTINGS)
    optimizer, generator = algorithm.optimizer(critic), torch.Generator().manual_seed(0)
    first = bandit(policy, generator)["advantage"].mean()
    metrics = [algorithm.update(policy, critic, optimizer, bandit(policy, generator)) for _ in range(30)]
    assert all(0 < m["kl"] <= SETTINGS["max_kl"] for m in metrics)
    assert bandit(policy, generator)["advantage"].mean() > first / 5
    assert metrics[-1]["critic_loss"] < metrics[0]["critic_loss"]


def test_a_batch_that_teaches_nothing_changes_nothing():
    policy, critic, algorithm = GaussianPolicy([8]), Critic([8]), TRPO(**SETTINGS)
    before = parameters_to_vector(policy.parameters()).clone()
    batch = bandit(policy, torch.Generator().manual_seed(0))
    batch["advantage"] = torch.ones(2000, 1)
    metrics = algorithm.update(policy, critic, algorithm.optimizer(critic), batch)
    assert metrics["step"] == 0.0
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


@pytest.mark.parametrize(("field", "value"), [("max_kl", 0.0), ("cg_steps", 0), ("damping", -1.0), ("shrink", 1.0)])
def test_wrong_settings_are_named(field, value):
    with pytest.raises(ValueError, match=f"algorithm.{field} = {value}"):
        TRPO(**{**SETTINGS, field: value})
