"""Demonstrations of users: the training data D^U of the user prediction model (section 3.2.3)."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from airhockey_marl.experiment.validation import check_counts

Samples = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Demonstrations:
    """D^U: what users did in games without guidance, tick by tick.

    Every user has the same number of games, every game the same number of ticks; ticks are contiguous in time.

    Attributes:
        observation: (users, games, ticks, 12), floating point and finite.
        action: (users, games, ticks, 2), likewise, of the same dtype.

    Raises:
        ValueError: a shape or dtype is wrong, the two disagree, or a value is not finite.
    """

    observation: Tensor
    action: Tensor

    def __post_init__(self) -> None:
        for name, size in (("observation", 12), ("action", 2)):
            tensor = getattr(self, name)
            if not isinstance(tensor, Tensor):
                raise ValueError(f"{name}: {type(tensor).__name__}, must be a tensor")
            shape = tuple(tensor.shape)
            if tensor.ndim != 4 or tensor.shape[-1] != size or not tensor.numel():
                raise ValueError(f"{name}: shape {shape}, must be (users, games, ticks, {size}) and not empty")
            if not tensor.is_floating_point():
                raise ValueError(f"{name}: dtype {tensor.dtype}, must be floating point")
            if tensor.device != (other := getattr(self.action, "device", tensor.device)):
                raise ValueError(f"{name}: on {tensor.device}, must be on {other} as action")
            if not tensor.isfinite().all():
                raise ValueError(f"{name}: {int((~tensor.isfinite()).sum())} values are not finite, all must be")
        if self.action.shape[:3] != self.observation.shape[:3] or self.action.dtype != self.observation.dtype:
            raise ValueError(
                f"action: shape {tuple(self.action.shape)} and dtype {self.action.dtype}, must match observation: "
                f"{tuple(self.observation.shape)}, {self.observation.dtype}"
            )

    def to(self, device: str) -> "Demonstrations":
        """The same on another device."""
        return Demonstrations(self.observation.to(device), self.action.to(device))

    def batches(self, size: int, generator: torch.Generator | None = None) -> Iterator[Samples]:
        """All ticks of all users once, shuffled, in batches (size, .); the last may be smaller.

        Raises:
            ValueError: ``size`` is less than 1.
        """
        check_counts(size=size)
        observation, action = self.observation.flatten(0, 2), self.action.flatten(0, 2)  # (n, 12), (n, 2)
        for index in torch.randperm(len(action), generator=generator).split(size):
            index = index.to(action.device)
            yield observation[index], action[index]

    def pairs(self, block: int, generator: torch.Generator | None = None) -> Iterator[tuple[Samples, Samples]]:
        """D_demo and D_valid of all users, for one meta-step after the other.

        Games are cut into blocks of contiguous ticks. Each block is used at most once, and the two blocks of a pair
        come from different games of the same user, so that a model adapted to one is judged on play it has not seen.
        Left out are the ticks of a game after its last whole block and, of an odd number of blocks, one.

        Args:
            block: ticks of D_demo and of D_valid; 1K in the paper.
            generator: source of the random pairing.

        Yields:
            Two pairs of observation (users, block, 12) and action (users, block, 2).

        Raises:
            ValueError: there are fewer than two games a user, or ``block`` is not within 1 and the ticks of a game.
        """
        users, games, ticks = self.action.shape[:3]
        if games < 2:
            raise ValueError(f"games: {games}, must be at least 2 a user, one to adapt to and one to validate on")
        if not isinstance(block, int) or not 1 <= block <= ticks:
            raise ValueError(f"block: {block} ticks, must be within 1 and {ticks}, the ticks of a game")
        per_game = ticks // block

        def cut(tensor: Tensor) -> Tensor:  # (users, games, ticks, .) -> (users, blocks, block, .)
            return tensor[:, :, : per_game * block].unflatten(2, (per_game, block)).flatten(1, 2)

        observation, action = cut(self.observation), cut(self.action)
        # Blocks in random order, but game by game: whatever lies half the list apart is then from two games, for no
        # game owns more than half of the blocks.
        game = torch.rand(users, games, generator=generator).argsort(dim=1).double()  # a random rank for each
        within = torch.rand(users, games, per_game, generator=generator, dtype=torch.float64)  # in [0, 1)
        order = (game[..., None] + within).flatten(1).argsort(dim=1).to(action.device)  # (users, blocks)
        half = games * per_game // 2
        user = torch.arange(users, device=action.device)
        for demo, valid in zip(order[:, :half].T, order[:, half : 2 * half].T, strict=True):  # each (users,)
            yield (observation[user, demo], action[user, demo]), (observation[user, valid], action[user, valid])
