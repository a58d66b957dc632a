"""The league: frozen generations, batches of opponents, files, and matches."""

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


def test_training_does_not_change_frozen_generations():
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
        player.head.bias += 1.0  # a copy as well
    assert weights_hash(league.generation(0)) == league.hashes[0]


@pytest.mark.parametrize("player_ids", [[5, 0, 3, 3], ["striker", 2, "random", 4], ["defender"] * 4])
def test_opponent_batch_equals_its_players_table_by_table(player_ids):
    league = league_of(6)
    observation = torch.randn(20, 1, 12)
    mean, std = league.opponent_batch(player_ids)(observation)
    assert mean.shape == std.shape == (20, 1, 2)
    for table in range(20):
        player_id = player_ids[table // 5]
        player = SCRIPTED_PLAYERS[player_id] if isinstance(player_id, str) else league.player(player_id)
        expected = player(observation[table])
        assert torch.allclose(mean[table], expected[0], atol=1e-6)
        assert torch.allclose(std[table], expected[1], atol=1e-6)


def test_unknown_players_are_named():
    with pytest.raises(ValueError, match="scripted player = 'goalie' must be one of random, defender, striker"):
        league_of(2).opponent_batch([0, "goalie"])
    with pytest.raises(ValueError, match="generation = 7 must be below 2"):
        league_of(2).opponent_batch([7, "random"])


def test_stacked_weights_restore_the_league():
    league = league_of(3)
    weights = league.stacked_weights()
    assert League.from_stacked_weights(GaussianPolicy([8]), weights).hashes == league.hashes
    with pytest.raises(ValueError, match="the model has"):
        League.from_stacked_weights(GaussianPolicy([9]), weights)
    with pytest.raises(ValueError, match="is missing"):
        League.from_stacked_weights(GaussianPolicy([8, 8]), weights)


def test_file_restores_the_league_and_its_prefixes(tmp_path):
    league = League(GaussianPolicy([8], "paddle"))
    for seed in range(3):
        torch.manual_seed(seed)
        league.add(GaussianPolicy([8], "paddle"))
    league.save(tmp_path / "league.safetensors")
    read = League.load(tmp_path / "league.safetensors")
    assert read.hashes == league.hashes and read.policy.inputs.origin == "paddle"
    assert read.prefix(1).hashes == league.hashes[:2] and read.prefix(-1).hashes == league.hashes
    observation = torch.randn(5, 12)
    assert torch.equal(read.player(2)(observation)[0], league.player(2)(observation)[0])


def test_missing_generation_is_named():
    with pytest.raises(ValueError, match="generation = 3 must be below 3"):
        league_of(3).generation(3)


def test_matches_are_fair_and_reproducible():
    policy = league_of(1).player(0)

    def play(seed: int):
        generator = torch.Generator().manual_seed(seed)
        return play_match(*[stochastic(policy, generator)] * 2, 300, seed, round_seconds=10)

    assert play(1) == play(1)
    assert abs(play(1).win_rate - 0.5) < 0.15
    assert sum(play_match(greedy(policy), greedy(policy), 10, 0, round_seconds=0.1)) == 10
