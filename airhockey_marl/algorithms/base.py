"""The interface of reinforcement learning algorithms: configurations, and the learners that they make."""

from collections.abc import Mapping
from typing import Protocol

from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer

from airhockey_marl.experiment.registry import Registry


class Learner(Protocol):
    """Trains one policy in place, batch after batch."""

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Train on a batch of transitions.

        Args:
            batch: (tables, steps), in order of time along `steps` (`two_player_policy.learner_batch`): observation
                (.., 12), action (.., 2), and under "next" the observation, the reward (.., 1), and done, terminated
                and truncated (.., 1).

        Returns:
            Metrics to log, by name.
        """
        ...

    def modules(self) -> Mapping[str, nn.Module | Optimizer]:
        """Everything but the policy that training changes: what a checkpoint must contain."""
        ...


class Algorithm(Protocol):
    """The configuration of an algorithm, a frozen dataclass made from `conf/algorithm/*.yaml`."""

    def learner(self, policy: nn.Module, gamma: float) -> Learner:
        """A learner for `policy`, observations to (mean, STD) of a diagonal Gaussian; `gamma` is per decision."""
        ...


ALGORITHMS: Registry[type[Algorithm]] = Registry(
    "algorithm", {name: f"airhockey_marl.algorithms.{name}" for name in ("trpo", "ppo", "sac")}, group="algorithm"
)
