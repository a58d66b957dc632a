"""Generation-based self-play (section 3.2.2, after Bansal et al. 2018): frozen generations, and line-ups of them."""

import copy
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.experiment.validation import check_counts, check_tensors
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS

PlayerId = int | str  # of a pool: a generation's number or an anchor's name


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
        if not isinstance(index, int | np.integer) or not -len(self) <= index < len(self):
            raise ValueError(f"generation = {index} must be below {len(self)}, the number of generations")
        return self.snapshots[index]

    def until(self, index: int) -> "League":
        """The league as it was when generation `index` was its newest; see `generation` for the index."""
        self.generation(index)
        league = League(self.policy)
        many = index % len(self) + 1
        league.snapshots, league.hashes = self.snapshots[:many], self.hashes[:many]
        return league

    def player(self, index: int) -> GaussianPolicy:
        """One generation as a policy of its own; see `generation` for the index."""
        policy = copy.deepcopy(self.policy).requires_grad_(False)
        policy.load_state_dict(self.generation(index).flatten_keys(".").to_dict())
        return policy

    def lineup(self, members: Sequence[PlayerId]) -> "OpponentBatch":
        """Seat these members together, each at as many tables as any other.

        Raises:
            ValueError: one of them is neither a generation of this league nor an anchor.
        """
        unknown = [member for member in members if isinstance(member, str) and member not in SCRIPTED_PLAYERS]
        if unknown:
            raise ValueError(f"anchor = {unknown[0]!r} must be one of {', '.join(SCRIPTED_PLAYERS)}")
        generations = [self.generation(member) for member in members if not isinstance(member, str)]
        weights = torch.stack(generations).flatten_keys(".").contiguous().to_dict() if generations else None
        return OpponentBatch(self.policy, weights, members)

    def stacked(self) -> dict[str, Tensor]:
        """All weights by name, (generations, ...) each: what a league's file holds."""
        return dict(torch.stack(self.snapshots).contiguous().flatten_keys(".").items())

    def save(self, path: Path | str) -> None:
        """Write every generation to a safetensors file."""
        save_tensors(path, self.stacked(), self.policy.architecture)

    @classmethod
    def load(cls, path: Path | str) -> "League":
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing, broken, or not of the shape it says it is.
        """
        tensors, facts = load_tensors(path)
        try:
            return cls.from_stacked(GaussianPolicy.from_architecture(facts), tensors)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def from_stacked(cls, policy: GaussianPolicy, tensors: dict[str, Tensor]) -> "League":
        """The league that `stacked` described.

        Raises:
            ValueError: the tensors are not those of this policy; names the first that differs.
        """
        require_weights(policy, {name: tuple(tensor.shape[1:]) for name, tensor in tensors.items()})
        require_finite(tensors)
        league, counts = cls(policy), {name: len(tensor) if tensor.ndim else 0 for name, tensor in tensors.items()}
        generations = max(counts.values())
        for name, count in counts.items():
            if count != generations or not count:
                raise ValueError(f"{name} is of {count} generations, must be of {max(generations, 1)}")
        stacked = TensorDict(tensors, [generations]).unflatten_keys(".")
        league.snapshots = [snapshot.clone().lock_() for snapshot in stacked.unbind(0)]
        league.hashes = [weights_hash(snapshot) for snapshot in league.snapshots]
        return league


def weights_of(policy: GaussianPolicy) -> TensorDict:
    """The policy's parameters, nested like its modules; not its buffers, which are constants of the architecture."""
    return TensorDict({name: tensor.detach().cpu() for name, tensor in policy.named_parameters()}).unflatten_keys(".")


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


def require_finite(tensors: Mapping[str, Tensor]) -> None:
    """Refuse weights that are no numbers to calculate with.

    Raises:
        ValueError: names the first tensor that is not floating point, or in which a value is not finite.
    """
    for name, tensor in sorted(tensors.items()):
        if not tensor.is_floating_point():
            raise ValueError(f"{name} is {tensor.dtype}, must be floating point")
        if not tensor.isfinite().all():
            raise ValueError(f"{name} has {int((~tensor.isfinite()).sum())} values that are not finite, must have none")


def weights_hash(weights: TensorDict) -> str:
    """SHA-256 over names, shapes and bytes of the weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.flatten_keys(".").items()):
        digest.update(f"{name}{tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class OpponentBatch(nn.Module):
    """k members that share n tables, n / k each: the generations in one batched forward pass, the anchors by script.

    Args:
        weights: of the generations among the members, (generations, ...) by name, in the order of the members.

    Attributes:
        members: (k,) who they are; table i is the seat of `members[i * k // n]`.
    """

    def __init__(
        self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None, members: Sequence[PlayerId]
    ) -> None:
        super().__init__()
        self.policy, self.weights, self.members = policy, weights, list(members)
        self.scripted = {
            place: SCRIPTED_PLAYERS[member] for place, member in enumerate(members) if isinstance(member, str)
        }
        self.learned = [place for place in range(len(members)) if place not in self.scripted]

    def part(self, first: int, last: int, of: int) -> "OpponentBatch":
        """The line-up that sits at tables `first` to before `last`, where this one sits at `of` tables.

        A member of whose tables only some are among them is there with these; one with many may be named repeatedly.

        Raises:
            ValueError: there are no such tables, or the members cannot share them evenly.
        """
        check_counts(0, first=first)
        check_counts(first + 1, last=last)
        check_counts(last, of=of)
        if of % len(self.members):
            raise ValueError(f"of = {of} tables, must be a multiple of {len(self.members)} members")
        each = of // len(self.members)
        block = math.gcd(each, first, last)  # tables that surely have the same member
        places = [table // each for table in range(first, last, block)]
        row_of = {place: row for row, place in enumerate(self.learned)}
        rows = [row_of[place] for place in places if place in row_of]
        weights = {name: tensor[rows] for name, tensor in self.weights.items()} if rows else None
        return OpponentBatch(self.policy, weights, [self.members[place] for place in places])

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (n, ..., 12) to mean and STD (n, ..., 2); n must be a multiple of k."""
        check_tensors(observation=(observation, "... 12"))
        if len(observation) % len(self.members):
            raise ValueError(
                f"observation: {len(observation)} tables, must be a multiple of {len(self.members)} members"
            )
        shape = (*observation.shape[:-1], -1)
        shared = observation.reshape(len(self.members), -1, observation.shape[-1])
        if not self.scripted:
            mean, std = self.policy.forward_stacked(self.weights, shared)
        else:
            mean, std = shared.new_empty((2, *shared.shape[:-1], 2))
            if self.learned:
                mean[self.learned], std[self.learned] = self.policy.forward_stacked(self.weights, shared[self.learned])
            for place, anchor in self.scripted.items():
                mean[place], std[place] = anchor(shared[place])
        return mean.reshape(shape), std.reshape(shape)
