"""Self-play training: goals by opponent, statistics of the pool, matches, and best responses."""

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDict

from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.evaluation.matches import FRAME_SKIP, match_options, play_match, play_opponents
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from airhockey_marl.league.opponent_pool import OpponentPool
from airhockey_marl.league.opponent_sampling import PFSP, ScriptedOnly
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import greedy
from airhockey_marl.self_play.best_response import best_response
from airhockey_marl.self_play.collectors import CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.trainer import SelfPlayTrainer, count_goals
from tests.airhockey_marl.league.test_league import league_of

TABLES = {"backend": "batched", "tables": 20, "round_seconds": 30.0, "frame_skip": 2}


class RecordingLearner:
    """Keeps the batches and does not train."""

    def __init__(self) -> None:
        self.batches = []

    def update(self, batch):
        self.batches.append(batch.clone())
        return {"batches": float(len(self.batches))}

    def modules(self):
        return {}


def test_goals_are_counted_for_each_opponent():
    torch.manual_seed(0)
    learner, policy = RecordingLearner(), GaussianPolicy([8])
    workers = RolloutWorkers(CollectorConfig(), TABLES, 0, policy, 2000)
    opponents = league_of(1).opponent_batch(["defender", 0, "random", "striker"])
    trainer = SelfPlayTrainer(policy, learner, workers, RewardShaping(0.3, 0.6, 0.4, 0.6), 0.98)
    metrics, goals = trainer.train_generation(opponents, 10_000, 0.0)
    workers.close()
    assert metrics == {"batches": 3.0} and len(learner.batches) == 5
    reward = torch.cat([batch["next", "reward"].reshape(4, -1) for batch in learner.batches], dim=1)
    assert goals.tolist() == [[int((row > 0).sum()), int((row < 0).sum())] for row in reward]
    assert goals[3, 1] > goals[2, 1] > 0  # the striker scores more than random actions


def test_goals_of_a_batch_by_blocks_of_tables():
    reward = torch.zeros(6, 4, 1, 1)
    reward[0, 1], reward[1, 2], reward[4, 3], reward[5, 0] = 1, 1, -1, 1
    data = TensorDict({"next": {"left": {"reward": reward}}}, [6, 4])
    assert count_goals(data, 3).tolist() == [[2, 0], [0, 0], [1, 1]]


def test_pool_estimates_win_rates_from_decayed_goals():
    pool = OpponentPool(league_of(2), ["striker"], PFSP("squared"), win_rate_decay=0.5)
    assert pool.statistics().win_rates.tolist() == [0.5] * 3
    pool.update([0, 0, "striker"], np.array([[3, 1], [5, 1], [0, 8]]))
    assert np.allclose(pool.statistics().win_rates, [9 / 12, 0.5, 0.1])
    pool.update([1], np.array([[2, 0]]))
    assert np.allclose(pool.statistics().win_rates, [5 / 7, 3 / 4, 1 / 6])
    player_ids = pool.sample(200, np.random.default_rng(0)).player_ids
    assert player_ids.count("striker") > 100 > player_ids.count(1)
    scripts = OpponentPool(league_of(2), ["striker"], ScriptedOnly(), 0.5)
    assert set(scripts.sample(5, np.random.default_rng(0)).player_ids) == {"striker"}


def test_matches_count_every_round_and_are_reproducible():
    league = league_of(2)
    opponents = league.opponent_batch([1, "striker", "random"])
    results = play_opponents(league.player(0), opponents, 10, seed=3, frame_skip=2)
    assert list(results) == [1, "striker", "random"]
    assert all(sum(result) == 10 for result in results.values())
    assert results == play_opponents(league.player(0), opponents, 10, seed=3, frame_skip=2)
    assert results["striker"].losses > results["striker"].wins


def test_matches_are_played_behind_the_arm_of_a_training():
    """An arm without strength leaves the paddles where they are."""
    policy, idle = league_of(1).player(0), lambda observation: torch.full((len(observation), 2), torch.nan)
    options = match_options(OmegaConf.create({"frame_skip": 3, "arm": {"max_force": 1e-6}}))
    played = play_match(greedy(policy), greedy(policy), 40, 0, **options)
    assert played == play_match(idle, idle, 40, 0, frame_skip=3) and sum(played) == 40
    assert played != play_match(greedy(policy), greedy(policy), 40, 0, frame_skip=3)
    assert match_options({}) == {"frame_skip": FRAME_SKIP, "arm": None}


@pytest.mark.parametrize("algorithm", ["trpo", "ppo", "sac"])
def test_best_response_restores_the_random_state(algorithm):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=[f"algorithm={algorithm}", "+preset/train=smoke"])
    before = torch.get_rng_state()
    league = League(GaussianPolicy(cfg.hidden))
    league.add(GaussianPolicy(cfg.hidden))
    torch.set_rng_state(before)
    first, second = (best_response(cfg, league, 0, 2, 10, seed=1) for _ in range(2))
    assert first == second and [steps for steps, _ in first] == [1000, 2000]
    assert torch.equal(torch.get_rng_state(), before)
