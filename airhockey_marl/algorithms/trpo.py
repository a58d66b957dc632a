"""Trust region policy optimization (Schulman et al. 2015), the algorithm of section 3.2.2.

One update: the natural gradient by conjugate gradient on Fisher-vector products, the step length from the trust
region, a backtracking line search on the surrogate, then some epochs of regression for the critic. The policy is
any module that maps observations to (mean, STD) of a diagonal Gaussian.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from airhockey_marl.algorithms.advantages import ActorCriticLearner, advantages
from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.experiment.validation import check_counts, check_numbers, labeled


def conjugate_gradient(matvec: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10) -> Tensor:
    """Solve `matvec(x) = b` for a symmetric positive definite operator, from zeros, in at most `steps` steps.

    A squared norm of the residual below `tolerance` is accepted.
    """
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
        previous, norm2 = norm2, residual.dot(residual)
        direction = residual + norm2 / previous * direction
    return x


def log_prob(mean: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Log-density (...) of actions (..., 2) under diagonal Gaussians (..., 2), without the constant."""
    return (-0.5 * ((action - mean) / std) ** 2 - std.log()).sum(-1)


def kl_divergence(mean: Tensor, std: Tensor, new_mean: Tensor, new_std: Tensor) -> Tensor:
    """KL(old || new) of diagonal Gaussians in nats, averaged over the states: a scalar."""
    return (new_std.log() - std.log() + (std**2 + (mean - new_mean) ** 2) / (2 * new_std**2) - 0.5).sum(-1).mean()


class FisherVectorProduct:
    """The product v -> (F + damping) v, where F is the Hessian of the mean KL at the current parameters.

    For a Gaussian that Hessian is J^T M J, with J the Jacobian of (mean, STD) and M = diag(1/STD^2, 2/STD^2): no
    second derivative of the network is needed. J v is the derivative of w -> J^T w, whose graph is built once, so each
    product costs two backward passes. The KL is averaged over the states `observation` (n, 12).
    """

    def __init__(self, policy: nn.Module, observation: Tensor, damping: float) -> None:
        self.parameters = list(policy.parameters())
        self.damping = damping
        self.outputs = policy(observation)
        mean, std = (output.detach() for output in self.outputs)
        self.metric = (1 / std**2 / len(mean), 2 / std**2 / len(mean))
        self.cotangents = tuple(torch.zeros_like(mean, requires_grad=True) for _ in self.outputs)
        self.pullback = torch.autograd.grad(
            self.outputs, self.parameters, self.cotangents, create_graph=True, retain_graph=True
        )

    def __call__(self, vector: Tensor) -> Tensor:
        parts = vector.split([parameter.numel() for parameter in self.parameters])
        split = [part.view_as(parameter) for part, parameter in zip(parts, self.parameters, strict=True)]
        jacobian_v = torch.autograd.grad(self.pullback, self.cotangents, split, retain_graph=True)
        metric_v = [m * jv for m, jv in zip(self.metric, jacobian_v, strict=True)]
        product = torch.autograd.grad(self.outputs, self.parameters, metric_v, retain_graph=True)
        return torch.cat([part.reshape(-1) for part in product]) + self.damping * vector


@ALGORITHMS.register("trpo")
@dataclass(frozen=True)
class TRPOConfig:
    """The configuration of TRPO.

    Attributes:
        max_kl: radius of the trust region, in nats.
        cg_max_steps, damping: of the conjugate gradient.
        fisher_subsample: proportion of the batch's states on which the Fisher matrix is evaluated; it needs fewer than
            the gradient (Schulman et al. 2015, appendix C).
        line_search_max_iter, line_search_shrink: largest number of trials, and the factor of the step after each.
        gae_lambda: trade-off between bias (0) and variance (1) of the advantages (Schulman et al. 2016).
        critic_hidden, critic_inputs: of the critic, see `networks.Critic`.
        critic_epochs, critic_batch_size, critic_lr: of its regression on each batch, by Adam.
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
        check_numbers(above=0.0, **labeled(self, "algorithm", "max_kl", "critic_lr"))
        check_numbers(above=0.0, below=1.0, **labeled(self, "algorithm", "line_search_shrink"))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "fisher_subsample", "gae_lambda"))
        check_numbers(0.0, **labeled(self, "algorithm", "damping"))

    def learner(self, policy: nn.Module, gamma: float) -> "TRPOLearner":
        return TRPOLearner(self, policy, gamma)


class TRPOLearner(ActorCriticLearner):
    """A policy and its critic in training by TRPO."""

    def __init__(self, config: TRPOConfig, policy: nn.Module, gamma: float) -> None:
        super().__init__(config, policy, gamma)
        self.optimizer = torch.optim.Adam(self.critic.parameters(), lr=config.critic_lr, fused=True)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Train the policy, then the critic; see `base.Learner` for the batch.

        Returns:
            kl, gain of the surrogate, accepted fraction of the step (0 if none), mean STD, critic_loss.
        """
        advantage, target = advantages(self.critic, batch, self.gamma, self.config.gae_lambda)
        observation, action = batch["observation"].flatten(0, 1), batch["action"].flatten(0, 1)
        metrics = self.update_policy(observation, action, advantage.flatten())
        metrics["critic_loss"] = self.update_critic(observation, target.flatten(0, 1))
        return metrics

    def update_policy(self, observation: Tensor, action: Tensor, advantage: Tensor) -> dict[str, float]:
        """One natural gradient step within the trust region: observations (n, 12), actions (n, 2), advantages (n,)."""
        config, policy = self.config, self.policy
        parameters = list(policy.parameters())
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        mean, std = policy(observation)
        old_log_prob, old_mean, old_std = log_prob(mean, std, action).detach(), mean.detach(), std.detach()

        def surrogate(mean: Tensor, std: Tensor) -> Tensor:
            return ((log_prob(mean, std, action) - old_log_prob).exp() * advantage).mean()

        gradients = torch.autograd.grad(surrogate(mean, std), parameters)
        gradient = torch.cat([part.reshape(-1) for part in gradients])
        stride = round(1 / config.fisher_subsample)
        fisher = FisherVectorProduct(policy, observation[::stride], config.damping)
        direction = conjugate_gradient(fisher, gradient, config.cg_max_steps)
        curvature = direction.dot(fisher(direction))
        metrics = {"kl": 0.0, "gain": 0.0, "step": 0.0, "std": old_std.mean().item()}
        if not (torch.isfinite(curvature) and curvature > 0):
            return metrics

        full_step = direction * torch.sqrt(2 * config.max_kl / curvature)
        start = parameters_to_vector(parameters).detach()
        with torch.no_grad():
            for attempt in range(config.line_search_max_iter):
                fraction = config.line_search_shrink**attempt
                vector_to_parameters(start + fraction * full_step, parameters)
                mean, std = policy(observation)
                gain = surrogate(mean, std).item()  # 0 at the start, as the advantages have mean 0
                kl = kl_divergence(old_mean, old_std, mean, std).item()
                if gain > 0 and kl <= config.max_kl:
                    return metrics | {"kl": kl, "gain": gain, "step": fraction}
            vector_to_parameters(start, parameters)
        return metrics

    def update_critic(self, observation: Tensor, target: Tensor) -> float:
        """Epochs of regression on observations (n, 12) and targets (n, 1); returns the mean loss."""
        losses = []
        for _ in range(self.config.critic_epochs):
            for index in torch.randperm(len(observation)).split(self.config.critic_batch_size):
                loss = nn.functional.mse_loss(self.critic(observation[index]), target[index])
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                losses.append(loss.detach())
        return torch.stack(losses).mean().item()
