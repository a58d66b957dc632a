"""Potential-based shaping: over any trajectory it adds the potential of its first state only."""

import pytest
import torch

from airhockey_marl.algorithms.reward_shaping import RewardShaping, action_change

SHAPING = RewardShaping(position=0.3, velocity=0.6, shot=0.4, approach=0.6)


def trajectory(ticks: int) -> torch.Tensor:
    return torch.randn(ticks + 1, 12, generator=torch.Generator().manual_seed(0))


def test_discounted_rewards_telescope_to_the_first_potential():
    gamma, observation = 0.98, trajectory(50)
    terminated = torch.zeros(50, 1, dtype=torch.bool)
    terminated[-1] = True
    rewards = SHAPING.reward(observation[:-1], observation[1:], terminated, gamma)
    total = (gamma ** torch.arange(50)[:, None] * rewards).sum()
    assert total.item() == pytest.approx(-SHAPING.potential(observation[:1]).item(), abs=1e-5)


def test_potential_increases_with_each_of_its_terms():
    state = torch.zeros(12)
    state[0], state[8] = -0.5, -0.3  # paddle and puck on the own side

    def better(index: int, value: float) -> bool:
        changed = state.clone()
        changed[index] = value
        return bool(SHAPING.potential(changed) > SHAPING.potential(state))

    assert better(10, 2.0) and not better(10, -2.0)  # the puck moves toward the opponent
    assert better(0, -0.38) and not better(0, -0.1)  # the paddle comes behind the puck, not before it
    assert RewardShaping(1.0, 0.0, 0.0, 0.0).potential(state) < RewardShaping(1.0, 0.0, 0.0, 0.0).potential(
        state.index_fill(0, torch.tensor(8), 0.5)
    )


def test_a_change_of_action_is_squared_within_a_round_and_a_batch():
    """Two tables; the second one's round ends after its second decision."""
    action = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [-1.0, 0.5]], [[0.2, 0.2], [0.2, -1.8], [0.9, 0.9]]])
    done = torch.tensor([[False, False, False], [False, True, False]])[..., None]
    expected = torch.tensor([[0.0, 1.0, 4.25], [0.0, 4.0, 0.0]])[..., None]
    assert torch.allclose(action_change(action, done), expected)
