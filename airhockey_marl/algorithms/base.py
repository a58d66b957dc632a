"""What an algorithm is: settings that make a learner, and a learner that is fed with batches of play."""

from collections.abc import Mapping
from typing import Protocol

from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer

from airhockey_marl.experiment.registry import Registry


class Learner(Protocol):
    """Improves one policy, in place, batch after batch."""

    def update(self, view: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of play.

        Args:
            view: (tables, steps) what one seat lived through, in order of time along `steps` (`seats.learner_view`):
                observation (.., 12), action (.., 2), and under "next" the observation, the reward (.., 1), and
                done, terminated and truncated (.., 1).

        Returns:
            What to log, by name.
        """
        ...

    def parts(self) -> Mapping[str, nn.Module | Optimizer]:
        """All that it carries from one batch to the next beside the policy: what a checkpoint must hold."""
        ...


class Algorithm(Protocol):
    """An algorithm's settings, a frozen dataclass made from `conf/algorithm/*.yaml`."""

    def learner(self, policy: nn.Module, gamma: float) -> Learner:
        """Begin to train `policy`, observations to (mean, STD) of a diagonal Gaussian; `gamma` is per decision."""
        ...


ALGORITHMS: Registry[type[Algorithm]] = Registry(
    "algorithm",
    {name: f"airhockey_marl.algorithms.{name}" for name in ("trpo", "ppo", "sac")},
    group="algorithm",
)
