"""All that a training run carries from one generation to the next, in one file, so that it can be resumed exactly."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from airhockey_marl.files import load_tensors, save_tensors


@dataclass
class Learner:
    """What learns, and the random numbers it learns by.

    Attributes:
        policy, critic, optimizer: trained in place; the optimizer is the critic's.
        rng: draws the opponents.
        streams: the tables' random numbers, arrays of uint64; together with torch's own they are all there are.
    """

    policy: nn.Module
    critic: nn.Module
    optimizer: torch.optim.Optimizer
    rng: np.random.Generator
    streams: Sequence[np.ndarray]

    def save(self, path: Path, generation: int) -> None:
        """Write the state after so many generations, whole."""
        tensors = {"torch_rng": torch.get_rng_state()}
        tensors |= {f"policy.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        tensors |= {f"critic.{name}": tensor for name, tensor in self.critic.state_dict().items()}
        for index, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": tensor for name, tensor in state.items()}
        for index, stream in enumerate(self.streams):
            tensors[f"streams.{index}"] = torch.from_numpy(stream.view(np.int64).copy())
        save_tensors(path, tensors, {"generation": generation, "rng": self.rng.bit_generator.state})

    def load(self, path: Path) -> int:
        """Take over the state that `save` wrote; returns the generations it has behind it.

        Raises:
            ValueError: the file is missing, broken or of another architecture.
        """
        tensors, facts = load_tensors(path)
        parts: dict[str, dict[str, torch.Tensor]] = {}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            parts.setdefault(part, {})[rest] = tensor
        if set(parts) != {"torch_rng", "policy", "critic", "optimizer", "streams"} or "generation" not in facts:
            raise ValueError(f"{path} is not the state of a training run")
        try:
            self.policy.load_state_dict(parts["policy"])
            self.critic.load_state_dict(parts["critic"])
        except RuntimeError as error:
            raise ValueError(f"{path} is of another architecture: {error}") from error
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in parts["optimizer"].items():
            index, _, what = name.partition(".")
            moments.setdefault(int(index), {})[what] = tensor
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self.rng.bit_generator.state = facts["rng"]
        for index, stream in enumerate(self.streams):
            stream[:] = parts["streams"][str(index)].numpy().view(np.uint64)
        torch.set_rng_state(parts["torch_rng"][""])
        return facts["generation"]
