"""One generation of self-play: rollouts against a batch of opponents, and updates of the learner."""

from dataclasses import dataclass

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from airhockey_marl.algorithms.base import ALGORITHMS, Learner
from airhockey_marl.algorithms.divergence import require_finite_modules, require_sound_metrics
from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.envs.hand_arm import arm_from_config
from airhockey_marl.league.league import OpponentBatch
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.two_player_policy import LEARNER, learner_batch


@dataclass(frozen=True)
class SelfPlayTrainer:
    """Trains one policy, on the left of each table, against opponents on the right.

    Attributes:
        policy: trained in place by `learner`, on its own device.
        workers: play the tables, on CPUs.
        gamma: discount per decision.
        action_cost: see `reward_shaping.action_change`; in goals.
    """

    policy: GaussianPolicy
    learner: Learner
    workers: RolloutWorkers
    shaping: RewardShaping
    gamma: float
    action_cost: float = 0.0

    @classmethod
    def from_config(cls, cfg: DictConfig) -> "SelfPlayTrainer":
        """A new policy and all that trains it, from a configuration as `conf/train.yaml`."""
        policy = GaussianPolicy(cfg.hidden, cfg.inputs).to(cfg.compute)
        learner = ALGORITHMS.build(cfg.algorithm, "algorithm").learner(policy, cfg.gamma)
        env = {**cfg.env, "arm": arm_from_config(cfg.env.get("arm"))}
        workers = RolloutWorkers(CollectorConfig(**cfg.collector), env, cfg.seed, policy, cfg.batch)
        shaping = RewardShaping(cfg.shaping.position, cfg.shaping.velocity, cfg.shaping.shot, cfg.shaping.approach)
        return cls(policy, learner, workers, shaping, cfg.gamma, cfg.action_cost)

    def train_generation(
        self, opponents: OpponentBatch, steps: int, shaping_strength: float
    ) -> tuple[dict[str, float], np.ndarray]:
        """Train on `steps` steps, a multiple of the workers' batch; `shaping_strength` (0 to 1) scales the shaping.

        Returns:
            The mean metrics of the updates, and the goals scored and conceded against each opponent (k, 2).
        """
        device = next(self.policy.parameters()).device
        # every generation starts new rounds: it depends on league, learner and random states only, which are saved
        self.workers.start_rounds(opponents)
        history, goals = [], np.zeros((len(opponents.player_ids), 2), dtype=np.int64)
        for _ in range(steps // self.workers.batch):
            with torch.no_grad():
                data = self.workers.rollout({name: tensor.cpu() for name, tensor in self.policy.state_dict().items()})
                goals += count_goals(data, len(opponents.player_ids))
                batch = learner_batch(data, self.shaping, shaping_strength, self.gamma, self.action_cost)
            history.append(self.learner.update(batch.to(device)))
            require_sound_metrics(history[-1])
        self.workers.save_rng_states()
        require_finite_modules({"policy": self.policy, **self.learner.modules()})
        return {name: float(np.mean([metrics[name] for metrics in history])) for name in history[0]}, goals


def count_goals(data: TensorDictBase, opponents: int) -> np.ndarray:
    """Goals scored and conceded (opponents, 2) by the learner; each opponent plays a block of consecutive tables."""
    reward = data["next", LEARNER, "reward"].reshape(opponents, -1)
    return torch.stack([(reward > 0).sum(1), (reward < 0).sum(1)], dim=1).numpy()
