"""The learner and its opponents acting at the same tables, and the learner's part of the collected data."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from airhockey_marl.algorithms.reward_shaping import RewardShaping, action_change
from airhockey_marl.league.league import TableSlice
from airhockey_marl.players.networks import GaussianPolicy

LEARNER, OPPONENT = "left", "right"  # either side observes the table from its own end: one side is enough to learn on


class GaussianSampling(nn.Module):
    """Actions (..., 2) sampled from a policy at observations (..., 12).

    Cheaper than a `ProbabilisticActor`: the algorithms compute log-probabilities later, for a whole batch at a time.

    Args:
        tables: the tables of the observations. Noise is drawn for all tables and that of the others is discarded, so
            that the noise at a table does not depend on the number of workers.
    """

    def __init__(self, policy: nn.Module, tables: TableSlice) -> None:
        super().__init__()
        self.policy, self.tables = policy, tables

    def forward(self, observation: Tensor) -> Tensor:
        mean, std = self.policy(observation)
        noise = torch.randn(self.tables.total, *mean.shape[1:], dtype=mean.dtype)
        return mean + std * noise[self.tables.first : self.tables.last]


class TwoPlayerPolicy(TensorDictSequential):
    """The policy of a worker's tables: a copy of the learner on the left, opponents on the right.

    Attributes:
        opponents: its `policy` can be replaced while a collector runs.
    """

    def __init__(self, learner: GaussianPolicy, tables: TableSlice) -> None:
        left, right = GaussianSampling(learner, tables), GaussianSampling(learner, tables)
        super().__init__(
            TensorDictModule(left, in_keys=[(LEARNER, "observation")], out_keys=[(LEARNER, "action")]),
            TensorDictModule(right, in_keys=[(OPPONENT, "observation")], out_keys=[(OPPONENT, "action")]),
        )
        self.learner, self.opponents = learner, right


def learner_batch(
    data: TensorDictBase, shaping: RewardShaping, shaping_strength: float, gamma: float, action_cost: float = 0.0
) -> TensorDictBase:
    """The learner's transitions (tables, steps): what `algorithms.base.Learner.update` takes.

    Their reward is that of the environment, plus the shaping, less `action_cost` times the `action_change`.
    """
    batch = data.select((LEARNER, "observation"), (LEARNER, "action"))[LEARNER].squeeze(-1)
    next_step = data["next"].select("done", "terminated", "truncated")
    next_step["observation"] = data["next", LEARNER, "observation"].squeeze(-2)
    next_step["reward"] = data["next", LEARNER, "reward"].squeeze(-2)
    if shaping_strength > 0:
        next_step["reward"] += shaping_strength * shaping.reward(
            batch["observation"], next_step["observation"], next_step["terminated"], gamma
        )
    if action_cost > 0:
        next_step["reward"] -= action_cost * action_change(batch["action"], next_step["done"])
    batch["next"] = next_step
    return batch
