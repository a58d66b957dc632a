"""Unguided play as training data."""

import torch

from guidance.simulated_users import NO_ADVISORS, training_people
from guidance.study.demonstrations import collect_demonstrations
from guidance.study.setup import PlaySetup


def opponent(observation: torch.Tensor) -> torch.Tensor:
    return torch.stack([torch.full((len(observation),), -0.8), observation[:, 9]], dim=1)


def test_every_user_plays_every_game_and_the_action_is_where_the_hand_went():
    people = training_people(0)[:3]
    setup = PlaySetup(opponent=opponent, variant="comply_or_resist", advisors=NO_ADVISORS)
    data = collect_demonstrations(people, setup, 2, 300, 0)
    assert data.observation.shape == (3, 2, 300, 12) and data.action.shape == (3, 2, 300, 2)
    games = data.action.flatten(0, 1)
    assert all(not torch.equal(games[a], games[b]) for a in range(6) for b in range(a))
    again = collect_demonstrations(people, setup, 2, 300, 0)
    assert torch.equal(again.action, data.action) and torch.equal(again.observation, data.observation)
    moved = data.action.diff(dim=2).abs().flatten()
    assert moved.quantile(0.999) < 0.4  # 20 ms at 1.5 m/s; only a new round puts the hand back at the center
