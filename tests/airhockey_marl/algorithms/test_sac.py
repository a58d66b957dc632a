"""SAC: learning of delayed rewards, replay buffer, temperature, wrong settings, and exact resuming."""

import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.sac import QNetwork, ReplayBuffer, SACConfig
from airhockey_marl.experiment.command import CONF
from airhockey_marl.players.networks import GaussianPolicy
from tests.airhockey_marl.algorithms.test_ppo import check_resuming, foresight, one_step_rounds, regret, train

SETTINGS = {
    "capacity": 10_000,
    "updates": 30,
    "batch_size": 256,
    "policy_lr": 1e-3,
    "q_lr": 3e-3,
    "temperature_lr": 1e-2,
    "tau": 0.02,
    "temperature": 0.05,
    "target_entropy": -2.0,
    "outside_cost": 1.0,
    "q_hidden": [32, 32],
}


def test_delayed_rewards_are_learned():
    policy, metrics = train(SACConfig(**SETTINGS), batches=12)
    assert regret(policy) < regret(GaussianPolicy([32])) / 6
    assert metrics[-1]["q_loss"] < metrics[0]["q_loss"] / 4
    assert metrics[-1]["std"] < metrics[0]["std"] - 0.1


@pytest.mark.parametrize(("terminated", "value"), [(True, 1.0), (False, 2.0)])
def test_truncated_rounds_bootstrap_the_value(terminated, value):
    """With a reward of 1 per step and a discount of one half, an endless round has the value 2."""
    torch.manual_seed(0)
    settings = {**SETTINGS, "temperature": 1e-6, "tau": 0.1, "q_lr": 1e-2}
    learner = SACConfig(**settings).learner(GaussianPolicy([8]), gamma=0.5)
    for _ in range(4):
        learner.update(one_step_rounds(1.0, terminated))
    transitions, q = learner.replay_buffer.sample(100), learner.loss.qvalue_network
    for params in learner.q.unbind(0):
        with params.to_module(q):
            assert q(transitions)["state_action_value"].mean().item() == pytest.approx(value, abs=0.15)


def test_temperature_controls_the_entropy():
    """It falls while the entropy is above the target, and rises while it is below."""
    torch.manual_seed(0)
    policy = GaussianPolicy([8])
    learner = SACConfig(**{**SETTINGS, "target_entropy": 0.0}).learner(policy, gamma=0.5)
    falling = learner.update(one_step_rounds(0.0, True))["temperature"]
    assert falling < SETTINGS["temperature"]  # an STD of 0.5 in each is an entropy of 1.45
    with torch.no_grad():
        policy.head.bias[2:] = -4.0
    learner = SACConfig(**{**SETTINGS, "target_entropy": 0.0}).learner(policy, gamma=0.5)
    assert learner.update(one_step_rounds(0.0, True))["temperature"] > SETTINGS["temperature"]


def test_q_networks_clip_actions_as_the_table_does():
    q, observation = QNetwork([8]), torch.randn(5, 12)
    beyond = torch.tensor([[1.5, -3.0]]).expand(5, 2)
    assert torch.equal(q(observation, beyond), q(observation, beyond.clamp(-1.0, 1.0)))


def test_cost_keeps_means_near_the_clipping_bounds():
    """The best action is at the bound: without a cost the mean grows beyond it."""
    largest_means = []
    for cost in (0.0, 1.0):
        torch.manual_seed(0)
        policy = GaussianPolicy([8])
        learner = SACConfig(**{**SETTINGS, "outside_cost": cost, "policy_lr": 2e-2}).learner(policy, gamma=0.5)
        for _ in range(4):
            batch = one_step_rounds(0.0, True)
            batch["action"] = 2.0 * torch.randn(50, 10, 2)
            batch["next", "reward"] = batch["action"].clamp(-1.0, 1.0).sum(-1, keepdim=True)
            learner.update(batch)
        largest_means.append(policy(torch.zeros(12))[0].max().item())
    assert largest_means[0] > 1.5 > largest_means[1] > 0.9


def test_replay_buffer_has_the_newest_transitions():
    replay_buffer = ReplayBuffer(30)
    batches = [one_step_rounds(float(number), True)[:2] for number in range(3)]  # of 20
    for length, batch in zip((20, 30, 30), batches, strict=True):
        replay_buffer.extend(batch)
        assert len(replay_buffer) == length
    assert sorted(replay_buffer.next_reward.flatten().tolist()) == [1.0] * 10 + [2.0] * 20
    replay_buffer.extend(one_step_rounds(9.0, True))  # more than the capacity
    assert len(replay_buffer) == 30 and set(replay_buffer.next_reward.flatten().tolist()) == {9.0}


def test_samples_are_transitions_of_the_batch():
    batch = foresight(GaussianPolicy([8]), torch.Generator().manual_seed(0))
    replay_buffer = ReplayBuffer(5000)
    replay_buffer.extend(batch)
    transitions = batch.reshape(-1)
    for sample in replay_buffer.sample(50).unbind(0):
        expected = transitions[(transitions["action"] == sample["action"]).all(-1).nonzero().item()]
        assert torch.equal(sample["observation"], expected["observation"])
        for name in ("observation", "reward", "terminated"):
            assert torch.equal(sample["next", name], expected["next", name])


def test_resuming_is_exact():
    check_resuming(SACConfig(**{**SETTINGS, "capacity": 5000}))  # full after the third batch


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("capacity", 0),
        ("updates", 0),
        ("batch_size", -1),
        ("policy_lr", 0.0),
        ("tau", 1.5),
        ("temperature", 0.0),
        ("target_entropy", 3.0),
        ("outside_cost", -1.0),
    ],
)
def test_wrong_settings_are_named(field, value):
    with pytest.raises(ValueError, match=rf"algorithm\.{field} = {value} must be "):
        SACConfig(**{**SETTINGS, field: value})


def test_wrong_layers_are_named():
    with pytest.raises(ValueError, match=r"algorithm\.q_hidden = \(\) must name"):
        SACConfig(**{**SETTINGS, "q_hidden": []})


def test_yaml_configures_sac():
    algorithm = ALGORITHMS.build(OmegaConf.load(CONF / "algorithm" / "sac.yaml"), "algorithm")
    assert isinstance(algorithm, SACConfig)
    assert len(algorithm.learner(GaussianPolicy(), 0.98).modules()["replay_buffer"].next_reward) == algorithm.capacity
