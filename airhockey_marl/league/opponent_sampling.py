"""Opponent sampling: rules for the probability with which a learner meets each player of the pool."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from airhockey_marl.experiment.registry import Registry
from airhockey_marl.experiment.validation import check_counts, check_numbers

MIN_WEIGHT = 1e-6  # of a player in PFSP, so that a player that always loses keeps a probability above 0


class PoolStatistics(NamedTuple):
    """What a sampler knows of the pool: the generations, oldest first, then the scripted players.

    Attributes:
        generations, scripted_players: their numbers.
        win_rates: (generations + scripted_players,) estimated win rates of the learner; one half against players that
            it has not met.
    """

    generations: int
    scripted_players: int
    win_rates: np.ndarray


class OpponentSampler(Protocol):
    """A rule of opponent sampling."""

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        """The probability of each player, (generations + scripted_players,)."""
        ...


OPPONENT_SAMPLERS: Registry[type[OpponentSampler]] = Registry("opponent sampler")


@OPPONENT_SAMPLERS.register("latest")
@dataclass(frozen=True)
class Latest:
    """Always the newest generation."""

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        return np.eye(len(statistics.win_rates))[statistics.generations - 1]


@OPPONENT_SAMPLERS.register("delta_uniform")
@dataclass(frozen=True)
class DeltaUniform:
    """Uniform over the newest fraction (1 - delta) of the generations (Bansal et al. 2018, section 4.2).

    `delta` = 0 is uniform over all of them; 1 would be the latest only.
    """

    delta: float

    def __post_init__(self) -> None:
        check_numbers(0.0, below=1.0, delta=self.delta)

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        generations = statistics.generations
        oldest = min(int(self.delta * generations), generations - 1)
        probabilities = np.zeros(len(statistics.win_rates))
        probabilities[oldest:generations] = 1 / (generations - oldest)
        return probabilities


@OPPONENT_SAMPLERS.register("scripted")
@dataclass(frozen=True)
class ScriptedOnly:
    """Uniform over the scripted players."""

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        if not statistics.scripted_players:
            raise ValueError("league.scripted_players = [] must name at least one player for the sampler 'scripted'")
        indices = np.arange(len(statistics.win_rates))
        return (indices >= statistics.generations) / statistics.scripted_players


@OPPONENT_SAMPLERS.register("pfsp")
@dataclass(frozen=True)
class PFSP:
    """Prioritized fictitious self-play (Vinyals et al. 2019): weights by the learner's win rate x against a player.

    Attributes:
        weighting: "squared", (1 - x)^2, favors the strongest players; "variance", x (1 - x), favors equal players.
    """

    weighting: str

    WEIGHTS = {"squared": lambda x: (1 - x) ** 2, "variance": lambda x: x * (1 - x)}  # noqa: RUF012 (never changed)

    def __post_init__(self) -> None:
        if self.weighting not in self.WEIGHTS:
            raise ValueError(f"weighting = {self.weighting!r} must be one of {', '.join(self.WEIGHTS)}")

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        weights = self.WEIGHTS[self.weighting](statistics.win_rates) + MIN_WEIGHT
        return weights / weights.sum()


@OPPONENT_SAMPLERS.register("mixture")
@dataclass(frozen=True)
class Mixture:
    """A mixture of samplers.

    Attributes:
        samplers, shares: a weight per sampler; the shares need not sum to 1.
    """

    samplers: Sequence[OpponentSampler]
    shares: Sequence[float]

    def __post_init__(self) -> None:
        if len(self.samplers) != len(self.shares) or not self.shares or not all(share > 0 for share in self.shares):
            raise ValueError(f"shares = {list(self.shares)} must be {len(self.samplers)} numbers above 0")

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        components = zip(self.samplers, self.shares, strict=True)
        weighted = [share * sampler.probabilities(statistics) for sampler, share in components]
        return np.asarray(sum(weighted)) / sum(self.shares)


@OPPONENT_SAMPLERS.register("curriculum")
@dataclass(frozen=True)
class Curriculum:
    """One sampler in a league of fewer than `generation` generations, another one after that."""

    first: OpponentSampler
    then: OpponentSampler
    generation: int

    def __post_init__(self) -> None:
        check_counts(0, generation=self.generation)

    def probabilities(self, statistics: PoolStatistics) -> np.ndarray:
        sampler = self.first if statistics.generations < self.generation else self.then
        return sampler.probabilities(statistics)
