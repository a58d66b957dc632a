"""Demonstrations of users: the training data D^U of the user prediction model (section 3.2.3)."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

Samples = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Demonstrations:
    """D^U: observations and actions of users in games without guidance.

    All users have the same number of games, all games the same number of contiguous ticks.

    Attributes:
        observation: (users, games, ticks, 12), floating point and finite.
        action: (users, games, ticks, 2), of the same dtype and finite.

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
        """A copy on another device."""
        return Demonstrations(self.observation.to(device), self.action.to(device))

    def batches(self, size: int, generator: torch.Generator | None = None) -> Iterator[Samples]:
        """All ticks of all users once, shuffled, in batches (size, .); the last may be smaller."""
        observation, action = self.observation.flatten(0, 2), self.action.flatten(0, 2)  # (n, 12), (n, 2)
        for index in torch.randperm(len(action), generator=generator).split(size):
            index = index.to(action.device)
            yield observation[index], action[index]

    def pairs(self, block: int, generator: torch.Generator | None = None) -> Iterator[tuple[Samples, Samples]]:
        """D_demo and D_valid of all users, one pair per meta-step.

        Games are cut into blocks of contiguous ticks. Each block is used at most once, and the two blocks of a pair
        come from different games of the same user: a model is validated on another game than it has adapted to.
        The ticks of a game after its last full block are left out, and one block if their number is odd.

        Args:
            block: ticks of D_demo and of D_valid; 1K in the paper.
            generator: source of the random pairing.

        Yields:
            Two pairs of observation (users, block, 12) and action (users, block, 2).
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
        # Blocks in random order, but game by game. Two blocks half the list apart are then of different games, as no
        # game has more than half of the blocks.
        game = torch.rand(users, games, generator=generator).argsort(dim=1).double()  # rank of each game
        within = torch.rand(users, games, per_game, generator=generator, dtype=torch.float64)  # in [0, 1)
        order = (game[..., None] + within).flatten(1).argsort(dim=1).to(action.device)  # (users, blocks)
        half = games * per_game // 2
        user = torch.arange(users, device=action.device)
        for demo, valid in zip(order[:, :half].T, order[:, half : 2 * half].T, strict=True):  # each (users,)
            yield (observation[user, demo], action[user, demo]), (observation[user, valid], action[user, valid])
