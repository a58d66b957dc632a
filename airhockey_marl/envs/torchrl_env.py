"""Two-player air hockey as a batch of tables for TorchRL.

`AirHockeyEnv` is n tables behind `EnvBase`, with the keys that TorchRL's `PettingZooWrapper` gives; spaces and rules are
those of `pettingzoo_env`, and with the same seeds and actions the trajectories are equal bit for bit.
"""

import warnings
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, PettingZooWrapper, SerialEnv

from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, SEATS, World, round_steps
from airhockey_marl.experiment.validation import check_counts


class AirHockeyEnv(EnvBase):
    """n tables stepped together, batch size (n,), with `PettingZooWrapper`'s keys: (seat, "observation") and so on.

    Each seat is a group of one agent, hence the dimension of size 1: (n, 1, 12) observations, (n, 1, 2) actions,
    (n, 1, 1) rewards; done, terminated and truncated are (n, 1) and shared.

    Args:
        n: tables.
        round_seconds, frame_skip, table: as for `AirHockey`.
        seed: of the serves.
    """

    _has_frame_skip = True  # `_step` skips frames itself; without this `EnvBase` would wrap it in a FrameSkipTransform

    def __init__(
        self,
        n: int,
        round_seconds: float = 60.0,
        frame_skip: int = 1,
        table: TableSpec | None = None,
        seed: int | None = None,
    ) -> None:
        check_counts(tables=n)
        check_counts(0, seed=0 if seed is None else seed)
        super().__init__(device="cpu", batch_size=[n])
        self.tables = World(n, table)
        self.frame_skip = frame_skip
        self.max_steps = round_steps(round_seconds, self.tables.table, frame_skip)
        self._steps = np.zeros(n, dtype=np.int64)
        self._actions = np.zeros((n, 2, ACTION_SIZE), dtype=np.float32)

        def per_seat(**specs: Any) -> Composite:
            seats = {seat: Composite(**{k: v.clone() for k, v in specs.items()}, shape=[n, 1]) for seat in SEATS}
            return Composite(**seats, shape=[n])

        self.observation_spec = per_seat(observation=Unbounded([n, 1, OBSERVATION_SIZE], dtype=torch.float32))
        self.action_spec = per_seat(action=Bounded(-1.0, 1.0, [n, 1, ACTION_SIZE], dtype=torch.float32))
        self.reward_spec = per_seat(reward=Unbounded([n, 1, 1], dtype=torch.float32))
        flag = Categorical(2, shape=[n, 1], dtype=torch.bool)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=[n])
        self.set_seed(seed if seed is not None else 0)

    def _set_seed(self, seed: int | None) -> None:
        self.tables.seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        which = None
        if tensordict is not None and "_reset" in tensordict:
            which = tensordict["_reset"].view(-1).numpy()
            self._steps[which] = 0
        else:
            self._steps[:] = 0
        self.tables.new_rounds(which)
        over = np.zeros(self.tables.n, dtype=bool)
        return self._seen(self._flags(over, over))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, seat in enumerate(SEATS):
            self._actions[:, index] = tensordict[seat, "action"].view(-1, ACTION_SIZE).numpy()
        self.tables.step(self._actions, self.frame_skip)
        self._steps += 1
        terminated = self.tables.goals != 0
        seen = self._seen(self._flags(terminated, ~terminated & (self._steps >= self.max_steps)))
        reward = torch.from_numpy(self.tables.goals.astype(np.float32)).view(-1, 1, 1)
        seen["left"].set("reward", reward)
        seen["right"].set("reward", -reward)
        return seen

    def _flags(self, terminated: np.ndarray, truncated: np.ndarray) -> dict[str, torch.Tensor]:
        over = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return {name: torch.from_numpy(flag.copy()).view(-1, 1) for name, flag in over.items()}

    def _seen(self, flags: dict[str, torch.Tensor]) -> TensorDictBase:
        n = self.tables.n
        seats = {}
        for index, seat in enumerate(SEATS):
            seen = self.tables.observe(index, np.empty((n, OBSERVATION_SIZE), dtype=np.float32))
            seats[seat] = TensorDict({"observation": torch.from_numpy(seen).view(n, 1, -1)}, [n, 1])
        return TensorDict({**seats, **flags}, [n])


def make_env(
    backend: str, tables: int, round_seconds: float, frame_skip: int, seed: int, table: TableSpec | None = None
) -> EnvBase:
    """The batch of tables a collector steps.

    Args:
        backend: `"batched"` for `AirHockeyEnv`, `"pettingzoo"` for that many `AirHockey` in a `SerialEnv`: the
            same trajectories, slowly, which is what one would use to put another PettingZoo game in this place.

    Raises:
        ValueError: an unknown backend.
    """
    check_counts(tables=tables)
    check_counts(0, seed=seed)
    if backend == "batched":
        return AirHockeyEnv(tables, round_seconds, frame_skip, table, seed)
    if backend == "pettingzoo":
        games = [partial(_wrapped, round_seconds, frame_skip, table, seed + i) for i in range(tables)]
        env = SerialEnv(tables, games)
        env.start()
        return env
    raise ValueError(f"env.backend = {backend!r} must be 'batched' or 'pettingzoo'")


def serve_rng_states(env: EnvBase) -> list[np.ndarray]:
    """The random numbers of the tables of `make_env`, as views (uint64) to read and to set."""
    games = [env] if isinstance(env, AirHockeyEnv) else [wrapped.unwrapped for wrapped in env._envs]
    return [game.tables.rng for game in games]


def _wrapped(round_seconds: float, frame_skip: int, table: TableSpec | None, seed: int) -> EnvBase:
    with warnings.catch_warnings():  # TorchRL was tested with PettingZoo 1.24.3; our tests cover the one installed
        warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested")
        game = AirHockey(round_seconds, frame_skip, table)
        env = PettingZooWrapper(game, group_map={seat: [seat] for seat in SEATS}, use_mask=False)
    game.tables.seed(seed)  # not set_seed: it would play a serve
    return env
