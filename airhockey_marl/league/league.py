"""The league of generation-based self-play: frozen generations of one policy (section 3.2.2; Bansal et al. 2018)."""

import copy
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.experiment.validation import as_tensor
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS

PlayerId = int | str  # the number of a generation, or the name of a scripted player


@dataclass(frozen=True)
class TableSlice:
    """The tables from `first` to before `last`, out of `total` tables."""

    first: int
    last: int
    total: int


class OpponentBatch(nn.Module):
    """k players that share n tables, n / k each; the generations among them in one batched forward pass.

    Args:
        weights: of the generations among the players, (generations, ...) by name, in the order of the players; None
            without generations.

    Attributes:
        player_ids: (k,) table i is played by `player_ids[i * k // n]`.
    """

    def __init__(
        self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None, player_ids: Sequence[PlayerId]
    ) -> None:
        super().__init__()
        self.policy, self.weights, self.player_ids = policy, weights, list(player_ids)
        self.scripted = {i: SCRIPTED_PLAYERS[name] for i, name in enumerate(player_ids) if isinstance(name, str)}
        self.generation_indices = [i for i in range(len(player_ids)) if i not in self.scripted]

    def slice(self, tables: TableSlice) -> "OpponentBatch":
        """The opponents at some of the tables that this batch plays.

        Each of them must play equally many tables of the slice: one with more tables is listed repeatedly.
        """
        tables_per_player = tables.total // len(self.player_ids)
        block = math.gcd(tables_per_player, tables.first, tables.last)  # tables in a row that have the same player
        indices = [table // tables_per_player for table in range(tables.first, tables.last, block)]
        row_of = {index: row for row, index in enumerate(self.generation_indices)}
        rows = [row_of[index] for index in indices if index in row_of]
        weights = {name: tensor[rows] for name, tensor in self.weights.items()} if rows else None
        return OpponentBatch(self.policy, weights, [self.player_ids[index] for index in indices])

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (n, ..., 12) to mean and STD (n, ..., 2); n must be a multiple of k."""
        observation = as_tensor("observation", observation, 12, self.policy.head.weight.dtype)
        shape = (*observation.shape[:-1], -1)
        by_player = observation.reshape(len(self.player_ids), -1, observation.shape[-1])
        if not self.scripted:
            mean, std = self.policy.forward_stacked(self.weights, by_player)
        else:
            mean, std = by_player.new_empty((2, *by_player.shape[:-1], 2))
            if rows := self.generation_indices:
                mean[rows], std[rows] = self.policy.forward_stacked(self.weights, by_player[rows])
            for index, player in self.scripted.items():
                mean[index], std[index] = player(by_player[index])
        return mean.reshape(shape), std.reshape(shape)


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
        # the parameters, nested like the modules; not the buffers, which are constants of the architecture
        weights = TensorDict({name: tensor.detach().cpu() for name, tensor in policy.named_parameters()})
        snapshot = weights.unflatten_keys(".").clone().lock_()
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
        check_weights(policy, tensors, stacked=True)
        league, counts = cls(policy), {name: len(tensor) if tensor.ndim else 0 for name, tensor in tensors.items()}
        generations = max(counts.values())
        for name, count in counts.items():
            if count != generations or not count:
                raise ValueError(f"{name} has {count} generations, must have {max(generations, 1)}")
        stacked = TensorDict(tensors, [generations]).unflatten_keys(".")
        league.snapshots = [snapshot.clone().lock_() for snapshot in stacked.unbind(0)]
        league.hashes = [weights_hash(snapshot) for snapshot in league.snapshots]
        return league


def load_model(path: Path | str) -> tuple[GaussianPolicy, dict[str, Any]]:
    """The one model in a file, and the file's metadata.

    Raises:
        ValueError: the file is missing or broken, or its tensors do not fit the architecture it states.
    """
    tensors, facts = load_tensors(path)
    try:
        model = GaussianPolicy.from_architecture(facts)
        check_weights(model, tensors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    model.load_state_dict(tensors)
    return model.requires_grad_(False), facts


def load_policy(path: Path | str, generation: int | None = None) -> tuple[GaussianPolicy, dict[str, Any]]:
    """A generation of the league in a file, the newest if None, or the one model in it; and what is known of it.

    Raises:
        ValueError: the file is missing or broken, or has no such generation.
    """
    tensors, facts = load_tensors(path)
    if "head.bias" in tensors and tensors["head.bias"].ndim == 2:
        league, index = League.load(path), -1 if generation is None else generation
        return league.player(index), {**facts, "generation": index % len(league)}
    if generation is not None:
        raise ValueError(f"generation = {generation} must be null: {path} has one model")
    return load_model(path)


def check_weights(policy: GaussianPolicy, weights: Mapping[str, Tensor], stacked: bool = False) -> None:
    """Raise a ValueError if weights, `stacked` of several models, are not finite or do not fit the policy."""
    expected = {name: tuple(tensor.shape) for name, tensor in policy.named_parameters()}
    shapes = {name: tuple(tensor.shape[int(stacked) :]) for name, tensor in weights.items()}
    for name in sorted(set(expected) | set(shapes)):
        if expected.get(name) != shapes.get(name):
            raise ValueError(
                f"{name} is {shapes.get(name, 'missing')}, the model has {expected.get(name, 'no such tensor')}"
            )
    for name, tensor in sorted(weights.items()):
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
