"""Where play, algorithm and league meet: a learner plays a line-up of opponents, generation after generation."""

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase

from airhockey_marl.checks import check_arrays, check_counts, check_numbers
from airhockey_marl.collecting import Crew
from airhockey_marl.guards import require_finite_parts, require_sound
from airhockey_marl.league import League, Lineup, Member
from airhockey_marl.learner import Learner
from airhockey_marl.match import Result, play_matches, sampled
from airhockey_marl.policy import GaussianPolicy
from airhockey_marl.samplers import Sampler, Standing
from airhockey_marl.seats import LEARNER, learner_view
from airhockey_marl.shaping import Shaping


class Practice:
    """One policy's learning: the learner sits at the left of each table, a line-up at the right.

    Args:
        crew: who plays the tables.
        policy: learns, on its own device; the tables are played on CPUs.
        gamma: discount per decision, for the shaping.
    """

    def __init__(self, crew: Crew, policy: GaussianPolicy, shaping: Shaping, gamma: float) -> None:
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        self.crew, self.policy, self.shaping, self.gamma = crew, policy, shaping, gamma
        self.device = next(policy.parameters()).device

    def generation(
        self, learner: Learner, opponents: Lineup, steps: int, strength: float
    ) -> tuple[dict[str, float], np.ndarray]:
        """Learn from `steps` steps against these opponents, with shaping of this strength (0 to 1).

        Returns:
            The metrics of the updates, averaged; and the goals scored and conceded against each of the line-up (k, 2).

        Raises:
            FloatingPointError: learning has gone wrong for good, see `guards`.
        """
        check_counts(self.crew.batch, steps=steps)
        check_numbers(0.0, at_most=1.0, strength=strength)
        self.crew.begin(opponents)  # a generation depends on nothing but the league, the learner, the random numbers
        history, goals = [], np.zeros((len(opponents.members), 2), dtype=np.int64)
        for _ in range(steps // self.crew.batch):
            with torch.no_grad():
                play = self.crew.play({name: tensor.cpu() for name, tensor in self.policy.state_dict().items()})
                goals += goals_of(play, len(opponents.members))
                view = learner_view(play, self.shaping, strength, self.gamma)
            history.append(learner.update(view.to(self.device)))
            require_sound(history[-1])
        self.crew.end()
        require_finite_parts({"policy": self.policy, **learner.parts()})
        return {name: float(np.mean([metrics[name] for metrics in history])) for name in history[0]}, goals


def goals_of(play: TensorDictBase, members: int) -> np.ndarray:
    """Goals scored and conceded (members, 2) by the learner, by blocks of tables: one for each of a line-up."""
    check_counts(members=members)
    reward = play["next", LEARNER, "reward"]
    if len(reward) % members:
        raise ValueError(f"members = {members} must share {len(reward)} tables evenly")
    reward = reward.reshape(members, -1)
    return torch.stack([(reward > 0).sum(1), (reward < 0).sum(1)], dim=1).numpy()


class Pool:
    """Whom a learner can meet: the generations of a league and some anchors; and how it has fared against each.

    Args:
        memory: what is left of a goal's weight in the estimated win rates a generation later.
    """

    def __init__(self, league: League, anchors: Sequence[str], sampler: Sampler, memory: float) -> None:
        check_numbers(0.0, at_most=1.0, memory=memory)
        self.league, self.anchors, self.sampler, self.memory = league, list(anchors), sampler, memory
        self.goals: dict[Member, list[float]] = {}  # scored and conceded, fading

    def standing(self) -> Standing:
        """What a sampler may look at."""
        goals = np.array([self.goals.get(member, [0.0, 0.0]) for member in self.members])
        return Standing(len(self.league), len(self.anchors), (goals[:, 0] + 1) / (goals.sum(axis=1) + 2))

    @property
    def members(self) -> list[Member]:
        return [*range(len(self.league)), *self.anchors]

    def draw(self, number: int, rng: np.random.Generator) -> Lineup:
        """A line-up of `number` members; one can be in it more than once."""
        check_counts(number=number)
        drawn = rng.choice(len(self.members), size=number, p=self.sampler.chances(self.standing()))
        return self.league.lineup([self.members[index] for index in sorted(drawn)])

    def remember(self, members: Sequence[Member], goals: np.ndarray) -> None:
        """Take note of goals scored and conceded (k, 2) against each of a line-up."""
        check_arrays(goals=(goals, f"{len(members)} 2"))
        self.goals = {member: [self.memory * count for count in counts] for member, counts in self.goals.items()}
        for member, counts in zip(members, goals.tolist(), strict=True):
            before = self.goals.get(member, [0.0, 0.0])
            self.goals[member] = [before[0] + counts[0], before[1] + counts[1]]


def results_against(
    player: GaussianPolicy, opponents: Lineup, rounds: int, seed: int, decision_ticks: int
) -> dict[Member, Result]:
    """A match of one policy against each of a line-up of different members, each side sampling as in training."""
    check_counts(rounds=rounds)
    check_counts(0, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    left, right = sampled(player, generator), sampled(opponents, generator)
    results = play_matches(left, right, len(opponents.members), rounds, 1, seed, decision_ticks=decision_ticks)
    return dict(zip(opponents.members, results, strict=True))
