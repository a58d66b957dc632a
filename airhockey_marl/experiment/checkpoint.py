"""All that a training run carries from one generation to the next, in one file, so that it can be resumed exactly."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.optim import Optimizer

from airhockey_marl.experiment.files import load_tensors, save_tensors


@dataclass
class Checkpoint:
    """What changes while a run learns, and the random numbers it learns by.

    Attributes:
        parts: by name, the policy and whatever else is trained in place (`learner.Learner.parts`).
        rng: draws the opponents.
        streams: the tables' random numbers, arrays of uint64; together with torch's own they are all there are.
    """

    parts: Mapping[str, nn.Module | Optimizer]
    rng: np.random.Generator
    streams: Sequence[np.ndarray]

    def save(self, path: Path, facts: Mapping[str, object]) -> None:
        """Write the state, whole; `facts` (any JSON) go with it."""
        tensors = {"torch_rng": torch.get_rng_state()}
        for part, owner in self.parts.items():
            tensors |= {f"{part}.{name}": tensor for name, tensor in _tensors_of(owner).items()}
        for index, stream in enumerate(self.streams):
            tensors[f"streams.{index}"] = torch.from_numpy(stream.view(np.int64).copy())
        save_tensors(path, tensors, {**facts, "rng": self.rng.bit_generator.state})

    def load(self, path: Path, kinds: Mapping[str, type]) -> dict[str, object]:
        """Take over the state that `save` wrote; returns the facts.

        Args:
            kinds: the facts that it must have, and of what type each is.

        Raises:
            ValueError: the file is missing, broken or of another run's making.
        """
        tensors, facts = load_tensors(path)
        of: dict[str, dict[str, torch.Tensor]] = {part: {} for part in (*self.parts, "streams", "torch_rng")}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            of.setdefault(part, {})[rest] = tensor
        if len(of) > len(self.parts) + 2 or not of["torch_rng"] or len(of["streams"]) != len(self.streams):
            raise ValueError(f"{path} is not the state of such a training run")
        for name, kind in kinds.items():
            if not isinstance(facts.get(name), kind) or isinstance(facts[name], bool):
                raise ValueError(f"{path}: {name} = {facts.get(name)!r} must be a {kind.__name__}")
        for part, owner in self.parts.items():
            _take_over(owner, of[part], f"{path}: {part}")
        try:
            self.rng.bit_generator.state = facts.pop("rng")
            for index, stream in enumerate(self.streams):
                stream[:] = of["streams"][str(index)].numpy().view(np.uint64)
            torch.set_rng_state(of["torch_rng"][""])
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise ValueError(f"{path} has random numbers of another kind: {error}") from error
        return facts


def _tensors_of(owner: nn.Module | Optimizer) -> dict[str, torch.Tensor]:
    """Everything that an optimizer or a module remembers, by name."""
    if isinstance(owner, nn.Module):
        return {name: tensor.cpu() for name, tensor in owner.state_dict().items()}
    memories = owner.state_dict()["state"]
    return {f"{index}.{name}": tensor.cpu() for index, memory in memories.items() for name, tensor in memory.items()}


def _take_over(owner: nn.Module | Optimizer, tensors: dict[str, torch.Tensor], what: str) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{what}.{name} has values that are not finite, must have none")
    if isinstance(owner, nn.Module):
        try:
            owner.load_state_dict(tensors)
        except RuntimeError as error:
            raise ValueError(f"{what} is of another architecture: {error}") from error
        return
    sizes = [parameter.shape for group in owner.param_groups for parameter in group["params"]]
    memories: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, memory = name.partition(".")
        if not index.isdecimal() or int(index) >= len(sizes) or tensor.shape not in ((), sizes[int(index)]):
            raise ValueError(f"{what} is of another architecture: {name} is {tuple(tensor.shape)}")
        memories.setdefault(int(index), {})[memory] = tensor
    owner.load_state_dict({**owner.state_dict(), "state": memories})
