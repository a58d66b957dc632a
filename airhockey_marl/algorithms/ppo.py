"""Proximal policy optimization (Schulman et al. 2017), for comparison with the paper's TRPO.

One update: advantages from the critic (GAE), then some epochs of minibatches on the clipped surrogate and the critic's
squared error, both by one Adam. The loss is TorchRL's. The policy is any module that maps observations to (mean, STD)
of a diagonal Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from airhockey_marl.algorithms.advantages import ActorCriticLearner, advantages
from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.trpo import kl_divergence
from airhockey_marl.experiment.validation import check_counts, check_numbers, labeled


@ALGORITHMS.register("ppo")
@dataclass(frozen=True)
class PPOConfig:
    """The configuration of PPO.

    Attributes:
        clip_epsilon: largest distance of an action's probability ratio from 1 that the surrogate rewards.
        epochs, batch_size, lr: epochs on each batch, transitions per step of Adam, and its step size.
        entropy_coef: weight of the policy's entropy, in nats, in the objective.
        critic_coef: weight of the critic's squared error.
        max_grad_norm: largest norm of the gradient, of policy and critic together; a longer one is scaled to it.
        gae_lambda: trade-off between bias (0) and variance (1) of the advantages (Schulman et al. 2016).
        critic_hidden, critic_inputs: of the critic, see `networks.Critic`.
    """

    clip_epsilon: float
    epochs: int
    batch_size: int
    lr: float
    entropy_coef: float
    critic_coef: float
    max_grad_norm: float
    gae_lambda: float
    critic_hidden: Sequence[int]
    critic_inputs: str

    def __post_init__(self) -> None:
        check_counts(**labeled(self, "algorithm", "epochs", "batch_size"))
        check_numbers(above=0.0, **labeled(self, "algorithm", "lr", "critic_coef", "max_grad_norm"))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "clip_epsilon", "gae_lambda"))
        check_numbers(0.0, **labeled(self, "algorithm", "entropy_coef"))

    def learner(self, policy: nn.Module, gamma: float) -> "PPOLearner":
        return PPOLearner(self, policy, gamma)


class PPOLearner(ActorCriticLearner):
    """A policy and its critic in training by PPO."""

    def __init__(self, config: PPOConfig, policy: nn.Module, gamma: float) -> None:
        super().__init__(config, policy, gamma)
        self.loss = ClipPPOLoss(
            gaussian_actor(policy),
            TensorDictModule(self.critic, in_keys=["observation"], out_keys=["state_value"]),
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=config.entropy_coef > 0,
            entropy_coeff=config.entropy_coef,
            critic_coeff=config.critic_coef,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,  # no copies of the parameters: the loss is the modules' only user during an update
        )
        self.parameters = [*policy.parameters(), *self.critic.parameters()]
        # epsilon of the reference implementation, larger than Adam's default (Huang et al. 2022, detail 3)
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.lr, eps=1e-5, fused=True)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Train policy and critic; see `base.Learner` for the batch.

        Returns:
            kl of the policies before and after, mean STD before, critic_loss (mean squared error over the epochs).
        """
        advantage, target = advantages(self.critic, batch, self.gamma, self.config.gae_lambda)
        data = batch.select("observation", "action").reshape(-1)
        advantage, data["value_target"] = advantage.flatten(0, 1), target.flatten(0, 1)
        data["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        with torch.no_grad():
            mean, std = self.policy(data["observation"])
            data["action_log_prob"] = IndependentNormal(mean, std).log_prob(data["action"])
        losses = []
        for _ in range(self.config.epochs):
            for index in torch.randperm(len(data)).split(self.config.batch_size):
                losses.append(self._step(data[index]))
        with torch.no_grad():
            kl = kl_divergence(mean, std, *self.policy(data["observation"])).item()
        return {"kl": kl, "std": std.mean().item(), "critic_loss": torch.stack(losses).mean().item()}

    def _step(self, minibatch: TensorDictBase) -> torch.Tensor:
        losses = self.loss(minibatch)
        self.optimizer.zero_grad()
        sum(loss for name, loss in losses.items() if name.startswith("loss_")).backward()
        nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimizer.step()
        return losses["loss_critic"].detach() / self.config.critic_coef


def gaussian_actor(policy: nn.Module) -> ProbabilisticActor:
    """The TorchRL actor, "observation" to "action", of a policy, observations to (mean, STD)."""
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},  # validation takes a fifth of an update's time
    )
