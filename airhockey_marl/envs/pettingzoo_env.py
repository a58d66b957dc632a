"""Two-player air hockey, as a PettingZoo environment and as a batch of tables for TorchRL.

Agents        `left` and `right`; both see the table from their own seat, so one model can play either.
Observation   float32 (12,), in m and m/s from the table's center, x toward the opponent, y to one's left:
                0-3   own paddle         x, y, vx, vy
                4-7   opponent's paddle  x, y, vx, vy
                8-11  puck               x, y, vx, vy
Action        float32 (2,) in [-1, 1]: the desired position of the own paddle; 0 is the midpoint of the own side,
              +-1 where the paddle meets the walls, the half-way line or the end (section 3.1 of the paper).
Reward        +1 for a goal, -1 for a goal conceded, 0 otherwise.
An episode    is a round: it terminates with a goal, and is truncated after `round_seconds`.
A step        is one decision: `frame_skip` ticks of 20 ms, one unless asked for otherwise.

`AirHockey` is one table behind PettingZoo's parallel API; `AirHockeyEnv` is n tables behind TorchRL's `EnvBase`,
with the keys that TorchRL's `PettingZooWrapper` gives. Both play on `tables.Tables`, and with the same seeds and
actions their trajectories are equal bit for bit: table i of a batch seeded with s plays as an `AirHockey` with s + i.
"""

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.rendering import draw_table
from airhockey_marl.envs.world import ACTION_SIZE, OBSERVATION_SIZE, SEATS, World, round_steps
from airhockey_marl.experiment.validation import kind_of


class AirHockey(ParallelEnv):
    """One table, two agents; see the module's docstring for the spaces.

    Args:
        round_seconds: a round is truncated after so long.
        frame_skip: ticks for which an action is held.
        table: sizes and limits; the defaults are those of `TableSpec`.
        render_mode: `None` or `"rgb_array"`.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "air_hockey_v0", "render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        round_seconds: float = 60.0,
        frame_skip: int = 1,
        table: TableSpec | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r} must be None or 'rgb_array'")
        self.tables = World(1, table)
        self.frame_skip = frame_skip
        self.max_steps = round_steps(round_seconds, self.tables.table, frame_skip)
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
        self.tables.step(self._actions, self.frame_skip)
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
