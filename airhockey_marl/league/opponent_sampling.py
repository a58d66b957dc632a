"""Who a learner meets: the chance of each member of the pool, past generations and scripted anchors.

A sampler is a rule; `league.Standing` is what it may look at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from airhockey_marl.experiment.registry import Registry
from airhockey_marl.experiment.validation import check_counts, check_numbers


class PoolStatistics(NamedTuple):
    """The pool as a learner finds it: the generations, oldest first, then the anchors.

    Attributes:
        generations, anchors: how many there are.
        win_rates: (generations + anchors,) estimated share of decided rounds that the learner wins against each;
            one half against somebody it has not met.
    """

    generations: int
    anchors: int
    win_rates: np.ndarray


class OpponentSampler(Protocol):
    """Gives each member of a pool its chance (generations + anchors,); the chances sum to 1."""

    def probabilities(self, standing: PoolStatistics) -> np.ndarray: ...


OPPONENT_SAMPLERS: Registry[type[OpponentSampler]] = Registry("opponent sampler")


@OPPONENT_SAMPLERS.register("latest")
@dataclass(frozen=True)
class Latest:
    """Always the newest generation."""

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        return np.eye(len(standing.win_rates))[standing.generations - 1]


@OPPONENT_SAMPLERS.register("delta_uniform")
@dataclass(frozen=True)
class DeltaUniform:
    """Uniform over the newest share (1 - delta) of all generations (Bansal et al. 2018, section 4.2).

    `delta` = 0 is uniform over all of them; 1 would be the latest alone.
    """

    delta: float

    def __post_init__(self) -> None:
        check_numbers(0.0, delta=self.delta)
        if not self.delta < 1:
            raise ValueError(f"delta = {self.delta} must be at least 0 and below 1")

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        generations = standing.generations
        oldest = min(int(self.delta * generations), generations - 1)
        chances = np.zeros(len(standing.win_rates))
        chances[oldest:generations] = 1 / (generations - oldest)
        return chances


@OPPONENT_SAMPLERS.register("scripted")
@dataclass(frozen=True)
class ScriptedOnly:
    """Uniform over the scripted anchors."""

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        if not standing.anchors:
            raise ValueError("league.anchors = [] must name at least one anchor for a sampler of anchors")
        return (np.arange(len(standing.win_rates)) >= standing.generations) / standing.anchors


@OPPONENT_SAMPLERS.register("pfsp")
@dataclass(frozen=True)
class PFSP:
    """Prioritized fictitious self-play (Vinyals et al. 2019): by how interesting a member is, from its win rate x.

    Attributes:
        weighting: "squared", (1 - x)^2: whoever wins against the learner; or "variance", x (1 - x): whoever is its equal.
    """

    weighting: str

    WEIGHTS = {"squared": lambda x: (1 - x) ** 2, "variance": lambda x: x * (1 - x)}  # noqa: RUF012 (never changed)

    def __post_init__(self) -> None:
        if self.weighting not in self.WEIGHTS:
            raise ValueError(f"weighting = {self.weighting!r} must be one of {', '.join(self.WEIGHTS)}")

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        weights = self.WEIGHTS[self.weighting](standing.win_rates) + 1e-6  # nobody is ever out of the question
        return weights / weights.sum()


@OPPONENT_SAMPLERS.register("mixture")
@dataclass(frozen=True)
class Mixture:
    """Each of several samplers has its share of the tables.

    Attributes:
        samplers, shares: as many of the one as of the other; shares need not sum to 1.
    """

    samplers: Sequence[OpponentSampler]
    shares: Sequence[float]

    def __post_init__(self) -> None:
        if len(self.samplers) != len(self.shares) or not self.shares or not all(share > 0 for share in self.shares):
            raise ValueError(f"shares = {list(self.shares)} must be {len(self.samplers)} numbers above 0")

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        weighted = [
            share * sampler.probabilities(standing) for sampler, share in zip(self.samplers, self.shares, strict=True)
        ]
        return np.asarray(sum(weighted)) / sum(self.shares)


@OPPONENT_SAMPLERS.register("curriculum")
@dataclass(frozen=True)
class Curriculum:
    """One sampler until a generation has been frozen, another from then on.

    Attributes:
        generation: the number of generations from which `then` has its say.
    """

    first: OpponentSampler
    then: OpponentSampler
    generation: int

    def __post_init__(self) -> None:
        check_counts(0, generation=self.generation)

    def probabilities(self, standing: PoolStatistics) -> np.ndarray:
        return (self.first if standing.generations < self.generation else self.then).probabilities(standing)
