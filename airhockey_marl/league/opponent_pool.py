"""The opponents a learner can meet, with its estimated win rate against each."""

from collections.abc import Sequence

import numpy as np

from airhockey_marl.league.league import League, OpponentBatch, PlayerId
from airhockey_marl.league.opponent_sampling import OpponentSampler, PoolStatistics


class OpponentPool:
    """The generations of a league and some scripted players, and the learner's goals for and against each.

    Args:
        win_rate_decay: factor, per generation, of a goal's weight in the estimated win rates.

    Attributes:
        goals: goals scored and conceded by player, weighted by `win_rate_decay`.
    """

    def __init__(
        self, league: League, scripted_players: Sequence[str], sampler: OpponentSampler, win_rate_decay: float
    ) -> None:
        self.league, self.scripted_players, self.sampler = league, list(scripted_players), sampler
        self.win_rate_decay = win_rate_decay
        self.goals: dict[PlayerId, list[float]] = {}

    @property
    def player_ids(self) -> list[PlayerId]:
        """The generations, oldest first, then the scripted players."""
        return [*range(len(self.league)), *self.scripted_players]

    def statistics(self) -> PoolStatistics:
        """The input of a sampler."""
        goals = np.array([self.goals.get(player, [0.0, 0.0]) for player in self.player_ids])
        # with one goal more on either side: one half where no goal has been scored
        win_rates = (goals[:, 0] + 1) / (goals.sum(axis=1) + 2)
        return PoolStatistics(len(self.league), len(self.scripted_players), win_rates)

    def sample(self, count: int, rng: np.random.Generator) -> OpponentBatch:
        """Draw `count` players with replacement."""
        player_ids, probabilities = self.player_ids, self.sampler.probabilities(self.statistics())
        indices = rng.choice(len(player_ids), size=count, p=probabilities)
        return self.league.opponent_batch([player_ids[index] for index in sorted(indices)])

    def update(self, player_ids: Sequence[PlayerId], goals: np.ndarray) -> None:
        """Add goals scored and conceded (k, 2) against k players, after decaying the earlier ones."""
        self.goals = {
            player: [self.win_rate_decay * count for count in counts] for player, counts in self.goals.items()
        }
        for player, (scored, conceded) in zip(player_ids, goals.tolist(), strict=True):
            previous = self.goals.get(player, [0.0, 0.0])
            self.goals[player] = [previous[0] + scored, previous[1] + conceded]
