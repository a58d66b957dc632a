"""Rounds in recorded play."""

import torch

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users.arm import HAND_REACH
from guidance.user_model.data import action_ahead, hand_speed, round_starts

TABLE = TableSpec()


def play(ticks: int, *begins: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Play in which rounds start at the given ticks, and the action is the number of its tick."""
    observation = torch.full((ticks, 12), 0.1)
    for tick in begins:
        observation[tick] = 0.0
        observation[tick, 0], observation[tick, 4] = -TABLE.length / 4, TABLE.length / 4
        observation[tick, 9] = 0.02 * tick  # the puck can lie anywhere on the half-way line
    return observation, torch.arange(ticks, dtype=torch.float32)[:, None].repeat(1, 2)


def test_rounds_are_found():
    observation, _ = play(30, 0, 10, 25)
    assert round_starts(observation, TABLE).nonzero().flatten().tolist() == [0, 10, 25]


def test_the_action_ahead_is_of_the_same_round():
    observation, action = play(12, 0, 5)
    found = action_ahead(observation, action, 0.06, TABLE)[:, 0].tolist()
    assert found == [3, 4, 4, 4, 4, 8, 9, 10, 11, 11, 11, 11]
    assert torch.equal(action_ahead(observation, action, 0.0, TABLE), action)


def test_games_do_not_run_into_each_other():
    one, two = play(8, 0, 3), play(8, 0, 6)
    both = [torch.stack(pair)[None] for pair in zip(one, two, strict=True)]
    found = action_ahead(*both, 0.04, TABLE)
    for game, (observation, action) in enumerate((one, two)):
        assert torch.equal(found[0, game], action_ahead(observation, action, 0.04, TABLE))


def test_a_hand_that_is_put_back_has_no_speed():
    observation, action = play(6, 0, 3)
    action = 0.1 * action
    action[3] = 0.05  # from the middle of its reach, in the first tick of a round
    speed = hand_speed(observation, action, TABLE)
    assert torch.isclose(speed[3], torch.tensor(0.05 * 2**0.5 * HAND_REACH / TABLE.tick))
    assert torch.isclose(speed[1], torch.tensor(0.1 * 2**0.5 * HAND_REACH / TABLE.tick))
