"""Trust region policy optimization (Schulman et al. 2015), the algorithm of section 3.2.2.

One update: the natural gradient by conjugate gradient on Fisher-vector products, the step length from the trust
region, a backtracking line search on the surrogate, then some passes of regression for the critic. The policy is
any module that maps observations to (mean, STD) of a diagonal Gaussian.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from airhockey_marl.algorithms.advantages import advantages
from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.experiment.validation import check_counts, check_numbers, check_tensors, check_view, labeled
from airhockey_marl.players.networks import Critic


def conjugate_gradient(matvec: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10) -> Tensor:
    """Solve `matvec(x) = b` for a symmetric positive definite operator, from zeros, in at most `steps` steps."""
    check_tensors(b=(b, "n"))
    check_counts(steps=steps)
    check_numbers(0.0, tolerance=tolerance)
    x = torch.zeros_like(b)
    residual, direction = b.clone(), b.clone()
    norm2 = residual.dot(residual)
    for _ in range(steps):
        if norm2 < tolerance:
            break
        product = matvec(direction)
        length = norm2 / direction.dot(product)
        x += length * direction
        residual -= length * product
        before, norm2 = norm2, residual.dot(residual)
        direction = residual + norm2 / before * direction
    return x


def log_prob(mean: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Log-density of actions (..., 2) under the Gaussians (..., 2), without the constant: (...)."""
    check_tensors(mean=(mean, "... 2"), std=(std, "... 2"), action=(action, "... 2"))
    return (-0.5 * ((action - mean) / std) ** 2 - std.log()).sum(-1)


def kl_divergence(mean: Tensor, std: Tensor, new_mean: Tensor, new_std: Tensor) -> Tensor:
    """KL(old || new) of diagonal Gaussians, averaged over the states: a scalar."""
    check_tensors(mean=(mean, "... 2"), std=(std, "... 2"), new_mean=(new_mean, "... 2"), new_std=(new_std, "... 2"))
    return (new_std.log() - std.log() + (std**2 + (mean - new_mean) ** 2) / (2 * new_std**2) - 0.5).sum(-1).mean()


class FisherVectorProduct:
    """v -> (F + damping) v, where F is the Hessian of the mean KL at the present parameters.

    For a Gaussian that Hessian is J^T M J, with J the Jacobian of (mean, STD) and M = diag(1/STD^2, 2/STD^2): no
    second derivative of the network is needed. J v comes from differentiating w -> J^T w, whose graph is built
    once, so each product costs two backward passes.
    """

    def __init__(self, policy: nn.Module, observation: Tensor, damping: float) -> None:
        check_tensors(observation=(observation, "n k"))
        check_numbers(0.0, damping=damping)
        self.parameters = list(policy.parameters())
        self.size = sum(parameter.numel() for parameter in self.parameters)
        self.damping = damping
        self.outputs = policy(observation)
        mean, std = (output.detach() for output in self.outputs)
        self.metric = (1 / std**2 / len(mean), 2 / std**2 / len(mean))
        self.cotangents = tuple(torch.zeros_like(mean, requires_grad=True) for _ in self.outputs)
        self.pullback = torch.autograd.grad(
            self.outputs, self.parameters, self.cotangents, create_graph=True, retain_graph=True
        )

    def __call__(self, vector: Tensor) -> Tensor:
        check_tensors(self.parameters[0].device, vector=(vector, str(self.size)))
        split, start = [], 0
        for parameter in self.parameters:
            split.append(vector[start : start + parameter.numel()].view_as(parameter))
            start += parameter.numel()
        jacobian_v = torch.autograd.grad(self.pullback, self.cotangents, split, retain_graph=True)
        weighted = [m * jv for m, jv in zip(self.metric, jacobian_v, strict=True)]
        product = torch.autograd.grad(self.outputs, self.parameters, weighted, retain_graph=True)
        return torch.cat([part.reshape(-1) for part in product]) + self.damping * vector


