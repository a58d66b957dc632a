"""The learner's transitions in the collected data, and policies that are swapped during collection."""

import torch
from torchrl.collectors import Collector

from airhockey_marl.algorithms.reward_shaping import RewardShaping, action_change
from airhockey_marl.envs.torchrl_env import make_env
from airhockey_marl.league.league import TableSlice
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.two_player_policy import TwoPlayerPolicy, learner_batch

NO_SHAPING, SHAPING = RewardShaping(0.0, 0.0, 0.0, 0.0), RewardShaping(0.3, 0.6, 0.4, 0.6)


def make_collector(players):
    options = {"frames_per_batch": 300, "total_frames": -1, "auto_register_policy_transforms": False}
    return Collector(make_env("batched", 10, 0.4, 1, 0), players, **options)


def two_players():
    return TwoPlayerPolicy(GaussianPolicy([8]), TableSlice(0, 10, 10))


def test_learner_batch_has_the_learners_observations_and_rewards():
    torch.manual_seed(0)
    with torch.no_grad():
        data = next(iter(make_collector(two_players())))
    batch = learner_batch(data.clone(), NO_SHAPING, 1.0, 0.9)
    assert batch.batch_size == (10, 30)
    assert torch.equal(batch["observation"], data["left", "observation"].squeeze(-2))
    assert torch.equal(batch["action"], data["left", "action"].squeeze(-2))
    assert torch.equal(batch["next", "reward"], data["next", "left", "reward"].squeeze(-2))
    assert batch["next", "truncated"].any()  # 0.4 s are 20 ticks
    assert torch.equal(batch["next", "observation"][:, :18], batch["observation"][:, 1:19])

    shaped = learner_batch(data.clone(), SHAPING, 0.5, 0.9)
    added = SHAPING.reward(batch["observation"], batch["next", "observation"], batch["next", "terminated"], 0.9)
    assert torch.allclose(shaped["next", "reward"], batch["next", "reward"] + 0.5 * added)

    costly, change = (
        learner_batch(data.clone(), NO_SHAPING, 1.0, 0.9, 0.1),
        action_change(batch["action"], data["next", "done"]),
    )
    assert torch.equal(costly["next", "reward"], batch["next", "reward"] - 0.1 * change) and change.sum() > 0


def test_policy_is_swapped_while_the_collector_runs():
    one, other = GaussianPolicy([8]), GaussianPolicy([8])
    with torch.no_grad():
        for policy, mean in ((one, -0.9), (other, 0.9)):
            policy.head.weight.zero_()
            policy.head.bias[:] = torch.tensor([mean, mean, -9.0, -9.0])
        players = two_players()
        players.opponents.policy = one
        batches = iter(make_collector(players))
        first = next(batches)["right", "action"].mean().item()
        players.opponents.policy = other
        second = next(batches)["right", "action"].mean().item()
    assert (round(first, 1), round(second, 1)) == (-0.9, 0.9)
