"""Checkpoints of training runs: everything that changes during training, in one file, for an exact resume."""

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
    """The state of a training run.

    Attributes:
        modules: by name, the policy and whatever else is trained in place (`Learner.modules`).
        rng: draws the opponents.
        rng_states: random number states of the tables, arrays of uint64. Together with `rng` and torch's global
            generator they are all the random numbers of a run.
    """

    modules: Mapping[str, nn.Module | Optimizer]
    rng: np.random.Generator
    rng_states: Sequence[np.ndarray]

    def save(self, path: Path, facts: Mapping[str, object]) -> None:
        """Write the state and `facts` (any JSON) atomically."""
        tensors = {"torch_rng": torch.get_rng_state()}
        for name, module in self.modules.items():
            tensors |= {f"{name}.{key}": tensor for key, tensor in state_tensors(module).items()}
        for index, state in enumerate(self.rng_states):
            tensors[f"streams.{index}"] = torch.from_numpy(state.view(np.int64).copy())
        save_tensors(path, tensors, {**facts, "rng": self.rng.bit_generator.state})

    def load(self, path: Path, fact_types: Mapping[str, type]) -> dict[str, object]:
        """Restore the state that `save` wrote, in place, and return the facts, which must have these types.

        A ValueError names a file that is missing, damaged or of a run with another architecture.
        """
        tensors, facts = load_tensors(path)
        groups: dict[str, dict[str, torch.Tensor]] = {name: {} for name in (*self.modules, "streams", "torch_rng")}
        for name, tensor in tensors.items():
            group, _, key = name.partition(".")
            groups.setdefault(group, {})[key] = tensor
        n_states = len(groups["streams"])
        if len(groups) > len(self.modules) + 2 or not groups["torch_rng"] or n_states != len(self.rng_states):
            raise ValueError(f"{path} is not the state of such a training run")
        for name, fact_type in fact_types.items():
            if not isinstance(facts.get(name), fact_type) or isinstance(facts[name], bool):
                raise ValueError(f"{path}: {name} = {facts.get(name)!r} must be a {fact_type.__name__}")
        for name, module in self.modules.items():
            _load_state(module, groups[name], f"{path}: {name}")
        try:
            self.rng.bit_generator.state = facts.pop("rng")
            for index, state in enumerate(self.rng_states):
                state[:] = groups["streams"][str(index)].numpy().view(np.uint64)
            torch.set_rng_state(groups["torch_rng"][""])
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise ValueError(f"{path} has random numbers of another kind: {error}") from error
        return facts


def state_tensors(module: nn.Module | Optimizer) -> dict[str, torch.Tensor]:
    """The tensors in the state of a module or an optimizer, by name, on the CPU."""
    if isinstance(module, nn.Module):
        return {name: tensor.cpu() for name, tensor in module.state_dict().items()}
    states = module.state_dict()["state"]
    return {f"{index}.{name}": tensor.cpu() for index, state in states.items() for name, tensor in state.items()}


def _load_state(module: nn.Module | Optimizer, tensors: dict[str, torch.Tensor], label: str) -> None:
    """Load what `state_tensors` returned; raises ValueError if values are not finite or shapes do not match."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{label}.{name} has values that are not finite, must have none")
    if isinstance(module, nn.Module):
        try:
            module.load_state_dict(tensors)
        except RuntimeError as error:
            raise ValueError(f"{label} is of another architecture: {error}") from error
        return
    shapes = [parameter.shape for group in module.param_groups for parameter in group["params"]]
    states: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, key = name.partition(".")
        if not index.isdecimal() or int(index) >= len(shapes) or tensor.shape not in ((), shapes[int(index)]):
            raise ValueError(f"{label} is of another architecture: {name} is {tuple(tensor.shape)}")
        states.setdefault(int(index), {})[key] = tensor
    module.load_state_dict({**module.state_dict(), "state": states})
