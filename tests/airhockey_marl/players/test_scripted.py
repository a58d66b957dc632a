"""The scripted players: symmetry, actions and strength."""

import numpy as np
import pytest
import torch

from airhockey_marl.envs.physics import LEFT, PUCK, TableSpec, X
from airhockey_marl.envs.world import World
from airhockey_marl.evaluation.matches import play_match
from airhockey_marl.evaluation.saves import count_saves
from airhockey_marl.players.players import stochastic
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS

TABLE = TableSpec()
SCRIPTS = ("defender", "striker")


def player(name, seed=0):
    return stochastic(SCRIPTED_PLAYERS[name], torch.Generator().manual_seed(seed))


def states(n, seed=0):
    """Observations (n, 12) of world on which anything may be anywhere, at speeds up to 10 m/s."""
    rng = np.random.default_rng(seed)
    half, side = TABLE.length / 2, TABLE.width / 2
    observation = rng.uniform(-1, 1, (n, 12)) * np.tile([half, side, 3.0, 3.0], 3)
    observation[:, 0] = -abs(observation[:, 0])
    observation[:, 4] = abs(observation[:, 4])
    observation[:, 10:] *= rng.uniform(0, 3, (n, 1))
    return torch.from_numpy(observation).float()


def sent_across(world, name, seconds=2.0):
    """Whether the left player brings the puck of the one table into the other half, the right one standing still."""
    for _ in range(round(seconds / (2 * TABLE.tick))):
        action, _ = SCRIPTED_PLAYERS[name](torch.from_numpy(world.observe(LEFT, np.empty((1, 12), dtype=np.float32))))
        world.step(np.stack([action.numpy(), np.zeros((1, 2))], axis=1), 2)
        if world.goals[0] or world.bodies[0, PUCK, X] > 0:
            break
    return world.goals[0] >= 0 and world.bodies[0, PUCK, X] > 0


@pytest.mark.parametrize("name", SCRIPTS)
def test_left_and_right_are_alike(name):
    observation = states(5000)
    mirrored = observation * torch.tensor([1.0, -1.0, 1.0, -1.0] * 3)
    action, _ = SCRIPTED_PLAYERS[name](observation)
    assert torch.equal(SCRIPTED_PLAYERS[name](mirrored)[0], action * torch.tensor([1.0, -1.0]))


@pytest.mark.parametrize("name", SCRIPTED_PLAYERS)
def test_actions_are_in_range_at_any_observation(name):
    extreme = torch.cat(
        [
            states(2000, 1),
            100 * states(2000, 2),
            1e6 * states(200, 3),
            torch.zeros(1, 12),
            states(200, 4) * torch.tensor([1.0, 1.0, 0.0, 0.0] * 3),  # everything at rest
            states(200, 5) * torch.tensor([1.0] * 8 + [0.0, 0.0, 1.0, 1.0]),
            states(200, 6)[:, [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3]],  # paddle and puck in one place
        ]
    )
    mean, std = SCRIPTED_PLAYERS[name](extreme)
    assert mean.isfinite().all() and (mean.abs() <= 1).all()
    assert (std > 0).all()


@pytest.mark.parametrize("name", SCRIPTED_PLAYERS)
def test_has_the_interface_of_a_policy(name):
    observation = states(12).reshape(3, 4, 12)
    mean, std = SCRIPTED_PLAYERS[name](observation)
    assert mean.shape == std.shape == (3, 4, 2) and mean.dtype == std.dtype == torch.float32
    assert torch.equal(mean[1, 2], SCRIPTED_PLAYERS[name](observation[1, 2])[0])


def test_the_defender_goes_where_the_puck_comes_over_a_wall():
    world = World(1)
    world.new_rounds()
    world.bodies[0, PUCK] = 0.5, 0.2, -2.0, 1.6
    policy = player("defender")
    for _ in range(100):
        action = policy(torch.from_numpy(world.observe(LEFT, np.empty((1, 12), dtype=np.float32))))
        world.step(np.stack([action.numpy(), np.zeros((1, 2))], axis=1))
        if world.touched[0]:
            break
    assert world.touched[0] == 1


@pytest.mark.parametrize("y", [-0.4, 0.0, 0.3])
@pytest.mark.parametrize(("name", "x"), [("defender", -0.25), ("defender", -0.6), ("striker", -0.4), ("striker", -0.6)])
def test_a_puck_at_rest_is_sent_into_the_other_half(name, x, y):
    world = World(1)
    world.new_rounds()
    world.bodies[0, PUCK] = x, y, 0.0, 0.0
    assert sent_across(world, name)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_puck_behind_the_paddle_is_gone_around(name):
    """Straight to its run-up the paddle would knock the puck into its own goal."""
    world = World(1)
    world.new_rounds()
    world.bodies[0, LEFT] = -0.3, 0.0, 0.0, 0.0
    world.bodies[0, PUCK] = -0.6, 0.02, 0.0, 0.0
    assert sent_across(world, name)


def test_the_striker_beats_the_random_player_and_the_defender():
    assert play_match(player("striker"), player("random", 1), 200, 0).wins >= 0.9 * 200
    assert play_match(player("striker"), player("defender", 1), 100, 0).win_rate > 0.7


def test_the_defender_saves_more_than_the_random_player():
    saves = [count_saves(player(name), player("striker", 1), 20, 0) for name in ("defender", "random")]
    rates = [blocked / (blocked + conceded) for blocked, conceded in saves]
    assert rates[0] > rates[1] + 0.2
