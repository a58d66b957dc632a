"""Two-player air hockey, as a PettingZoo environment and as a batch of tables for TorchRL.

Agents        `left` and `right`; both see the table from their own seat, so one model can play either.
Observation   float32 (12,), in m and m/s from the table's centre, x toward the opponent, y to one's left:
                0-3   own paddle         x, y, vx, vy
                4-7   opponent's paddle  x, y, vx, vy
                8-11  puck               x, y, vx, vy
Action        float32 (2,) in [-1, 1]: the desired position of the own paddle; 0 is the midpoint of the own side,
              +-1 where the paddle meets the walls, the half-way line or the end (section 3.1 of the paper).
Reward        +1 for a goal, -1 for a goal conceded, 0 otherwise.
An episode    is a round: it terminates with a goal, and is truncated after `round_seconds`.
A step        is one decision: `decision_ticks` ticks of 20 ms, one unless asked for otherwise.

`AirHockey` is one table behind PettingZoo's parallel API; `AirHockeyTables` is n tables behind TorchRL's `EnvBase`,
with the keys that TorchRL's `PettingZooWrapper` gives. Both play on `tables.Tables`, and with the same seeds and
actions their trajectories are equal bit for bit: table i of a batch seeded with s plays as an `AirHockey` with s + i.
"""

import warnings
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, PettingZooWrapper, SerialEnv

from airhockey_marl.checks import check_counts, check_numbers, kind_of
from airhockey_marl.render import draw_table
from airhockey_marl.table import LEFT, RIGHT, Table
from airhockey_marl.tables import Tables

SEATS = ("left", "right")
OBSERVATION_SIZE, ACTION_SIZE = 12, 2


def steps_of(round_seconds: float, table: Table, decision_ticks: int = 1) -> int:
    """Steps in `round_seconds`.

    Raises:
        ValueError: less than one step, or a step of less than a tick.
    """
    check_counts(decision_ticks=decision_ticks)
    check_numbers(round_seconds=round_seconds)
    steps = round(round_seconds / (decision_ticks * table.tick))
    if steps < 1:
        raise ValueError(f"round_seconds = {round_seconds} must be at least one step ({decision_ticks * table.tick} s)")
    return steps


class AirHockey(ParallelEnv):
    """One table, two agents; see the module's docstring for the spaces.

    Args:
        round_seconds: a round is truncated after so long.
        decision_ticks: ticks for which an action is held.
        table: sizes and limits; the defaults are those of `Table`.
        render_mode: `None` or `"rgb_array"`.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "air_hockey_v0", "render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        round_seconds: float = 60.0,
        decision_ticks: int = 1,
        table: Table | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r} must be None or 'rgb_array'")
        self.tables = Tables(1, table)
        self.decision_ticks = decision_ticks
        self.max_steps = steps_of(round_seconds, self.tables.table, decision_ticks)
        self.render_mode = render_mode
        self.possible_agents = list(SEATS)
        self.agents: list[str] = []
        self._steps = 0
        self._actions = np.zeros((1, 2, ACTION_SIZE), dtype=np.float32)
        self.observation_spaces = {seat: Box(-np.inf, np.inf, (OBSERVATION_SIZE,), dtype=np.float32) for seat in SEATS}
        self.action_spaces = {seat: Box(-1.0, 1.0, (ACTION_SIZE,), dtype=np.float32) for seat in SEATS}

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin a round; with `seed` the serves start from that seed, without it they go on."""
        if seed is not None:
            self.tables.seed(seed)
        self.tables.new_rounds()
        self._steps = 0
        self.agents = list(SEATS)
        return self._observe(), {seat: {} for seat in SEATS}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """Play one step. Actions outside [-1, 1] are clipped; one that is not a number means stay."""
        if not self.agents:
            raise RuntimeError("the round is over: call reset() first")
        left, right = actions.get("left"), actions.get("right")
        if not getattr(left, "shape", None) == getattr(right, "shape", None) == (ACTION_SIZE,):  # or lists of two
            for seat in SEATS:
                if np.shape(actions.get(seat)) != (ACTION_SIZE,):
                    raise ValueError(f"actions[{seat!r}]: {kind_of(actions.get(seat))}, must be numbers of shape (2,)")
        self._actions[0, LEFT], self._actions[0, RIGHT] = left, right
        self.tables.step(self._actions, self.decision_ticks)
        self._steps += 1
        goal = int(self.tables.goals[0])
        terminated, truncated = goal != 0, goal == 0 and self._steps >= self.max_steps
        if terminated or truncated:
            self.agents = []
        touched = int(self.tables.touched[0])
        return (
            self._observe(),
            {"left": float(goal), "right": float(-goal)},
            {"left": terminated, "right": terminated},
            {"left": truncated, "right": truncated},
            {"left": {"touched": bool(touched & 1)}, "right": {"touched": bool(touched & 2)}},
        )

    def render(self) -> np.ndarray | None:
        """The table from above as (height, width, 3) uint8, if `render_mode` asks for it."""
        return None if self.render_mode is None else draw_table(self.tables.bodies[0], self.tables.table)

    def _observe(self) -> dict[str, np.ndarray]:
        seen = np.empty((2, 1, OBSERVATION_SIZE), dtype=np.float32)
        self.tables.observe(LEFT, seen[LEFT])
        self.tables.observe(RIGHT, seen[RIGHT])
        return {"left": seen[LEFT, 0], "right": seen[RIGHT, 0]}


