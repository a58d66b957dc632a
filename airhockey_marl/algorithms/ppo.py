"""Proximal policy optimization (Schulman et al. 2017), for comparison with the paper's TRPO.

One update: advantages from the critic (GAE), then some passes over the batch in minibatches that raise the clipped
surrogate and fit the critic, both by one Adam. The loss is TorchRL's, the advantages are those of `trpo`.
The policy is any module that maps observations to (mean, STD) of a diagonal Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from airhockey_marl.algorithms.advantages import advantages
from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.trpo import kl_divergence
from airhockey_marl.experiment.validation import check_counts, check_numbers, check_view, labeled
from airhockey_marl.players.networks import Critic


@ALGORITHMS.register("ppo")
@dataclass(frozen=True)
class PPOConfig:
    """The settings of PPO.

    Attributes:
        clip_epsilon: how far from 1 the probability ratio of an action may go and still be rewarded.
        epochs, minibatch, lr: passes over each batch, transitions per step of Adam, and its step size.
        entropy_coef: weight of the policy's entropy, in nats, in the objective.
        critic_coef: weight of the critic's squared error.
        max_grad_norm: a longer gradient, of policy and critic together, is shortened to this.
        gae_lambda: trade-off between bias (0) and variance (1) of the advantages (Schulman et al. 2016).
        critic_hidden, critic_inputs: of the critic, see `networks.Critic`.
    """

    clip_epsilon: float
    epochs: int
    minibatch: int
    lr: float
    entropy_coef: float
    critic_coef: float
    max_grad_norm: float
    gae_lambda: float
    critic_hidden: Sequence[int]
    critic_inputs: str

    def __post_init__(self) -> None:
        check_counts(**labeled(self, "algorithm", "epochs", "minibatch"))
        check_numbers(above=0.0, **labeled(self, "algorithm", "lr", "critic_coef", "max_grad_norm"))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "clip_epsilon", "gae_lambda"))
        check_numbers(0.0, **labeled(self, "algorithm", "entropy_coef"))

    def learner(self, policy: nn.Module, gamma: float) -> "PPOLearner":
        """Begin to train `policy`, observations to (mean, STD); `gamma` is per decision."""
        return PPOLearner(self, policy, gamma)


class PPOLearner:
    """PPO at work on one policy: advantages, then epochs of minibatches for policy and critic."""

    def __init__(self, settings: PPOConfig, policy: nn.Module, gamma: float) -> None:
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        self.settings, self.policy = settings, policy
        self.critic = Critic(settings.critic_hidden, settings.critic_inputs).to(next(policy.parameters()).device)
        self.actor = gaussian_actor(policy)
        self.gamma = gamma
        self.loss = ClipPPOLoss(
            self.actor,
            TensorDictModule(self.critic, in_keys=["observation"], out_keys=["state_value"]),
            clip_epsilon=settings.clip_epsilon,
            entropy_bonus=settings.entropy_coef > 0,
            entropy_coeff=settings.entropy_coef,
            critic_coeff=settings.critic_coef,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,  # nothing else uses these modules meanwhile
        )
        self.trained = [*policy.parameters(), *self.critic.parameters()]
        # epsilon as in the reference implementation, larger than Adam's own (Huang et al. 2022, detail 3)
        self.optimizer = torch.optim.Adam(self.trained, lr=settings.lr, eps=1e-5, fused=True)

    def parts(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """What a checkpoint must hold; see `learner.Learner`."""
        return {"critic": self.critic, "optimizer": self.optimizer}

    def update(self, view: TensorDictBase) -> dict[str, float]:
        """Improve policy and critic, in place; see `learner.Learner` for the batch.

        Returns:
            What to log: kl of the old policy from the new one, mean STD before, critic loss (mean squared error over
            the epochs).
        """
        check_view(view)
        advantage, target = advantages(self.critic, view, self.gamma, self.settings.gae_lambda)
        batch = view.select("observation", "action").reshape(-1)
        advantage, batch["value_target"] = advantage.flatten(0, 1), target.flatten(0, 1)
        batch["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        with torch.no_grad():
            mean, std = self.policy(batch["observation"])
            batch["action_log_prob"] = IndependentNormal(mean, std).log_prob(batch["action"])
        losses = []
        for _ in range(self.settings.epochs):
            for index in torch.randperm(len(batch)).split(self.settings.minibatch):
                losses.append(self._step(batch[index]))
        with torch.no_grad():
            kl = kl_divergence(mean, std, *self.policy(batch["observation"])).item()
        return {"kl": kl, "std": std.mean().item(), "critic_loss": torch.stack(losses).mean().item()}

    def _step(self, batch: TensorDictBase) -> torch.Tensor:
        """One step of Adam on a minibatch; returns the critic's mean squared error on it."""
        losses = self.loss(batch)
        self.optimizer.zero_grad()
        sum(loss for name, loss in losses.items() if name.startswith("loss_")).backward()
        nn.utils.clip_grad_norm_(self.trained, self.settings.max_grad_norm)
        self.optimizer.step()
        return losses["loss_critic"].detach() / self.settings.critic_coef


def gaussian_actor(policy: nn.Module) -> ProbabilisticActor:
    """A policy, observations to (mean, STD), as TorchRL's losses want one: "observation" to "action"."""
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},  # a fifth of the time of an update
    )
