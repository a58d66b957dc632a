"""Demonstrations of users: the training data D^U of the user prediction model (section 3.2.3), and their rounds.

Recorded play is observations (..., ticks, 12) and actions (..., ticks, 2).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import as_tensor
from guidance.simulated_users.arm import HAND_REACH

MIN_DEMONSTRATION_TICKS = 500  # 10 s; half a minute of play adapts as well as eight minutes

Samples = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Demonstrations:
    """D^U: observations and actions of users in games without guidance.

    All users have the same number of games, all games the same number of contiguous ticks. Arrays are converted.

    Attributes:
        observation: (users, games, ticks, 12), finite.
        action: (users, games, ticks, 2), of the same dtype and finite.

    Raises:
        ValueError: a shape or dtype is wrong, the two disagree, or a value is not finite.
    """

    observation: Tensor
    action: Tensor

    def __post_init__(self) -> None:
        for name, size in (("observation", 12), ("action", 2)):
            tensor = as_tensor(name, getattr(self, name), size, finite=True)
            if tensor.ndim != 4 or not tensor.numel():
                shape = tuple(tensor.shape)
                raise ValueError(f"{name}: shape {shape}, must be (users, games, ticks, {size}) and not empty")
            object.__setattr__(self, name, tensor)
        if self.action.shape[:3] != self.observation.shape[:3] or self.action.dtype != self.observation.dtype:
            raise ValueError(
                f"action: shape {tuple(self.action.shape)} and dtype {self.action.dtype}, must match observation: "
                f"{tuple(self.observation.shape)}, {self.observation.dtype}"
            )

    def __len__(self) -> int:
        return len(self.action)

    def to(self, target: str | torch.dtype) -> "Demonstrations":
        """The same on another device, or of another dtype."""
        return Demonstrations(self.observation.to(target), self.action.to(target))

    def batches(self, size: int, generator: torch.Generator | None = None) -> Iterator[Samples]:
        """All ticks of all users once, shuffled, in batches (size, .); the last may be smaller."""
        return _shuffled_batches(self.observation.flatten(0, 2), self.action.flatten(0, 2), size, generator)

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


@dataclass(frozen=True)
class Recordings:
    """D^U of recorded people: as `Demonstrations`, but for games of any number and length.

    Attributes:
        people: label -> pieces of play, each observation (ticks, 12) and action (ticks, 2), contiguous in time and
            finite. Arrays are converted.
    """

    people: Mapping[str, list[Samples]]

    def __post_init__(self) -> None:
        people = {}
        for label, own in self.people.items():
            names = f"{label}: observation", f"{label}: action"
            people[label] = [
                (as_tensor(names[0], x, 12, finite=True), as_tensor(names[1], y, 2, finite=True)) for x, y in own
            ]
        object.__setattr__(self, "people", people)

    def __len__(self) -> int:
        return len(self.people)

    def to(self, target: str | torch.dtype) -> "Recordings":
        """The same on another device, or of another dtype."""
        return self._map(lambda observation, action: (observation.to(target), action.to(target)))

    def ahead(self, seconds: float, table: TableSpec) -> "Recordings":
        """The same play with the action `seconds` after each tick, see `action_ahead`."""
        return self._map(lambda observation, action: (observation, action_ahead(observation, action, seconds, table)))

    def split(self, share: float) -> tuple["Recordings", "Recordings"]:
        """The play without the last `share` of each person's ticks, and these; a piece of both is cut in two."""
        parts: tuple[dict[str, list[Samples]], dict[str, list[Samples]]] = {}, {}
        for label, pieces in self.people.items():
            left = sum(len(action) for _, action in pieces)
            left -= round(share * left)
            for part in parts:
                part[label] = []
            for piece in pieces:
                length = min(left, len(piece[1]))
                left -= length
                for part, place in zip(parts, (slice(length), slice(length, None)), strict=True):
                    observation, action = (tensor[place] for tensor in piece)
                    part[label] += [(observation, action)] if len(action) else []
        return Recordings(parts[0]), Recordings(parts[1])

    def batches(self, size: int, generator: torch.Generator | None = None) -> Iterator[Samples]:
        """All ticks of all people once, shuffled, in batches (size, .); the last may be smaller."""
        observations, actions = zip(*(piece for own in self.people.values() for piece in own), strict=True)
        return _shuffled_batches(torch.cat(observations), torch.cat(actions), size, generator)

    def pairs(self, block: int, generator: torch.Generator | None = None) -> Iterator[tuple[Samples, Samples]]:
        """D_demo and D_valid of all people, one pair per meta-step: the blocks of a pair are of two pieces.

        As `Demonstrations.pairs`, with two differences: the person with the most blocks sets the number of meta-steps,
        and the others' blocks come again; a piece with more than half of a person's blocks is paired with itself.
        Everybody must have two blocks or more.
        """
        own = [_blocks(pieces, block) for pieces in self.people.values()]
        endless = [_endless_pairs(blocks, generator) for blocks in own]
        for _ in range(max(map(len, own)) // 2):
            demo, valid = zip(*map(next, endless), strict=True)  # a block per person each
            yield _stacked(demo), _stacked(valid)

    def _map(self, change: Callable[[Tensor, Tensor], Samples]) -> "Recordings":
        return Recordings({label: [change(*piece) for piece in pieces] for label, pieces in self.people.items()})


def _shuffled_batches(
    observation: Tensor, action: Tensor, size: int, generator: torch.Generator | None
) -> Iterator[Samples]:
    """Rows (n, 12) and (n, 2) once, shuffled, in batches of `size`."""
    for index in torch.randperm(len(action), generator=generator).split(size):
        index = index.to(action.device)
        yield observation[index], action[index]


def _stacked(samples: tuple[Samples, ...]) -> Samples:
    observations, actions = zip(*samples, strict=True)
    return torch.stack(observations), torch.stack(actions)


def _blocks(pieces: list[Samples], block: int) -> list[tuple[int, Samples]]:
    """The full blocks of one person's pieces, each with the number of its piece."""
    cut = ((number, zip(*(part.split(block) for part in piece), strict=True)) for number, piece in enumerate(pieces))
    return [(number, samples) for number, parts in cut for samples in parts if len(samples[1]) == block]


def _endless_pairs(
    blocks: list[tuple[int, Samples]], generator: torch.Generator | None
) -> Iterator[tuple[Samples, Samples]]:
    """Two blocks of one person at a time, each once before any comes again; ordered as in `Demonstrations.pairs`."""
    piece, half = torch.tensor([number for number, _ in blocks]), len(blocks) // 2
    while True:
        rank = torch.rand(int(piece.max()) + 1, generator=generator).argsort().double()
        within = torch.rand(len(blocks), generator=generator, dtype=torch.float64)
        order = (rank[piece] + within).argsort().tolist()
        yield from (
            (blocks[demo][1], blocks[valid][1])
            for demo, valid in zip(order[:half], order[half : 2 * half], strict=True)
        )


def round_starts(observation: Tensor, table: TableSpec) -> Tensor:
    """Boolean mask (...) of the observations (..., 12) that start a round: everything at rest at its start position."""
    rest = [-table.length / 4, 0.0, 0.0, 0.0, table.length / 4, 0.0, 0.0, 0.0, 0.0]  # both paddles, and the puck's x
    return (as_tensor("observation", observation, 12)[..., :9].float() == torch.tensor(rest)).all(dim=-1)


def hand_speed(observation: Tensor, action: Tensor, table: TableSpec) -> Tensor:
    """(..., ticks) m/s, the hand's mean speed in each tick; a round starts with the hand at its center."""
    starts = round_starts(observation, table)
    before = action.roll(1, dims=-2).masked_fill(starts[..., None], 0.0)
    return (action - before).norm(dim=-1) * HAND_REACH / table.tick


def action_ahead(observation: Tensor, action: Tensor, seconds: float, table: TableSpec) -> Tensor:
    """The action (..., ticks, 2) `seconds` after each tick, or the last of its round if that is sooner.

    Args:
        observation: (..., ticks, 12), contiguous in time; marks where rounds start.
        action: (..., ticks, 2).
    """
    starts, action = round_starts(observation, table), as_tensor("action", action, 2)
    ticks = starts.shape[-1]
    tick = torch.arange(ticks)
    last = torch.where(starts, tick - 1, ticks - 1).roll(-1, dims=-1)  # the last tick of a round, where one ends
    last[..., -1] = ticks - 1
    last = last.flip(-1).cummin(-1).values.flip(-1)
    then = torch.minimum(tick + round(seconds / table.tick), last)
    return action.gather(-2, then.unsqueeze(-1).expand_as(action))
