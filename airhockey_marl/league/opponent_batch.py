"""Several opponents that share a batch of tables."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

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
