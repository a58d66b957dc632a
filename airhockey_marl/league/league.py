"""The league of generation-based self-play: frozen generations of one policy (section 3.2.2; Bansal et al. 2018)."""

import copy
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.league.opponent_batch import OpponentBatch, PlayerId
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS


class League:
    """The frozen generations of one policy.

    Attributes:
        policy: the architecture; its own weights are not used.
        snapshots: the weights of each generation, copies that training does not change.
        hashes: of the weights of each generation, see `weights_hash`.
    """

    def __init__(self, policy: GaussianPolicy) -> None:
        self.policy = policy
        self.snapshots: list[TensorDict] = []
        self.hashes: list[str] = []

    def __len__(self) -> int:
        return len(self.snapshots)

    def add(self, policy: GaussianPolicy) -> str:
        """Freeze a copy of the policy as the next generation; returns the hash of its weights."""
        snapshot = policy_weights(policy).clone().lock_()
        self.snapshots.append(snapshot)
        self.hashes.append(weights_hash(snapshot))
        return self.hashes[-1]

    def generation(self, index: int) -> TensorDict:
        """The weights of one generation; negative indices count from the newest."""
        if not isinstance(index, int | np.integer) or not -len(self) <= index < len(self):
            raise ValueError(f"generation = {index} must be below {len(self)}, the number of generations")
        return self.snapshots[index]

    def prefix(self, last: int) -> "League":
        """The league when generation `last` was its newest; see `generation` for the index."""
        self.generation(last)
        league = League(self.policy)
        generations = last % len(self) + 1
        league.snapshots, league.hashes = self.snapshots[:generations], self.hashes[:generations]
        return league

    def player(self, index: int) -> GaussianPolicy:
        """One generation as a policy with its own copy of the weights; see `generation` for the index."""
        policy = copy.deepcopy(self.policy).requires_grad_(False)
        policy.load_state_dict(self.generation(index).flatten_keys(".").to_dict())
        return policy

    def opponent_batch(self, player_ids: Sequence[PlayerId]) -> OpponentBatch:
        """The players that share a batch of tables, equally many each."""
        for player in player_ids:
            if isinstance(player, str):
                SCRIPTED_PLAYERS.find(player, "scripted player")
        generations = [self.generation(player) for player in player_ids if not isinstance(player, str)]
        weights = torch.stack(generations).flatten_keys(".").contiguous().to_dict() if generations else None
        return OpponentBatch(self.policy, weights, player_ids)

    def stacked_weights(self) -> dict[str, Tensor]:
        """The weights of all generations by name, (generations, ...) each."""
        return dict(torch.stack(self.snapshots).contiguous().flatten_keys(".").items())

    def save(self, path: Path | str) -> None:
        """Write every generation to a safetensors file."""
        save_tensors(path, self.stacked_weights(), self.policy.architecture)

    @classmethod
    def load(cls, path: Path | str) -> "League":
        """Read a file written by `save`; a ValueError names the file and what is wrong with it."""
        tensors, metadata = load_tensors(path)
        try:
            return cls.from_stacked_weights(GaussianPolicy.from_architecture(metadata), tensors)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def from_stacked_weights(cls, policy: GaussianPolicy, tensors: dict[str, Tensor]) -> "League":
        """The league with the weights that `stacked_weights` returned; a ValueError if they do not fit the policy."""
        require_weights(policy, {name: tuple(tensor.shape[1:]) for name, tensor in tensors.items()})
        require_finite(tensors)
        league, counts = cls(policy), {name: len(tensor) if tensor.ndim else 0 for name, tensor in tensors.items()}
        generations = max(counts.values())
        for name, count in counts.items():
            if count != generations or not count:
                raise ValueError(f"{name} has {count} generations, must have {max(generations, 1)}")
        stacked = TensorDict(tensors, [generations]).unflatten_keys(".")
        league.snapshots = [snapshot.clone().lock_() for snapshot in stacked.unbind(0)]
        league.hashes = [weights_hash(snapshot) for snapshot in league.snapshots]
        return league


def policy_weights(policy: GaussianPolicy) -> TensorDict:
    """The policy's parameters, nested like its modules; not its buffers, which are constants of the architecture."""
    return TensorDict({name: tensor.detach().cpu() for name, tensor in policy.named_parameters()}).unflatten_keys(".")


def require_weights(policy: GaussianPolicy, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise a ValueError if names or shapes of weights are not those of the policy's parameters."""
    expected = {name: tuple(tensor.shape) for name, tensor in policy.named_parameters()}
    for name in sorted(set(expected) | set(shapes)):
        if expected.get(name) != shapes.get(name):
            raise ValueError(
                f"{name} is {shapes.get(name, 'missing')}, the model has {expected.get(name, 'no such tensor')}"
            )


def require_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raise a ValueError if a tensor is not floating point or has a value that is not finite."""
    for name, tensor in sorted(tensors.items()):
        if not tensor.is_floating_point():
            raise ValueError(f"{name} is {tensor.dtype}, must be floating point")
        if not tensor.isfinite().all():
            raise ValueError(f"{name} has {int((~tensor.isfinite()).sum())} values that are not finite, must have none")


def weights_hash(weights: TensorDict) -> str:
    """SHA-256 of the names, shapes and bytes of the weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.flatten_keys(".").items()):
        digest.update(f"{name}{tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
