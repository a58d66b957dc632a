"""Two-player air hockey as a TorchRL environment: n tables, stepped together.

Spaces and rules are those of `pettingzoo_env`, the keys those of TorchRL's `PettingZooWrapper`; with the same seeds
and actions the trajectories are equal bit for bit.
"""

import warnings
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, PettingZooWrapper, SerialEnv

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.world import ACTION_SIZE, AGENTS, OBSERVATION_SIZE, World, round_steps

FLAGS = ("done", "terminated", "truncated")


class AirHockeyEnv(EnvBase):
    """A batch of n tables, batch size (n,).

    Each agent is a group of its own, hence the dimension of size 1. Keys, for `agent` "left" and "right":
        (agent, "observation") (n, 1, 12), (agent, "action") (n, 1, 2) and (agent, "reward") (n, 1, 1), float32;
        "done", "terminated" and "truncated" (n, 1) bool, and the same of each agent, (agent, "done") ... (n, 1, 1).

    Args:
        n: number of tables.
        round_seconds, frame_skip, table: as for `AirHockey`.
        seed: of the serves; table i gets `seed` + i. None for one from the operating system's entropy.
        agent_flags: whether each agent has flags of its own. They say the same, as a round ends for both, and cost a
            third of the speed.
        arm: as for `AirHockey`.

    Attributes:
        group_map: the agents of each group.
    """

    _has_frame_skip = True  # `_step` skips frames itself; without this `EnvBase` would wrap it in a FrameSkipTransform

    def __init__(
        self,
        n: int,
        round_seconds: float = 60.0,
        frame_skip: int = 1,
        table: TableSpec | None = None,
        seed: int | None = None,
        agent_flags: bool = True,
        arm: HandArm | None = None,
    ) -> None:
        super().__init__(device="cpu", batch_size=[n])
        self.world = World(n, table, seed, arm)
        self.group_map = {agent: [agent] for agent in AGENTS}
        self.frame_skip = frame_skip
        self.max_steps = round_steps(round_seconds, self.world.table, frame_skip)
        self._steps = np.zeros(n, dtype=np.int64)
        self._actions = np.zeros((n, 2, ACTION_SIZE), dtype=np.float32)

        def per_agent(**specs: Any) -> Composite:
            groups = {agent: Composite(**{k: v.clone() for k, v in specs.items()}, shape=[n, 1]) for agent in AGENTS}
            return Composite(**groups, shape=[n])

        self.observation_spec = per_agent(observation=Unbounded([n, 1, OBSERVATION_SIZE], dtype=torch.float32))
        self.action_spec = per_agent(action=Bounded(-1.0, 1.0, [n, 1, ACTION_SIZE], dtype=torch.float32))
        self.reward_spec = per_agent(reward=Unbounded([n, 1, 1], dtype=torch.float32))
        flags = {name: Categorical(2, shape=[n, 1], dtype=torch.bool) for name in FLAGS}
        self._agent_flags = FLAGS if agent_flags else ()
        of_agents = per_agent(**{name: flags[name].unsqueeze(-1) for name in FLAGS}) if agent_flags else {}
        self.done_spec = Composite({**of_agents, **flags}, shape=[n])

    def _set_seed(self, seed: int | None) -> None:
        self.world.seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, seed: int | None = None, **_: Any) -> TensorDictBase:
        if seed is not None:
            self.world.seed(seed)
        none = np.zeros(self.world.n, dtype=bool)
        keys = [] if tensordict is None else ["_reset", *((agent, "_reset") for agent in AGENTS)]
        masks = [tensordict[key].view(-1) for key in keys if key in tensordict.keys(True)]
        mask = torch.stack(masks).any(0).numpy() if masks else ~none
        self._steps[mask] = 0
        self.world.new_rounds(mask)
        return self._observe(none, none)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, agent in enumerate(AGENTS):
            self._actions[:, index] = tensordict[agent, "action"].detach().view(-1, ACTION_SIZE).numpy()
        self.world.step(self._actions, self.frame_skip)
        self._steps += 1
        terminated = self.world.goals != 0
        result = self._observe(terminated, ~terminated & (self._steps >= self.max_steps))
        reward = torch.from_numpy(self.world.goals.astype(np.float32)).view(-1, 1, 1)
        result["left"].set("reward", reward)
        result["right"].set("reward", -reward)
        return result

    def _observe(self, terminated: np.ndarray, truncated: np.ndarray) -> TensorDictBase:
        n = self.world.n
        arrays = zip(FLAGS, (terminated | truncated, terminated, truncated), strict=True)
        flags = {name: torch.from_numpy(flag.copy()).view(n, 1) for name, flag in arrays}
        entries = {}
        for index, agent in enumerate(AGENTS):
            observation = self.world.observe(index, np.empty((n, OBSERVATION_SIZE), dtype=np.float32))
            own = {name: flags[name].view(n, 1, 1) for name in self._agent_flags}
            entries[agent] = TensorDict({"observation": torch.from_numpy(observation).view(n, 1, -1), **own}, [n, 1])
        return TensorDict(entries | flags, [n])


def make_env(
    backend: str, tables: int, round_seconds: float, frame_skip: int, seed: int, arm: HandArm | None = None
) -> EnvBase:
    """The environment of a collector: a batch of tables.

    Args:
        backend: `"batched"` for `AirHockeyEnv`; `"pettingzoo"` for `tables` copies of `AirHockey` in a `SerialEnv`,
            with the same trajectories but slower: the way to use another PettingZoo game.
    """
    if backend == "batched":
        return AirHockeyEnv(tables, round_seconds, frame_skip, seed=seed, agent_flags=False, arm=arm)
    if backend == "pettingzoo":
        makers = [partial(_wrapped, round_seconds, frame_skip, seed + i, arm) for i in range(tables)]
        env = SerialEnv(tables, makers)
        env.start()
        return env
    raise ValueError(f"env.backend = {backend!r} must be 'batched' or 'pettingzoo'")


def serve_rng_states(env: EnvBase) -> list[np.ndarray]:
    """States of the serves' random numbers in an environment of `make_env`: uint64 views, to read and to set."""
    envs = [env] if isinstance(env, AirHockeyEnv) else [wrapped.unwrapped for wrapped in env._envs]
    return [each.world.rng for each in envs]


def _wrapped(round_seconds: float, frame_skip: int, seed: int, arm: HandArm | None) -> EnvBase:
    with warnings.catch_warnings():  # TorchRL is tested with PettingZoo 1.24.3 only
        warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested")
        game = AirHockey(round_seconds, frame_skip, arm=arm)
        env = PettingZooWrapper(game, group_map={agent: [agent] for agent in AGENTS}, use_mask=False)
    game.world.seed(seed)  # set_seed would reset, and so draw a serve
    return env
