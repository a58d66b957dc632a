"""The PettingZoo environment, the TorchRL batch, and that they are one game."""

import time

import numpy as np
import pygame
import pytest
import torch
from pettingzoo.test import parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.utils.conversions import parallel_to_aec
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs.utils import check_env_specs

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import PUCK, RIGHT, TableSpec
from airhockey_marl.envs.rendering import draw_table
from airhockey_marl.envs.torchrl_env import AirHockeyEnv, make_env
from airhockey_marl.envs.world import AGENTS, World
from airhockey_marl.players.networks import GaussianPolicy


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


@pytest.mark.filterwarnings("error")
def test_pettingzoo_api():
    parallel_api_test(AirHockey(round_seconds=2), num_cycles=300)
    parallel_seed_test(lambda: AirHockey(round_seconds=2))
    seed_test(lambda: parallel_to_aec(AirHockey(round_seconds=2)), num_cycles=100)
    render_test(lambda render_mode: parallel_to_aec(AirHockey(round_seconds=2, render_mode=render_mode)))


@pytest.mark.parametrize("agent_flags", [True, False])
def test_torchrl_specs(agent_flags):
    check_env_specs(AirHockeyEnv(3, round_seconds=0.2, seed=1, agent_flags=agent_flags))


def test_the_batch_has_all_that_the_wrapper_has():
    """The same keys, groups and trajectories as TorchRL's wrapper around the PettingZoo environment."""
    batch, wrapped = AirHockeyEnv(2, round_seconds=0.1, seed=5), make_env("pettingzoo", 2, 0.1, 1, 5)
    assert wrapped.group_map == [batch.group_map] * 2
    for kind in ("action_keys", "reward_keys", "done_keys", "reset_keys"):
        assert getattr(batch, kind) == getattr(wrapped, kind)
    stay = TensorDictSequential(
        *(
            TensorDictModule(lambda x: 0 * x[..., :2], in_keys=[(agent, "observation")], out_keys=[(agent, "action")])
            for agent in AGENTS
        )
    )
    one, other = (env.rollout(12, stay, break_when_any_done=False) for env in (batch, wrapped))
    assert {*one.keys(True, True)} == {*other.keys(True, True)} and one["next", "left", "truncated"].sum() == 4
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]) and one[key].dtype == other[key].dtype, key


def test_one_agent_s_reset_is_that_of_its_table():
    env = AirHockeyEnv(3, seed=0)
    state = env.rand_step(env.reset())["next"]
    before = env.world.bodies.copy()
    state["right", "_reset"] = torch.tensor([False, True, False]).view(3, 1, 1)
    env.reset(state)
    assert (before != env.world.bodies).any((1, 2)).tolist() == [False, True, False]


def test_a_policy_that_is_being_trained_plays_the_batch():
    modules = [
        TensorDictModule(GaussianPolicy([4]), in_keys=[(agent, "observation")], out_keys=[(agent, "action"), "std"])
        for agent in AGENTS
    ]
    assert AirHockeyEnv(3, seed=0).rollout(5, TensorDictSequential(*modules))["left", "action"].requires_grad


ENVIRONMENTS = {"pettingzoo": AirHockey, "torchrl": lambda: AirHockeyEnv(2)}
SEED_WITH = {
    "pettingzoo": lambda env, seed: env.reset(seed=seed),
    "torchrl": lambda env, seed: env.set_seed(seed),
    "torchrl reset": lambda env, seed: env.reset(seed=seed),
}


@pytest.mark.parametrize("way", SEED_WITH)
def test_one_rule_for_seeds(way):
    env = ENVIRONMENTS[way.split()[0]]()
    for seed in (-1, True, np.int64(-1), np.True_, 2.0, "1"):
        with pytest.raises(ValueError, match=r"^seed = .* must be a whole number of at least 0$"):
            SEED_WITH[way](env, seed)
    for seed in (0, 5, np.int64(5), np.uint8(5), np.int64(2**63 - 1), 2**64, 2**128 - 1):
        SEED_WITH[way](env, seed)
        states = env.world.rng.copy()
        SEED_WITH[way](env, int(seed))
        assert np.array_equal(env.world.rng, states)


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_without_a_seed_environments_differ_and_after_one_the_serves_go_on(kind):
    one, other = ENVIRONMENTS[kind](), ENVIRONMENTS[kind]()
    assert not np.array_equal(one.world.rng, other.world.rng)
    one.reset(seed=3), one.reset()
    second = one.world.bodies.copy()
    other.reset(seed=3), other.reset(seed=None)
    assert np.array_equal(other.world.bodies, second)
    other.reset(seed=3)
    assert not np.array_equal(other.world.bodies, second)


def test_seeded_serves_are_those_of_earlier_versions():
    world = World(2)
    world.seed(5)
    assert world.rng.tolist() == [16661312662014107006, 13289283414446607635]


@pytest.mark.parametrize(("frame_skip", "arm"), [(1, None), (3, None), (2, HandArm())])
def test_both_backends_give_the_same_trajectories_bit_for_bit(frame_skip, arm):
    generator = torch.Generator().manual_seed(0)
    actions = 2.4 * torch.rand(400, 2, 3, 1, 2, generator=generator) - 1.2  # some of them to be clipped
    batched, pettingzoo = (make_env(backend, 3, 2.0, frame_skip, 5, arm) for backend in ("batched", "pettingzoo"))
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
    assert env.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(RuntimeError, match="reset"):
        env.step(stay)

    env.reset(seed=0)
    for _ in range(50):
        env.world.bodies[0, PUCK] = (0.3, 0.3, 0.1, 0.0)
        _, _, terminated, truncated, _ = env.step(stay)
    assert truncated["left"] and not terminated["left"] and env.agents == []


@pytest.mark.parametrize("action", [["a", "b"], [None, {}], torch.zeros(2, requires_grad=True)])
def test_actions_that_are_no_numbers_are_named(action):
    env = AirHockey()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^actions: [^\n]+$"):
        env.step({"left": action, "right": np.zeros(2)})


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


def test_a_window_shows_each_step_at_the_speed_of_a_table():
    env = AirHockey(render_mode="human", frame_skip=2)
    env.reset(seed=0)
    began = time.perf_counter()
    for _ in range(5):
        env.step({agent: np.ones(2, dtype=np.float32) for agent in AGENTS})
    assert time.perf_counter() - began > 0.15 and env.metadata["render_fps"] == 25
    shown = pygame.surfarray.array3d(env._window._window.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, draw_table(env.world.bodies[0], env.world.table, 960))
    assert env.render() is None
    env.close()
    env.close()


def test_a_window_without_a_display_is_refused(monkeypatch):
    """Also where SDL would draw into nothing."""
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(ValueError, match=r"^render_mode = 'human' needs a display: there is none$"):
        AirHockey(render_mode="human")
