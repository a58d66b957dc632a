"""Frozen generations, samplers, and opponents that share the tables."""

import numpy as np
import pytest
import torch

from airhockey_marl.league import DeltaUniform, Latest, League, weights_hash
from airhockey_marl.match import confident, play_match, sampled
from airhockey_marl.policy import Critic, GaussianPolicy
from airhockey_marl.trpo import TRPO
from tests.test_trpo import SETTINGS, bandit


def league_of(generations: int) -> League:
    league = League(GaussianPolicy([8]))
    for seed in range(generations):
        torch.manual_seed(seed)
        league.add(GaussianPolicy([8]))
    return league


def test_training_never_moves_a_generation():
    policy, critic, algorithm = GaussianPolicy([8]), Critic([8]), TRPO(**SETTINGS)
    league, optimizer = League(GaussianPolicy([8])), algorithm.optimizer(critic)
    league.add(policy)
    for _ in range(3):
        algorithm.update(policy, critic, optimizer, bandit(policy, torch.Generator().manual_seed(0)))
        league.add(policy)
    assert len(set(league.hashes)) == 4
    assert [weights_hash(snapshot) for snapshot in league.snapshots] == league.hashes
    player = league.player(0)
    with torch.no_grad():
        player.head.bias += 1.0  # a player is a copy too
    assert weights_hash(league.generation(0)) == league.hashes[0]


def test_samplers():
    assert Latest().probabilities(4).tolist() == [0, 0, 0, 1]
    assert DeltaUniform(0.0).probabilities(4).tolist() == [0.25] * 4
    assert DeltaUniform(0.5).probabilities(4).tolist() == [0, 0, 0.5, 0.5]
    assert DeltaUniform(0.9).probabilities(1).tolist() == [1.0]
    with pytest.raises(ValueError, match="delta = 1"):
        DeltaUniform(1.0)


def test_opponents_answer_table_by_table_like_the_generations_they_are():
    league = league_of(6)
    opponents = league.opponents(DeltaUniform(0.0), 4, np.random.default_rng(0))
    observation = torch.randn(20, 1, 12)
    mean, std = opponents(observation)
    assert mean.shape == std.shape == (20, 1, 2)
    for table in range(20):
        expected = league.player(opponents.generations[table // 5])(observation[table])
        assert torch.allclose(mean[table], expected[0], atol=1e-6)
        assert torch.allclose(std[table], expected[1], atol=1e-6)


def test_a_league_survives_being_written_down():
    league = league_of(3)
    assert League.from_stacked(GaussianPolicy([8]), league.stacked()).hashes == league.hashes
    with pytest.raises(ValueError, match="the model has"):
        League.from_stacked(GaussianPolicy([9]), league.stacked())
    with pytest.raises(ValueError, match="is missing"):
        League.from_stacked(GaussianPolicy([8, 8]), league.stacked())


def test_a_generation_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="generation = 3 must be below 3"):
        league_of(3).generation(3)


def test_matches_are_fair_and_follow_from_the_seed():
    policy = league_of(1).player(0)

    def play(seed: int):
        generator = torch.Generator().manual_seed(seed)
        return play_match(sampled(policy, generator), sampled(policy, generator), 300, seed, round_seconds=10)

    assert play(1) == play(1)
    assert abs(play(1).win_rate - 0.5) < 0.15
    assert sum(play_match(confident(policy), confident(policy), 10, 0, round_seconds=0.1)) == 10
