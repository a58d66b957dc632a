"""The opponents a learner can meet, and how it has fared against each."""

from collections.abc import Sequence

import numpy as np

from airhockey_marl.experiment.validation import check_arrays, check_counts, check_numbers
from airhockey_marl.league.league import League, OpponentBatch, PlayerId
from airhockey_marl.league.opponent_sampling import OpponentSampler, PoolStatistics


class OpponentPool:
    """Whom a learner can meet: the generations of a league and some anchors; and how it has fared against each.

    Args:
        memory: what is left of a goal's weight in the estimated win rates a generation later.
    """

    def __init__(self, league: League, anchors: Sequence[str], sampler: OpponentSampler, memory: float) -> None:
        check_numbers(0.0, at_most=1.0, memory=memory)
        self.league, self.anchors, self.sampler, self.memory = league, list(anchors), sampler, memory
        self.goals: dict[PlayerId, list[float]] = {}  # scored and conceded, fading

    def standing(self) -> PoolStatistics:
        """What a sampler may look at."""
        goals = np.array([self.goals.get(member, [0.0, 0.0]) for member in self.members])
        return PoolStatistics(len(self.league), len(self.anchors), (goals[:, 0] + 1) / (goals.sum(axis=1) + 2))

    @property
    def members(self) -> list[PlayerId]:
        return [*range(len(self.league)), *self.anchors]

    def draw(self, number: int, rng: np.random.Generator) -> OpponentBatch:
        """A line-up of `number` members; one can be in it more than once."""
        check_counts(number=number)
        drawn = rng.choice(len(self.members), size=number, p=self.sampler.probabilities(self.standing()))
        return self.league.lineup([self.members[index] for index in sorted(drawn)])

    def remember(self, members: Sequence[PlayerId], goals: np.ndarray) -> None:
        """Take note of goals scored and conceded (k, 2) against each of a line-up."""
        check_arrays(goals=(goals, f"{len(members)} 2"))
        self.goals = {member: [self.memory * count for count in counts] for member, counts in self.goals.items()}
        for member, counts in zip(members, goals.tolist(), strict=True):
            before = self.goals.get(member, [0.0, 0.0])
            self.goals[member] = [before[0] + counts[0], before[1] + counts[1]]
