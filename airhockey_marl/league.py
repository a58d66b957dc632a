"""Generation-based self-play (section 3.2.2, after Bansal et al. 2018): the frozen generations, and who meets whom."""

import copy
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from airhockey_marl.policy import GaussianPolicy


class Sampler(Protocol):
    """Chooses opponents: gives each generation of a pool its probability."""

    def probabilities(self, generations: int) -> np.ndarray: ...


@dataclass(frozen=True)
class Latest:
    """Always the newest generation."""

    def probabilities(self, generations: int) -> np.ndarray:
        return np.eye(generations)[-1]


@dataclass(frozen=True)
class DeltaUniform:
    """Uniform over the newest share (1 - delta) of all generations (Bansal et al. 2018, section 4.2).

    `delta` = 0 is uniform over all of them; 1 would be the latest alone.
    """

    delta: float

    def __post_init__(self) -> None:
        if not 0 <= self.delta < 1:
            raise ValueError(f"league.sampler.delta = {self.delta} must be in [0, 1)")

    def probabilities(self, generations: int) -> np.ndarray:
        oldest = min(int(self.delta * generations), generations - 1)
        chances = np.zeros(generations)
        chances[oldest:] = 1 / (generations - oldest)
        return chances


class League:
    """The frozen generations of one policy, stacked: generation g's weights are slice g of every tensor.

    Adding one copies its weights, so training never moves a generation; `hashes` says so.
    """

    def __init__(self, policy: GaussianPolicy) -> None:
        self.policy = policy  # the architecture; its own weights are not used
        self.snapshots: list[TensorDict] = []
        self.hashes: list[str] = []

    def __len__(self) -> int:
        return len(self.snapshots)

    def add(self, policy: GaussianPolicy) -> str:
        """Freeze a copy of the policy as the next generation; returns the hash of its weights."""
        snapshot = weights_of(policy).clone().lock_()
        self.snapshots.append(snapshot)
        self.hashes.append(weights_hash(snapshot))
        return self.hashes[-1]

    def generation(self, index: int) -> TensorDict:
        """The weights of one generation; negative numbers count from the newest.

        Raises:
            ValueError: there is no such generation.
        """
        if not -len(self) <= index < len(self):
            raise ValueError(f"generation = {index} must be below {len(self)}, the number of generations")
        return self.snapshots[index]

    def player(self, index: int) -> GaussianPolicy:
        """One generation as a policy of its own; see `generation` for the index."""
        policy = copy.deepcopy(self.policy).requires_grad_(False)
        policy.load_state_dict(self.generation(index).flatten_keys(".").to_dict())
        return policy

    def opponents(self, sampler: Sampler, number: int, rng: np.random.Generator) -> "Opponents":
        """Draw `number` generations and seat them together."""
        drawn = rng.choice(len(self), size=number, p=sampler.probabilities(len(self)))
        return Opponents(self.policy, torch.stack([self.snapshots[g] for g in drawn]), drawn)

    def stacked(self) -> dict[str, Tensor]:
        """All weights by name, (generations, ...) each: what a league's file holds."""
        return dict(torch.stack(self.snapshots).contiguous().flatten_keys(".").items())

    @classmethod
    def from_stacked(cls, policy: GaussianPolicy, tensors: dict[str, Tensor]) -> "League":
        """The league that `stacked` described.

        Raises:
            ValueError: the tensors are not those of this policy; names the first that differs.
        """
        require_weights(policy, {name: tuple(tensor.shape[1:]) for name, tensor in tensors.items()})
        league = cls(policy)
        generations = len(next(iter(tensors.values())))
        stacked = TensorDict(tensors, [generations]).unflatten_keys(".")
        league.snapshots = [snapshot.clone().lock_() for snapshot in stacked.unbind(0)]
        league.hashes = [weights_hash(snapshot) for snapshot in league.snapshots]
        return league


def weights_of(policy: GaussianPolicy) -> TensorDict:
    """The policy's parameters, nested like its modules; not its buffers, which are constants of the architecture."""
    return TensorDict({name: tensor.detach() for name, tensor in policy.named_parameters()}).unflatten_keys(".")


def require_weights(policy: GaussianPolicy, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse weights of other names or shapes than the policy's.

    Raises:
        ValueError: names the first that differs.
    """
    wanted = {name: tuple(tensor.shape) for name, tensor in policy.named_parameters()}
    for name in sorted(set(wanted) | set(shapes)):
        if wanted.get(name) != shapes.get(name):
            raise ValueError(
                f"{name} is {shapes.get(name, 'missing')}, the model has {wanted.get(name, 'no such tensor')}"
            )


def weights_hash(weights: TensorDict) -> str:
    """SHA-256 over names, shapes and bytes of the weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.flatten_keys(".").items()):
        digest.update(f"{name}{tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class Opponents(nn.Module):
    """k frozen generations that share n tables, n / k each, evaluated in one batched forward pass.

    Attributes:
        generations: (k,) which ones they are; table i faces `generations[i * k // n]`.
    """

    def __init__(self, policy: GaussianPolicy, weights: TensorDict, generations: np.ndarray) -> None:
        super().__init__()
        self.policy, self.generations = policy, generations
        self.weights = weights.flatten_keys(".").contiguous().to_dict()

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (n, ..., 12) to mean and STD (n, ..., 2); n must be a multiple of k."""
        k = len(self.generations)
        mean, std = self.policy.forward_each(self.weights, observation.reshape(k, -1, observation.shape[-1]))
        shape = (*observation.shape[:-1], -1)
        return mean.reshape(shape), std.reshape(shape)
