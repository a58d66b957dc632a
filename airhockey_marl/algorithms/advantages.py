"""Generalized advantage estimation (Schulman et al. 2016)."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

from airhockey_marl.experiment.validation import check_numbers, check_view


@torch.no_grad()
def advantages(critic: nn.Module, view: TensorDictBase, gamma: float, gae_lambda: float) -> tuple[Tensor, Tensor]:
    """Generalized advantage estimates (Schulman et al. 2016) and the critic's targets, (tables, steps, 1) each.

    Args:
        view: (tables, steps) as for `learner.Learner`. Where a round goes on, the next step's value is the value of
            the next observation; only the others are asked for apart, which halves the work.
    """
    check_view(view, acted=False)
    check_numbers(0.0, at_most=1.0, gamma=gamma, gae_lambda=gae_lambda)
    following, value = view["next"], critic(view["observation"])
    apart = following["done"].squeeze(-1).clone()
    apart[:, -1] = True
    next_value = value.roll(-1, dims=1)
    next_value[apart] = critic(following["observation"][apart])
    flags = {name: following[name] for name in ("reward", "done", "terminated")}
    return generalized_advantage_estimate(gamma, gae_lambda, value, next_value, **flags)
