"""SAC: that it learns, what its memory holds, its settings, and that it can be stopped and resumed exactly."""

import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.sac import QNetwork, ReplayBuffer, SACConfig
from airhockey_marl.experiment.command import CONF
from airhockey_marl.players.networks import GaussianPolicy
from tests.airhockey_marl.algorithms.test_ppo import always, check_resuming, foresight, learned, regret

SETTINGS = {
    "capacity": 10_000,
    "updates": 30,
    "minibatch": 256,
    "policy_lr": 1e-3,
    "q_lr": 3e-3,
    "temperature_lr": 1e-2,
    "tau": 0.02,
    "temperature": 0.05,
    "target_entropy": -2.0,
    "outside_cost": 1.0,
    "q_hidden": [32, 32],
}


def test_it_learns_what_pays_later():
    policy, metrics = learned(SACConfig(**SETTINGS), batches=12)
    assert regret(policy) < regret(GaussianPolicy([32])) / 6
    assert metrics[-1]["q_loss"] < metrics[0]["q_loss"] / 4
    assert metrics[-1]["std"] < metrics[0]["std"] - 0.1


@pytest.mark.parametrize(("terminated", "value"), [(True, 1.0), (False, 2.0)])
def test_a_round_that_is_cut_off_is_not_over(terminated, value):
    """With 1 a step and a discount of one half, two is what an endless round is worth."""
    torch.manual_seed(0)
    settings = {**SETTINGS, "temperature": 1e-6, "tau": 0.1, "q_lr": 1e-2}
    learner = SACConfig(**settings).learner(GaussianPolicy([8]), gamma=0.5)
    for _ in range(4):
        learner.update(always(1.0, terminated))
    transitions, q = learner.memory.sample(100), learner.loss.qvalue_network
    for params in learner.q.unbind(0):
        with params.to_module(q):
            assert q(transitions)["state_action_value"].mean().item() == pytest.approx(value, abs=0.15)


def test_the_temperature_holds_the_entropy():
    """It falls while the entropy is above the target, and rises while it is below."""
    torch.manual_seed(0)
    policy = GaussianPolicy([8])
    learner = SACConfig(**{**SETTINGS, "target_entropy": 0.0}).learner(policy, gamma=0.5)
    falling = learner.update(always(0.0, True))["temperature"]
    assert falling < SETTINGS["temperature"]  # an STD of 0.5 in each is an entropy of 1.45
    with torch.no_grad():
        policy.head.bias[2:] = -4.0
    learner = SACConfig(**{**SETTINGS, "target_entropy": 0.0}).learner(policy, gamma=0.5)
    assert learner.update(always(0.0, True))["temperature"] > SETTINGS["temperature"]


def test_q_networks_see_the_action_that_the_table_takes():
    q, observation = QNetwork([8]), torch.randn(5, 12)
    beyond = torch.tensor([[1.5, -3.0]]).expand(5, 2)
    assert torch.equal(q(observation, beyond), q(observation, beyond.clamp(-1.0, 1.0)))


def test_means_stay_about_where_the_table_takes_them():
    """The very edge is best: without a cost the mean runs on."""
    furthest = []
    for cost in (0.0, 1.0):
        torch.manual_seed(0)
        policy = GaussianPolicy([8])
        learner = SACConfig(**{**SETTINGS, "outside_cost": cost, "policy_lr": 2e-2}).learner(policy, gamma=0.5)
        for _ in range(4):
            view = always(0.0, True)
            view["action"] = 2.0 * torch.randn(50, 10, 2)
            view["next", "reward"] = view["action"].clamp(-1.0, 1.0).sum(-1, keepdim=True)
            learner.update(view)
        furthest.append(policy(torch.zeros(12))[0].max().item())
    assert furthest[0] > 1.5 > furthest[1] > 0.9


def test_the_memory_keeps_the_newest():
    memory = ReplayBuffer(30)
    batches = [always(float(number), True)[:2] for number in range(3)]  # of 20
    for filled, batch in zip((20, 30, 30), batches, strict=True):
        memory.extend(batch)
        assert len(memory) == filled
    assert sorted(memory.reward.flatten().tolist()) == [1.0] * 10 + [2.0] * 20
    memory.extend(always(9.0, True))  # more than it can hold
    assert len(memory) == 30 and set(memory.reward.flatten().tolist()) == {9.0}


def test_the_memory_gives_transitions_back_whole():
    view = foresight(GaussianPolicy([8]), torch.Generator().manual_seed(0))
    memory = ReplayBuffer(5000)
    memory.extend(view)
    flat = view.reshape(-1)
    for transition in memory.sample(50).unbind(0):
        place = (flat["action"] == transition["action"]).all(-1).nonzero().item()
        kept = flat[place]
        assert torch.equal(transition["observation"], kept["observation"])
        for name in ("observation", "reward", "terminated"):
            assert torch.equal(transition["next", name], kept["next", name])


def test_it_can_be_resumed_exactly():
    check_resuming(SACConfig(**{**SETTINGS, "capacity": 5000}))  # the ring is full by the third batch


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("capacity", 0),
        ("updates", 0),
        ("minibatch", -1),
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


def test_the_yaml_is_a_sac():
    algorithm = ALGORITHMS.build(OmegaConf.load(CONF / "algorithm" / "sac.yaml"), "algorithm")
    assert isinstance(algorithm, SACConfig)
    assert len(algorithm.learner(GaussianPolicy(), 0.98).parts()["memory"].reward) == algorithm.capacity
