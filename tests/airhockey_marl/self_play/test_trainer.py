"""Where play, algorithm and league meet: who is met, what is counted, and that practice teaches."""

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from tensordict import TensorDict

from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.evaluation.matches import play_each
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from airhockey_marl.league.opponent_pool import OpponentPool
from airhockey_marl.league.opponent_sampling import PFSP, ScriptedOnly
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.best_response import best_response
from airhockey_marl.self_play.collectors import CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.trainer import SelfPlayTrainer, count_goals
from tests.airhockey_marl.league.test_league import league_of

TABLES = {"backend": "batched", "tables": 20, "round_seconds": 30.0, "frame_skip": 2}


class Onlooker:
    """A learner that keeps what it is shown and learns nothing."""

    def __init__(self) -> None:
        self.views = []

    def update(self, view):
        self.views.append(view.clone())
        return {"seen": float(len(self.views))}

    def parts(self):
        return {}


def test_goals_are_counted_for_each_member_of_the_lineup():
    torch.manual_seed(0)
    learner, policy = Onlooker(), GaussianPolicy([8])
    crew = RolloutWorkers(CollectorConfig(), TABLES, 0, policy, 2000)
    lineup = league_of(1).lineup(["defender", 0, "random", "striker"])
    metrics, goals = SelfPlayTrainer(crew, policy, RewardShaping(0.3, 0.6, 0.4, 0.6), 0.98).generation(
        learner, lineup, 10_000, 0.0
    )
    crew.close()
    assert metrics == {"seen": 3.0} and len(learner.views) == 5
    reward = torch.cat([view["next", "reward"].reshape(4, -1) for view in learner.views], dim=1)
    assert goals.tolist() == [[int((row > 0).sum()), int((row < 0).sum())] for row in reward]
    assert goals[3, 1] > goals[2, 1] > 0  # a striker scores more than one who only fidgets


def test_goals_of_a_batch_by_blocks_of_tables():
    reward = torch.zeros(6, 4, 1, 1)
    reward[0, 1], reward[1, 2], reward[4, 3], reward[5, 0] = 1, 1, -1, 1
    play = TensorDict({"next": {"left": {"reward": reward}}}, [6, 4])
    assert count_goals(play, 3).tolist() == [[2, 0], [0, 0], [1, 1]]


def test_a_pool_remembers_how_the_learner_fared_and_forgets_slowly():
    pool = OpponentPool(league_of(2), ["striker"], PFSP("squared"), memory=0.5)
    assert pool.standing().win_rates.tolist() == [0.5] * 3
    pool.remember([0, 0, "striker"], np.array([[3, 1], [5, 1], [0, 8]]))
    assert np.allclose(pool.standing().win_rates, [9 / 12, 0.5, 0.1])
    pool.remember([1], np.array([[2, 0]]))
    assert np.allclose(pool.standing().win_rates, [5 / 7, 3 / 4, 1 / 6])
    drawn = pool.draw(200, np.random.default_rng(0)).members
    assert drawn.count("striker") > 100 > drawn.count(1)
    assert set(
        OpponentPool(league_of(2), ["striker"], ScriptedOnly(), 0.5).draw(5, np.random.default_rng(0)).members
    ) == {"striker"}


def test_matches_count_every_round_and_follow_from_the_seed():
    league = league_of(2)
    lineup = league.lineup([1, "striker", "random"])
    results = play_each(league.player(0), lineup, 10, seed=3, frame_skip=2)
    assert list(results) == [1, "striker", "random"]
    assert all(result.won + result.lost + result.undecided == 10 for result in results.values())
    assert results == play_each(league.player(0), lineup, 10, seed=3, frame_skip=2)
    assert results["striker"].lost > results["striker"].won


@pytest.mark.parametrize("algorithm", ["trpo", "ppo", "sac"])
def test_a_best_response_leaves_the_random_numbers_alone(algorithm):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=[f"algorithm={algorithm}", "+preset=smoke"])
    before = torch.get_rng_state()
    league = League(GaussianPolicy(cfg.hidden))
    league.add(GaussianPolicy(cfg.hidden))
    torch.set_rng_state(before)
    first, second = (best_response(cfg, league, 0, 2, 10, seed=1) for _ in range(2))
    assert first == second and [steps for steps, _ in first] == [1000, 2000]
    assert torch.equal(torch.get_rng_state(), before)
