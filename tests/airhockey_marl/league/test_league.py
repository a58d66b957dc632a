"""Frozen generations, line-ups that share the tables, and matches."""

import pytest
import torch

from airhockey_marl.algorithms.trpo import TRPOConfig
from airhockey_marl.evaluation.matches import play_match
from airhockey_marl.league.league import League, weights_hash
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import greedy, stochastic
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
from tests.airhockey_marl.algorithms.test_trpo import SETTINGS, bandit


def league_of(generations: int) -> League:
    league = League(GaussianPolicy([8]))
    for seed in range(generations):
        torch.manual_seed(seed)
        league.add(GaussianPolicy([8]))
    return league


def test_training_never_moves_a_generation():
    policy = GaussianPolicy([8])
    learner, league = TRPOConfig(**SETTINGS).learner(policy, 0.9), League(GaussianPolicy([8]))
    league.add(policy)
    for _ in range(3):
        learner.update(bandit(policy, torch.Generator().manual_seed(0)))
        league.add(policy)
    assert len(set(league.hashes)) == 4
    assert [weights_hash(snapshot) for snapshot in league.snapshots] == league.hashes
    player = league.player(0)
    with torch.no_grad():
        player.head.bias += 1.0  # a player is a copy too
    assert weights_hash(league.generation(0)) == league.hashes[0]


@pytest.mark.parametrize("members", [[5, 0, 3, 3], ["striker", 2, "random", 4], ["defender"] * 4])
def test_a_lineup_answers_table_by_table_like_the_members_it_has(members):
    league = league_of(6)
    lineup = league.lineup(members)
    observation = torch.randn(20, 1, 12)
    mean, std = lineup(observation)
    assert mean.shape == std.shape == (20, 1, 2)
    for table in range(20):
        member = members[table // 5]
        player = SCRIPTED_PLAYERS[member] if isinstance(member, str) else league.player(member)
        expected = player(observation[table])
        assert torch.allclose(mean[table], expected[0], atol=1e-6)
        assert torch.allclose(std[table], expected[1], atol=1e-6)


def test_members_that_are_not_there_are_named():
    with pytest.raises(ValueError, match="anchor = 'goalie' must be one of random, defender, striker"):
        league_of(2).lineup([0, "goalie"])
    with pytest.raises(ValueError, match="generation = 7 must be below 2"):
        league_of(2).lineup([7, "random"])


def test_a_league_survives_being_written_down():
    league = league_of(3)
    assert League.from_stacked(GaussianPolicy([8]), league.stacked()).hashes == league.hashes
    with pytest.raises(ValueError, match="the model has"):
        League.from_stacked(GaussianPolicy([9]), league.stacked())
    with pytest.raises(ValueError, match="is missing"):
        League.from_stacked(GaussianPolicy([8, 8]), league.stacked())


def test_a_league_is_read_from_its_file_and_cut_short(tmp_path):
    league = League(GaussianPolicy([8], "paddle"))
    for seed in range(3):
        torch.manual_seed(seed)
        league.add(GaussianPolicy([8], "paddle"))
    league.save(tmp_path / "league.safetensors")
    read = League.load(tmp_path / "league.safetensors")
    assert read.hashes == league.hashes and read.policy.inputs.origin == "paddle"
    assert read.until(1).hashes == league.hashes[:2] and read.until(-1).hashes == league.hashes
    observation = torch.randn(5, 12)
    assert torch.equal(read.player(2)(observation)[0], league.player(2)(observation)[0])


def test_a_generation_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="generation = 3 must be below 3"):
        league_of(3).generation(3)


def test_matches_are_fair_and_follow_from_the_seed():
    policy = league_of(1).player(0)

    def play(seed: int):
        generator = torch.Generator().manual_seed(seed)
        return play_match(stochastic(policy, generator), stochastic(policy, generator), 300, seed, round_seconds=10)

    assert play(1) == play(1)
    assert abs(play(1).win_rate - 0.5) < 0.15
    assert sum(play_match(greedy(policy), greedy(policy), 10, 0, round_seconds=0.1)) == 10
