"""What trains a policy, whichever algorithm it is: settings that make a learner, and a learner fed with batches."""

from collections.abc import Mapping
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer

from airhockey_marl.checks import check_tensors, kind_of


def check_view(view: TensorDictBase, *names: str) -> None:
    """Refuse what is no batch of play, see `Learner.update`.

    Args:
        names: what it must have beside observations and what comes next.

    Raises:
        ValueError: names what is absent, or of another shape or dtype.
    """
    if not isinstance(view, TensorDictBase):
        raise ValueError(f"view: {kind_of(view)}, must be a TensorDict")
    shapes = {"observation": "tables steps 12", "action": "tables steps 2"}
    wanted = {("observation",): shapes["observation"], **{(name,): shapes[name] for name in names}}
    wanted |= {("next", "observation"): "tables steps 12", ("next", "reward"): "tables steps 1"}
    flags = [("next", name) for name in ("done", "terminated")]
    if absent := [".".join(key) for key in (*wanted, *flags) if view.get(key, None) is None]:
        raise ValueError(f"view: has no {', '.join(absent)}")
    check_tensors(**{f"view.{'.'.join(key)}": (view[key], shape) for key, shape in wanted.items()})
    for key in flags:
        if view[key].dtype != torch.bool or view[key].shape != view["next", "reward"].shape:
            raise ValueError(f"view.{'.'.join(key)}: {kind_of(view[key])}, must be bools, one for each reward")


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
