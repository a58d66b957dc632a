"""Two policies at one table, as TorchRL's collectors see them: who acts where, and what the learner lived through."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn

from airhockey_marl.checks import check_numbers
from airhockey_marl.shaping import Shaping

LEARNER, OPPONENT = "left", "right"  # seats are alike, so the learner always takes the left one


@dataclass(frozen=True)
class Share:
    """Of all tables, numbered from 0 to `of`, those from `first` to before `last`."""

    first: int
    last: int
    of: int


def actor(seat: str, policy: nn.Module, share: Share | None = None) -> TensorDictModule:
    """Let a policy act in a seat, sampling from its Gaussian; `share` says at which of all tables, see `Sampling`."""
    return TensorDictModule(Sampling(policy, share), in_keys=[(seat, "observation")], out_keys=[(seat, "action")])


class Sampling(nn.Module):
    """Actions (..., 2) drawn from what a policy says about observations (..., 12).

    A whole `ProbabilisticActor` would be slower: no algorithm here needs the log-probabilities of the moment, each
    works them out for a batch at a time.

    Args:
        share: draw for all tables and use what falls to these, so that a table's noise does not depend on who plays
            the others; None if these are all.
    """

    def __init__(self, policy: nn.Module, share: Share | None = None) -> None:
        super().__init__()
        self.policy, self.share = policy, share

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        mean, std = self.policy(observation)
        if self.share is None:
            return mean + std * torch.randn_like(mean)
        noise = torch.randn(self.share.of, *mean.shape[1:], dtype=mean.dtype)
        return mean + std * noise[self.share.first : self.share.last]


class Seat(nn.Module):
    """A place for a policy that can be given up to another while a collector runs."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.policy(observation)


def learner_view(data: TensorDictBase, shaping: Shaping, strength: float, gamma: float) -> TensorDictBase:
    """What one seat lived through: (tables, ticks) with observation (.., 12), action (.., 2), reward (.., 1), next."""
    check_numbers(0.0, strength=strength)
    check_numbers(0.0, at_most=1.0, gamma=gamma)
    view = data.select((LEARNER, "observation"), (LEARNER, "action"))[LEARNER].squeeze(-1)
    following = data["next"].select("done", "terminated", "truncated")
    following["observation"] = data["next", LEARNER, "observation"].squeeze(-2)
    following["reward"] = data["next", LEARNER, "reward"].squeeze(-2)
    if strength > 0:
        following["reward"] += strength * shaping.reward(
            view["observation"], following["observation"], following["terminated"], gamma
        )
    view["next"] = following
    return view
