"""The PettingZoo environment, the TorchRL batch, and that they are one game."""

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test
from torchrl.envs.utils import check_env_specs

from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import PUCK, RIGHT, TableSpec
from airhockey_marl.envs.torchrl_env import AirHockeyEnv, make_env
from airhockey_marl.envs.world import AGENTS


def rollout(env, actions: torch.Tensor) -> torch.Tensor:
    """Observations, rewards and flags of all steps as a collector receives them: (steps, tables, ...)."""
    observations, state = [], env.reset()
    for action in actions:
        state["left", "action"], state["right", "action"] = action
        step, state = env.step_and_maybe_reset(state)
        parts = [step["next", agent, key].flatten(1) for agent in AGENTS for key in ("observation", "reward")]
        parts += [step["next", flag].float() for flag in ("done", "terminated", "truncated")]
        observations.append(torch.cat([*parts, state["left", "observation"].flatten(1)], dim=1))
    return torch.stack(observations)


def test_pettingzoo_api():
    parallel_api_test(AirHockey(round_seconds=2), num_cycles=300)


def test_torchrl_specs():
    check_env_specs(AirHockeyEnv(3, round_seconds=0.2, seed=1))


@pytest.mark.parametrize("frame_skip", [1, 3])
def test_both_backends_give_the_same_trajectories_bit_for_bit(frame_skip):
    generator = torch.Generator().manual_seed(0)
    actions = 2.4 * torch.rand(400, 2, 3, 1, 2, generator=generator) - 1.2  # some of them to be clipped
    batched, pettingzoo = (make_env(backend, 3, 2.0, frame_skip, 5) for backend in ("batched", "pettingzoo"))
    assert torch.equal(rollout(batched, actions), rollout(pettingzoo, actions))


def test_a_whole_trajectory_follows_from_the_seed():
    def play(seed: int) -> np.ndarray:
        env, rng, trail = AirHockey(round_seconds=3), np.random.default_rng(0), []
        env.reset(seed=seed)
        for _ in range(600):
            if not env.agents:
                env.reset()
            actions = {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in AGENTS}
            observations, rewards, *_ = env.step(actions)
            trail.append(np.concatenate([observations["left"], observations["right"], [rewards["left"]]]))
        return np.array(trail)

    assert np.array_equal(play(3), play(3))
    assert not np.array_equal(play(3), play(4))


def test_the_right_agent_observes_the_table_after_a_half_turn():
    env = AirHockey()
    observations, _ = env.reset(seed=0)
    assert np.array_equal(observations["left"][8:], -observations["right"][8:])
    assert np.array_equal(observations["left"][:4], -observations["right"][4:8])


def test_actions_are_positions_from_the_midpoint_of_the_side():
    env, table = AirHockey(), TableSpec()
    env.reset(seed=0)
    for _ in range(60):
        env.world.bodies[0, PUCK] = (0.0, 0.45, 0.0, 0.0)
        observations, *_ = env.step({"left": np.array([1.0, -1.0]), "right": np.array([0.0, 0.0])})
    corner = (-table.paddle_radius, -table.width / 2 + table.paddle_radius)
    assert observations["left"][:2] == pytest.approx(corner, abs=1e-3)
    assert observations["right"][:2] == pytest.approx((-table.length / 4, 0.0), abs=1e-3)


def test_goals_terminate_and_time_truncates():
    stay = {agent: np.zeros(2, dtype=np.float32) for agent in AGENTS}
    env = AirHockey(round_seconds=1.0)
    env.reset(seed=0)
    env.world.bodies[0, RIGHT, :2] = 0.8, 0.4
    env.world.bodies[0, PUCK] = (0.9, 0.0, 10.0, 0.0)
    _, reward, terminated, truncated, _ = env.step(stay)
    assert reward == {"left": 1.0, "right": -1.0}
    assert terminated["left"] and not truncated["left"] and env.agents == []
    with pytest.raises(RuntimeError, match="reset"):
        env.step(stay)

    env.reset(seed=0)
    for _ in range(50):
        env.world.bodies[0, PUCK] = (0.3, 0.3, 0.1, 0.0)
        _, _, terminated, truncated, _ = env.step(stay)
    assert truncated["left"] and not terminated["left"] and env.agents == []


def test_an_action_that_is_not_a_number_means_stay():
    env = AirHockey()
    env.reset(seed=0)
    nothing = {agent: np.full(2, np.nan, dtype=np.float32) for agent in AGENTS}
    observations, *_ = env.step(nothing)
    assert observations["left"][:4] == pytest.approx((-TableSpec().length / 4, 0, 0, 0))


def test_render():
    env = AirHockey(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    for _ in range(20):
        env.step({agent: np.ones(2, dtype=np.float32) for agent in AGENTS})
    assert (env.render() != first).any()
    assert AirHockey().render() is None
