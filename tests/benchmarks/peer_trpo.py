"""Peer of the training: TRPO of sb3-contrib at the same game, with the settings of `conf/train.yaml`.

It runs in its best case: one compiled call steps all tables in this process, the opponent is one frozen policy in one
forward pass, Adam is fused, nothing is logged or written, and the fastest of several numbers of tables counts. Its
policy has one STD for all states and ours a head, which is slightly less work; it uses all states in the Fisher matrix,
which is more work where `fisher_subsample` is below 1.
"""

import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from torch import nn

from airhockey_marl.envs.physics import LEFT, RIGHT
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, World, round_steps
from airhockey_marl.experiment.command import CONF
from airhockey_marl.players.networks import GaussianPolicy, mlp_layers
from airhockey_marl.players.players import Player, stochastic

try:
    from sb3_contrib import TRPO
    from sb3_contrib.trpo import MlpPolicy
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError:  # without the extra `bench` there is no peer; a broken installation still says so
    TRPO, MlpPolicy, VecEnv = None, object, object


class TablesVecEnv(VecEnv):
    """n tables behind the interface of Stable-Baselines3: the learner plays left, rounds restart when they end."""

    def __init__(self, n: int, round_seconds: float, frame_skip: int, opponent: Player) -> None:
        observation = Box(-np.inf, np.inf, (OBSERVATION_SIZE,), dtype=np.float32)
        super().__init__(n, observation, Box(-1.0, 1.0, (ACTION_SIZE,), dtype=np.float32))
        self.tables, self.opponent, self.frame_skip = World(n), opponent, frame_skip
        self.max_steps = round_steps(round_seconds, self.tables.table, frame_skip)
        self._steps = np.zeros(n, dtype=np.int64)
        self._actions = np.zeros((n, 2, ACTION_SIZE), dtype=np.float32)
        self._opponent_observation = np.empty((n, OBSERVATION_SIZE), dtype=np.float32)
        self._empty: list[dict[str, Any]] = [{}] * n  # SB3 reads a dict per table and step; one object serves for all

    def reset(self) -> np.ndarray:
        self.tables.new_rounds()
        self._steps[:] = 0
        return self._observe()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions[:, LEFT] = actions
        self._actions[:, RIGHT] = self.opponent(
            torch.from_numpy(self.tables.observe(RIGHT, self._opponent_observation))
        ).numpy()

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        self.tables.step(self._actions, self.frame_skip)
        self._steps += 1
        goals = self.tables.goals.astype(np.float32)  # a copy: SB3 adds the values of truncated rounds in place
        over = (goals != 0) | (self._steps >= self.max_steps)
        observation, infos = self._observe(), self._empty
        if over.any():
            infos = infos.copy()
            for i in np.flatnonzero(over):
                infos[i] = {"terminal_observation": observation[i], "TimeLimit.truncated": goals[i] == 0}
            self.tables.new_rounds(over)
            self._steps[over] = 0
            observation = self._observe()
        return observation, goals, over, infos

    def _observe(self) -> np.ndarray:  # a new array each time: SB3 stores the previous one after the step
        return self.tables.observe(LEFT, np.empty((self.num_envs, OBSERVATION_SIZE), dtype=np.float32))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs  # SB3 reads `render_mode` only

    def _unused(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError

    close = set_attr = env_method = env_is_wrapped = _unused  # not called in learning


class PeerPolicy(MlpPolicy):
    """SB3's policy with our activations: ReLU for the policy, tanh for the critic; SB3 has one setting for both."""

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        self.mlp_extractor.value_net = nn.Sequential(*mlp_layers(OBSERVATION_SIZE, self.net_arch["vf"], nn.Tanh))


def peer(cfg: DictConfig, tables: int, batch: int, sub_sampling: int) -> "TRPO":
    """The peer after a first update, which compiles and allocates."""
    opponent = stochastic(GaussianPolicy(cfg.hidden).requires_grad_(False), torch.Generator().manual_seed(cfg.seed))
    networks = {"pi": list(cfg.hidden), "vf": list(cfg.algorithm.critic_hidden)}
    model = TRPO(
        PeerPolicy,
        TablesVecEnv(tables, cfg.env.round_seconds, cfg.env.frame_skip, opponent),
        policy_kwargs={"net_arch": networks, "activation_fn": nn.ReLU, "optimizer_kwargs": {"fused": True}},
        n_steps=batch // tables,
        gamma=cfg.gamma,
        gae_lambda=cfg.algorithm.gae_lambda,
        target_kl=cfg.algorithm.max_kl,
        cg_max_steps=cfg.algorithm.cg_max_steps,
        cg_damping=cfg.algorithm.damping,
        sub_sampling_factor=sub_sampling,
        line_search_max_iter=cfg.algorithm.line_search_max_iter,
        line_search_shrinking_factor=cfg.algorithm.line_search_shrink,
        n_critic_updates=cfg.algorithm.critic_epochs,
        batch_size=cfg.algorithm.critic_batch_size,
        learning_rate=cfg.algorithm.critic_lr,
        seed=cfg.seed,
        device="cpu",
    )
    model.set_logger(Logger(None, []))  # its own would make a folder
    return model.learn(batch, log_interval=None)


def peer_frames(
    tables: Sequence[int] = (50, 250, 1000),
    threads: Sequence[int] = (1,),
    batch: int = 5000,
    frames: int = 50_000,
    runs: int = 5,
    sub_sampling: int = 1,
) -> dict[tuple[int, int], float] | None:
    """Frames/s of `TRPO.learn`, collection and update, for each number of tables and of torch threads.

    Runs of `frames / runs` alternate, so that a slow moment of the machine slows all of them; each has its median.
    `sub_sampling` is of SB3, and also drops states from the gradient and the line search.

    Returns:
        By (tables, threads), the fastest first; None without sb3-contrib.
    """
    if TRPO is None:
        return None
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=["algorithm=trpo"])
    threads_before, frames_per_run = torch.get_num_threads(), frames // runs // batch * batch
    times: dict[tuple[int, int], list[float]] = {(n, k): [] for n in tables for k in threads}
    try:
        torch.set_num_threads(1)
        models = {key: peer(cfg, key[0], batch, sub_sampling) for key in times}
        for key in list(times) * runs:
            torch.set_num_threads(key[1])  # each time, because numba changes it when its threads start
            began = time.perf_counter()
            models[key].learn(frames_per_run, reset_num_timesteps=False, log_interval=None)
            times[key].append(time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads_before)
    rates = {key: frames_per_run / statistics.median(run_times) for key, run_times in times.items()}
    return dict(sorted(rates.items(), key=lambda item: -item[1]))