class AirHockeyTables(EnvBase):
    """n tables stepped together, batch size (n,), with `PettingZooWrapper`'s keys: (seat, "observation") and so on.

    Each seat is a group of one agent, hence the dimension of size 1: (n, 1, 12) observations, (n, 1, 2) actions,
    (n, 1, 1) rewards; done, terminated and truncated are (n, 1) and shared.

    Args:
        n: tables.
        round_seconds, decision_ticks, table: as for `AirHockey`.
        seed: of the serves.
    """

    def __init__(
        self,
        n: int,
        round_seconds: float = 60.0,
        decision_ticks: int = 1,
        table: Table | None = None,
        seed: int | None = None,
    ) -> None:
        check_counts(tables=n)
        check_counts(0, seed=0 if seed is None else seed)
        super().__init__(device="cpu", batch_size=[n])
        self.tables = Tables(n, table)
        self.decision_ticks = decision_ticks
        self.max_steps = steps_of(round_seconds, self.tables.table, decision_ticks)
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
        self.tables.step(self._actions, self.decision_ticks)
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
    backend: str, tables: int, round_seconds: float, decision_ticks: int, seed: int, table: Table | None = None
) -> EnvBase:
    """The batch of tables a collector steps.

    Args:
        backend: `"batched"` for `AirHockeyTables`, `"pettingzoo"` for that many `AirHockey` in a `SerialEnv`: the
            same trajectories, slowly, which is what one would use to put another PettingZoo game in this place.

    Raises:
        ValueError: an unknown backend.
    """
    check_counts(tables=tables)
    check_counts(0, seed=seed)
    if backend == "batched":
        return AirHockeyTables(tables, round_seconds, decision_ticks, table, seed)
    if backend == "pettingzoo":
        games = [partial(_wrapped, round_seconds, decision_ticks, table, seed + i) for i in range(tables)]
        env = SerialEnv(tables, games)
        env.start()
        return env
    raise ValueError(f"env.backend = {backend!r} must be 'batched' or 'pettingzoo'")


def serve_streams(env: EnvBase) -> list[np.ndarray]:
    """The random numbers of the tables of `make_env`, as views (uint64) to read and to set."""
    games = [env] if isinstance(env, AirHockeyTables) else [wrapped.unwrapped for wrapped in env._envs]
    return [game.tables.rng for game in games]


def _wrapped(round_seconds: float, decision_ticks: int, table: Table | None, seed: int) -> EnvBase:
    with warnings.catch_warnings():  # TorchRL was tested with PettingZoo 1.24.3; our tests cover the one installed
        warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested")
        game = AirHockey(round_seconds, decision_ticks, table)
        env = PettingZooWrapper(game, group_map={seat: [seat] for seat in SEATS}, use_mask=False)
    game.tables.seed(seed)  # not set_seed: it would play a serve
    return env
