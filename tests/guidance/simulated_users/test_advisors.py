"""Advisors: their compiled networks equal the league's generations, and skill selects the generation."""

import numpy as np
import pytest
import torch

from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from guidance.simulated_users import NO_ADVISORS, SimulatedUsers, load_advisors, personal_streams, sample_people
from guidance.simulated_users.advisors import advised_action, stack_advisors
from tests.guidance.simulated_users.test_users import TABLE, still


def league(hidden: tuple[int, ...], inputs: str, generations: int = 5) -> League:
    torch.manual_seed(3)
    league = League(GaussianPolicy(hidden, inputs))
    for _ in range(generations):
        policy = GaussianPolicy(hidden, inputs)
        with torch.no_grad():
            policy.head.weight *= 8.0
        league.add(policy)
    return league


@pytest.mark.parametrize(("hidden", "inputs"), [((64, 64), "paddle"), ((7,), "table"), ((5, 6, 4), "paddle")])
def test_an_advisor_acts_as_its_generation(hidden, inputs):
    pool = league(hidden, inputs)
    advisors, rng = stack_advisors(pool), np.random.default_rng(0)
    for skill, generation in ((-9.0, 0), (-0.6, 1), (0.0, 2), (0.7, 3), (9.0, 4)):
        state = rng.normal(size=12) * 0.4
        mean, _ = pool.player(generation)(torch.tensor(state, dtype=torch.float32))
        assert advised_action(advisors, skill, state) == pytest.approx(mean.clamp(-1, 1).tolist(), abs=1e-5)


def play(advisors, ticks: int = 600, **changes) -> np.ndarray:
    people = sample_people(12, 4)
    for name, value in changes.items():
        people[name] = value
    users = SimulatedUsers(people, personal_streams(12, 4), TABLE, "comply_or_resist", advisors)
    zero, actions = np.zeros((12, 2)), []
    for tick in range(ticks):
        puck = (0.4 - 0.012 * (tick % 100), 0.2 * np.sin(tick / 30), -0.6, 0.1)
        actions.append(users.step(still(12, puck), zero).copy())
    return np.array(actions)


def test_advisors_change_choices_only_with_weight():
    advisors = stack_advisors(league((16,), "paddle"))
    alone = play(NO_ADVISORS)
    assert np.array_equal(alone, play(advisors, advisor_weight=0.0))
    assert not np.array_equal(alone, play(advisors, advisor_weight=0.5))
    assert np.array_equal(play(advisors), play(advisors))


def test_choices_move_toward_the_advisor():
    """With an advisor who always stays at the front, people press rather than wait."""
    pool = League(GaussianPolicy((4,)))
    policy = GaussianPolicy((4,))
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias[:] = torch.tensor([0.7, 0.0, 0.0, 0.0])
    pool.add(policy)
    ahead = []
    for advice in (0.0, 1.5):
        people = sample_people(20, 4)
        people["advisor_weight"] = advice
        users = SimulatedUsers(people, personal_streams(20, 4), TABLE, "comply_or_resist", stack_advisors(pool))
        ahead.append(np.mean([users.step(still(20), np.zeros((20, 2)))[:, 0].mean() for _ in range(500)]))
    assert ahead[1] > ahead[0] + 0.2


def test_no_file_means_no_advisors():
    assert load_advisors(None) is NO_ADVISORS


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no such file: .*nobody\.safetensors"):
        load_advisors(tmp_path / "nobody.safetensors")
