"""Generalized advantage estimation (Schulman et al. 2016), and what learners with a critic have in common."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.objectives.value.functional import generalized_advantage_estimate

from airhockey_marl.players.networks import Critic


class ActorCriticLearner:
    """A policy and its critic in training.

    Args:
        config: of the algorithm, with `critic_hidden` and `critic_inputs`.
        gamma: discount per decision.
    """

    optimizer: Optimizer

    def __init__(self, config: Any, policy: nn.Module, gamma: float) -> None:
        self.config, self.policy, self.gamma = config, policy, gamma
        self.critic = Critic(config.critic_hidden, config.critic_inputs).to(next(policy.parameters()).device)

    def modules(self) -> dict[str, nn.Module | Optimizer]:
        return {"critic": self.critic, "optimizer": self.optimizer}


@torch.no_grad()
def advantages(critic: nn.Module, batch: TensorDictBase, gamma: float, gae_lambda: float) -> tuple[Tensor, Tensor]:
    """Generalized advantage estimates and regression targets of the critic, (tables, steps, 1) each.

    Args:
        batch: (tables, steps), see `base.Learner.update`.
    """
    next_step, value = batch["next"], critic(batch["observation"])
    # Within a round the value of the next observation is that of the next step: evaluating the critic at the other
    # next observations only halves the work.
    rollout_ends = next_step["done"].squeeze(-1).clone()
    rollout_ends[:, -1] = True
    next_value = value.roll(-1, dims=1)
    next_value[rollout_ends] = critic(next_step["observation"][rollout_ends])
    flags = {name: next_step[name] for name in ("reward", "done", "terminated")}
    return generalized_advantage_estimate(gamma, gae_lambda, value, next_value, **flags)