@ALGORITHMS.register("trpo")
@dataclass(frozen=True)
class TRPOConfig:
    """The settings of TRPO.

    Attributes:
        max_kl: radius of the trust region, in nats.
        cg_max_steps, damping: of the conjugate gradient.
        fisher_subsample: share of the batch's states on which the Fisher matrix is evaluated; it needs fewer than the
            gradient does (Schulman et al. 2015, appendix C).
        line_search_max_iter, shrink: how often, and by how much, a step that fails is shortened.
        gae_lambda: trade-off between bias (0) and variance (1) of the advantages (Schulman et al. 2016).
        critic_hidden, critic_inputs: of the critic, see `networks.Critic`.
        critic_epochs, critic_batch_size, critic_lr: its regression, by Adam, on each batch.
    """

    max_kl: float
    cg_max_steps: int
    damping: float
    fisher_subsample: float
    line_search_max_iter: int
    line_search_shrink: float
    gae_lambda: float
    critic_hidden: Sequence[int]
    critic_inputs: str
    critic_epochs: int
    critic_batch_size: int
    critic_lr: float

    def __post_init__(self) -> None:
        counts = ("cg_max_steps", "line_search_max_iter", "critic_epochs", "critic_batch_size")
        check_counts(**labeled(self, "algorithm", *counts))
        check_numbers(above=0.0, **labeled(self, "algorithm", "max_kl", "line_search_shrink", "critic_lr"))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "fisher_subsample", "gae_lambda"))
        check_numbers(0.0, **labeled(self, "algorithm", "damping"))
        if not self.line_search_shrink < 1:
            raise ValueError(f"algorithm.shrink = {self.line_search_shrink} must be between 0 and 1")

    def learner(self, policy: nn.Module, gamma: float) -> "TRPOLearner":
        """Begin to train `policy`, observations to (mean, STD); `gamma` is per decision."""
        return TRPOLearner(self, policy, gamma)


class TRPOLearner:
    """TRPO at work on one policy: advantages, the policy's step, the critic's regression."""

    def __init__(self, settings: TRPOConfig, policy: nn.Module, gamma: float) -> None:
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        self.settings, self.policy, self.gamma = settings, policy, gamma
        self.critic = Critic(settings.critic_hidden, settings.critic_inputs).to(next(policy.parameters()).device)
        self.optimizer = torch.optim.Adam(self.critic.parameters(), lr=settings.critic_lr, fused=True)

    def parts(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """What a checkpoint must hold; see `learner.Learner`."""
        return {"critic": self.critic, "optimizer": self.optimizer}

    def update(self, view: TensorDictBase) -> dict[str, float]:
        """Improve the policy, then the critic, in place; see `learner.Learner` for the batch.

        Returns:
            What to log: kl, surrogate gain, accepted step (0 if none was), mean STD, critic loss.
        """
        check_view(view)
        advantage, target = advantages(self.critic, view, self.gamma, self.settings.gae_lambda)
        observation, action = view["observation"].flatten(0, 1), view["action"].flatten(0, 1)
        metrics = self.improve_policy(observation, action, advantage.flatten())
        metrics["critic_loss"] = self.fit_critic(observation, target.flatten(0, 1))
        return metrics

    def improve_policy(self, observation: Tensor, action: Tensor, advantage: Tensor) -> dict[str, float]:
        """One natural gradient step within the trust region: observations (n, 12), actions (n, 2), advantages (n,)."""
        check_tensors(observation=(observation, "n k"), action=(action, "n 2"), advantage=(advantage, "n"))
        settings, policy = self.settings, self.policy
        parameters = list(policy.parameters())
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        mean, std = policy(observation)
        old_log_prob, old_mean, old_std = log_prob(mean, std, action).detach(), mean.detach(), std.detach()

        def surrogate(mean: Tensor, std: Tensor) -> Tensor:
            return ((log_prob(mean, std, action) - old_log_prob).exp() * advantage).mean()

        parts = torch.autograd.grad(surrogate(mean, std), parameters)
        gradient = torch.cat([part.reshape(-1) for part in parts])
        every = round(1 / settings.fisher_subsample)
        fisher = FisherVectorProduct(policy, observation[::every], settings.damping)
        direction = conjugate_gradient(fisher, gradient, settings.cg_max_steps)
        curvature = direction.dot(fisher(direction))
        metrics = {"kl": 0.0, "gain": 0.0, "step": 0.0, "std": old_std.mean().item()}
        if not (torch.isfinite(curvature) and curvature > 0):
            return metrics

        full_step = direction * torch.sqrt(2 * settings.max_kl / curvature)
        start = parameters_to_vector(parameters).detach()
        with torch.no_grad():
            for attempt in range(settings.line_search_max_iter):
                fraction = settings.line_search_shrink**attempt
                vector_to_parameters(start + fraction * full_step, parameters)
                mean, std = policy(observation)
                gain = surrogate(mean, std).item()  # the surrogate is 0 at the start: advantages have mean 0
                kl = kl_divergence(old_mean, old_std, mean, std).item()
                if gain > 0 and kl <= settings.max_kl:
                    return metrics | {"kl": kl, "gain": gain, "step": fraction}
            vector_to_parameters(start, parameters)
        return metrics

    def fit_critic(self, observation: Tensor, target: Tensor) -> float:
        """Some passes of regression on observations (n, 12) and targets (n, 1); returns the mean loss."""
        check_tensors(observation=(observation, "n k"), target=(target, "n 1"))
        losses = []
        for _ in range(self.settings.critic_epochs):
            for index in torch.randperm(len(observation)).split(self.settings.critic_batch_size):
                loss = nn.functional.mse_loss(self.critic(observation[index]), target[index])
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                losses.append(loss.detach())
        return torch.stack(losses).mean().item()
