"""Trust region policy optimization (Schulman et al. 2015), the algorithm of section 3.2.2.

One update: the natural gradient by conjugate gradient on Fisher-vector products, the step length from the trust
region, a backtracking line search on the surrogate, then some passes of regression for the critic. The policy is
any module that maps observations to (mean, STD) of a diagonal Gaussian.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters


def conjugate_gradient(matvec: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10) -> Tensor:
    """Solve `matvec(x) = b` for a symmetric positive definite operator, from zeros, in at most `steps` steps."""
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
    return (-0.5 * ((action - mean) / std) ** 2 - std.log()).sum(-1)


def kl_divergence(mean: Tensor, std: Tensor, new_mean: Tensor, new_std: Tensor) -> Tensor:
    """KL(old || new) of diagonal Gaussians, averaged over the states: a scalar."""
    return (new_std.log() - std.log() + (std**2 + (mean - new_mean) ** 2) / (2 * new_std**2) - 0.5).sum(-1).mean()


class FisherVectorProduct:
    """v -> (F + damping) v, where F is the Hessian of the mean KL at the present parameters.

    For a Gaussian that Hessian is J^T M J, with J the Jacobian of (mean, STD) and M = diag(1/STD^2, 2/STD^2): no
    second derivative of the network is needed. J v comes from differentiating w -> J^T w, whose graph is built
    once, so each product costs two backward passes.
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
        split, start = [], 0
        for parameter in self.parameters:
            split.append(vector[start : start + parameter.numel()].view_as(parameter))
            start += parameter.numel()
        jacobian_v = torch.autograd.grad(self.pullback, self.cotangents, split, retain_graph=True)
        weighted = [m * jv for m, jv in zip(self.metric, jacobian_v, strict=True)]
        product = torch.autograd.grad(self.outputs, self.parameters, weighted, retain_graph=True)
        return torch.cat([part.reshape(-1) for part in product]) + self.damping * vector


@dataclass(frozen=True)
class TRPO:
    """The settings of an update, and the update.

    Attributes:
        max_kl: radius of the trust region, in nats.
        cg_steps, damping: of the conjugate gradient.
        backtracks, shrink: how often, and by how much, a step that fails is shortened.
        critic_passes, critic_minibatch, critic_lr: regression of the critic, by Adam, on each batch.
    """

    max_kl: float
    cg_steps: int
    damping: float
    backtracks: int
    shrink: float
    critic_passes: int
    critic_minibatch: int
    critic_lr: float

    def __post_init__(self) -> None:
        for name in ("max_kl", "cg_steps", "backtracks", "critic_passes", "critic_minibatch", "critic_lr"):
            if not getattr(self, name) > 0:
                raise ValueError(f"algorithm.{name} = {getattr(self, name)} must be above 0")
        if not (self.damping >= 0 and 0 < self.shrink < 1):
            raise ValueError(
                f"algorithm.damping = {self.damping} must be at least 0, "
                f"algorithm.shrink = {self.shrink} between 0 and 1"
            )

    def optimizer(self, critic: nn.Module) -> torch.optim.Optimizer:
        """The optimizer that `update` drives the critic with; it lives as long as the run."""
        return torch.optim.Adam(critic.parameters(), lr=self.critic_lr)

    def update(
        self, policy: nn.Module, critic: nn.Module, optimizer: torch.optim.Optimizer, batch: TensorDictBase
    ) -> dict[str, float]:
        """Improve the policy, then the critic, in place.

        Args:
            batch: flat (n,), with observation (n, 12), action (n, 2), advantage (n, 1) and value_target (n, 1).

        Returns:
            What to log: kl, surrogate gain, accepted step (0 if none was), mean STD, critic loss.
        """
        metrics = self._improve_policy(policy, batch["observation"], batch["action"], batch["advantage"].squeeze(-1))
        metrics["critic_loss"] = self._fit_critic(critic, optimizer, batch["observation"], batch["value_target"])
        return metrics

    def _improve_policy(
        self, policy: nn.Module, observation: Tensor, action: Tensor, advantage: Tensor
    ) -> dict[str, float]:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        fisher = FisherVectorProduct(policy, observation, self.damping)
        mean, std = fisher.outputs
        old_log_prob, old_mean, old_std = log_prob(mean, std, action).detach(), mean.detach(), std.detach()

        def surrogate(mean: Tensor, std: Tensor) -> Tensor:
            return ((log_prob(mean, std, action) - old_log_prob).exp() * advantage).mean()

        parts = torch.autograd.grad(surrogate(mean, std), fisher.parameters, retain_graph=True)
        gradient = torch.cat([part.reshape(-1) for part in parts])
        direction = conjugate_gradient(fisher, gradient, self.cg_steps)
        curvature = direction.dot(fisher(direction))
        metrics = {"kl": 0.0, "gain": 0.0, "step": 0.0, "std": old_std.mean().item()}
        if not (torch.isfinite(curvature) and curvature > 0):
            return metrics

        full_step = direction * torch.sqrt(2 * self.max_kl / curvature)
        start = parameters_to_vector(fisher.parameters).detach()
        with torch.no_grad():
            for attempt in range(self.backtracks):
                fraction = self.shrink**attempt
                vector_to_parameters(start + fraction * full_step, fisher.parameters)
                mean, std = policy(observation)
                gain = surrogate(mean, std).item()  # the surrogate is 0 at the start: advantages have mean 0
                kl = kl_divergence(old_mean, old_std, mean, std).item()
                if gain > 0 and kl <= self.max_kl:
                    return metrics | {"kl": kl, "gain": gain, "step": fraction}
            vector_to_parameters(start, fisher.parameters)
        return metrics

    def _fit_critic(
        self, critic: nn.Module, optimizer: torch.optim.Optimizer, observation: Tensor, target: Tensor
    ) -> float:
        losses = []
        for _ in range(self.critic_passes):
            for index in torch.randperm(len(observation)).split(self.critic_minibatch):
                loss = nn.functional.mse_loss(critic(observation[index]), target[index])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(loss.detach())
        return torch.stack(losses).mean().item()
