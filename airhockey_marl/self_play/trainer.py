"""Where play, algorithm and league meet: a learner plays a line-up of opponents, generation after generation."""

import numpy as np
import torch
from tensordict import TensorDictBase

from airhockey_marl.algorithms.base import Learner
from airhockey_marl.algorithms.divergence import require_finite_modules, require_sound_metrics
from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.experiment.validation import check_counts, check_numbers
from airhockey_marl.league.league import OpponentBatch
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import LEARNER, RolloutWorkers, learner_batch


class SelfPlayTrainer:
    """One policy's learning: the learner sits at the left of each table, a line-up at the right.

    Args:
        crew: who plays the tables.
        policy: learns, on its own device; the tables are played on CPUs.
        gamma: discount per decision, for the shaping.
    """

    def __init__(self, crew: RolloutWorkers, policy: GaussianPolicy, shaping: RewardShaping, gamma: float) -> None:
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        self.crew, self.policy, self.shaping, self.gamma = crew, policy, shaping, gamma
        self.device = next(policy.parameters()).device

    def generation(
        self, learner: Learner, opponents: OpponentBatch, steps: int, strength: float
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
                goals += count_goals(play, len(opponents.members))
                view = learner_batch(play, self.shaping, strength, self.gamma)
            history.append(learner.update(view.to(self.device)))
            require_sound_metrics(history[-1])
        self.crew.end()
        require_finite_modules({"policy": self.policy, **learner.parts()})
        return {name: float(np.mean([metrics[name] for metrics in history])) for name in history[0]}, goals


def count_goals(play: TensorDictBase, members: int) -> np.ndarray:
    """Goals scored and conceded (members, 2) by the learner, by blocks of tables: one for each of a line-up."""
    check_counts(members=members)
    reward = play["next", LEARNER, "reward"]
    if len(reward) % members:
        raise ValueError(f"members = {members} must share {len(reward)} tables evenly")
    reward = reward.reshape(members, -1)
    return torch.stack([(reward > 0).sum(1), (reward < 0).sum(1)], dim=1).numpy()
