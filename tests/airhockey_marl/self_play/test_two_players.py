"""What the learner lived through, cut out of what a collector brings."""

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector

from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.envs.torchrl_env import make_env
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import LEARNER, OPPONENT, SwappablePolicy, actor, learner_batch

NO_SHAPING, SHAPING = RewardShaping(0.0, 0.0, 0.0, 0.0), RewardShaping(0.3, 0.6, 0.4, 0.6)


def collected(policy, opponent):
    env = make_env("batched", 10, 0.4, 1, 0)
    both = TensorDictSequential(actor(LEARNER, policy), actor(OPPONENT, opponent))
    options = {"frames_per_batch": 300, "total_frames": -1, "auto_register_policy_transforms": False}
    return Collector(env, both, **options)


def test_the_learners_view_has_its_own_observations_and_rewards():
    torch.manual_seed(0)
    with torch.no_grad():
        data = next(iter(collected(GaussianPolicy([8]), GaussianPolicy([8]))))
    view = learner_batch(data.clone(), NO_SHAPING, 1.0, 0.9)
    assert view.batch_size == (10, 30)
    assert torch.equal(view["observation"], data["left", "observation"].squeeze(-2))
    assert torch.equal(view["action"], data["left", "action"].squeeze(-2))
    assert torch.equal(view["next", "reward"], data["next", "left", "reward"].squeeze(-2))
    assert view["next", "truncated"].any()  # 0.4 s are 20 ticks
    assert torch.equal(view["next", "observation"][:, :18], view["observation"][:, 1:19])

    shaped = learner_batch(data.clone(), SHAPING, 0.5, 0.9)
    added = SHAPING.reward(view["observation"], view["next", "observation"], view["next", "terminated"], 0.9)
    assert torch.allclose(shaped["next", "reward"], view["next", "reward"] + 0.5 * added)


def test_a_seat_changes_hands_while_the_collector_runs():
    one, other = GaussianPolicy([8]), GaussianPolicy([8])
    with torch.no_grad():
        for policy, mean in ((one, -0.9), (other, 0.9)):
            policy.head.weight.zero_()
            policy.head.bias[:] = torch.tensor([mean, mean, -9.0, -9.0])
        seat = SwappablePolicy(one)
        batches = iter(collected(GaussianPolicy([8]), seat))
        first = next(batches)["right", "action"].mean().item()
        seat.policy = other
        second = next(batches)["right", "action"].mean().item()
    assert (round(first, 1), round(second, 1)) == (-0.9, 0.9)
