"""Two-player air hockey as a PettingZoo environment (parallel API).

Agents        `left` and `right`; each observes the table from its own end, so one model can play either.
Observation   float32 (12,), in m and m/s from the table's center, x toward the opponent, y to the agent's left:
                index  body               values
                0-3    own paddle         x, y, vx, vy
                4-7    opponent's paddle  x, y, vx, vy
                8-11   puck               x, y, vx, vy
Action        float32 (2,) in [-1, 1]: desired position of the own paddle, 0 at the midpoint of the own side, +-1 at
              the bounds of the paddle's center (section 3.1 of the paper). Values outside are clipped, NaN means stay.
              With an `arm`, that of the own hand, whose position is then the paddle's desired one.
Reward        +1 for a goal scored, -1 for a goal conceded, 0 otherwise.
Episode       one round: terminates with a goal, is truncated after `round_seconds` (default 60 s).
Step          `frame_skip` ticks of 20 ms with the same action (default 1).
Start         paddles at rest at the midpoints of their sides; the puck is served from the half-way line.
Info          `touched`: whether the agent's paddle hit the puck in this step.

`torchrl_env.AirHockeyEnv` is a batch of n such tables behind TorchRL's `EnvBase`. Both play on `world.World`, and with
the same seeds and actions their trajectories are equal bit for bit: table i of a batch seeded with s plays like an
`AirHockey` seeded with s + i. A seed is an integer of at least 0. An environment that was never seeded takes one from
the operating system's entropy, and `reset` without a seed goes on with the random numbers.
"""

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.rendering import TableWindow, draw_table
from airhockey_marl.envs.world import ACTION_SIZE, AGENTS, OBSERVATION_SIZE, World, round_steps
from airhockey_marl.experiment.validation import kind_of


class AirHockey(ParallelEnv):
    """One table with two agents; the module's docstring describes the spaces.

    Args:
        round_seconds: length of a round in s, after which it is truncated.
        frame_skip: ticks per step.
        table: sizes and limits; `TableSpec()` by default.
        render_mode: None, "rgb_array", or "human" for a window in which `reset` and `step` show the table at the
            speed of a real one.
        arm: between the actions and the paddles, see `World`; None for none.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "air_hockey_v0",
        "render_modes": ["human", "rgb_array"],
        "render_fps": 50,  # with a `frame_skip` of 1
    }

    def __init__(
        self,
        round_seconds: float = 60.0,
        frame_skip: int = 1,
        table: TableSpec | None = None,
        render_mode: str | None = None,
        arm: HandArm | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode = {render_mode!r} must be None, 'human' or 'rgb_array'")
        self.world = World(1, table, seed=None, arm=arm)
        self.frame_skip = frame_skip
        self.max_steps = round_steps(round_seconds, self.world.table, frame_skip)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": 1 / (frame_skip * self.world.table.tick)}
        self._window = TableWindow(self.world.table, self.metadata["render_fps"]) if render_mode == "human" else None
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._steps = 0
        self._actions = np.zeros((1, 2, ACTION_SIZE), dtype=np.float32)
        self.observation_spaces = {
            agent: Box(-np.inf, np.inf, (OBSERVATION_SIZE,), dtype=np.float32) for agent in AGENTS
        }
        self.action_spaces = {agent: Box(-1.0, 1.0, (ACTION_SIZE,), dtype=np.float32) for agent in AGENTS}

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin a round and return observations and infos; a `seed` restarts the random numbers of the serves."""
        if seed is not None:
            self.world.seed(seed)
        self.world.new_rounds()
        self._steps = 0
        self.agents = list(AGENTS)
        self._show()
        return self._observe(), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """Play one step; returns observations, rewards, terminations, truncations and infos by agent.

        Without agents, after a round, no actions are right, and all that is returned is empty.
        """
        if not self.agents:
            if not actions:
                return {}, {}, {}, {}, {}
            raise RuntimeError("the round is over: call reset() first")
        left, right = actions.get("left"), actions.get("right")
        if not getattr(left, "shape", None) == getattr(right, "shape", None) == (ACTION_SIZE,):  # or sequences of two
            for agent in AGENTS:
                if np.shape(actions.get(agent)) != (ACTION_SIZE,):
                    raise ValueError(
                        f"actions[{agent!r}]: {kind_of(actions.get(agent))}, must be numbers of shape (2,)"
                    )
        try:
            self._actions[0, LEFT], self._actions[0, RIGHT] = left, right
        except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError of torch: a tensor that requires grad
            raise ValueError(f"actions: {error}") from error
        self.world.step(self._actions, self.frame_skip)
        self._steps += 1
        goal = int(self.world.goals[0])
        terminated, truncated = goal != 0, goal == 0 and self._steps >= self.max_steps
        if terminated or truncated:
            self.agents = []
        self._show()
        touched = int(self.world.touched[0])
        return (
            self._observe(),
            {"left": float(goal), "right": float(-goal)},
            {"left": terminated, "right": terminated},
            {"left": truncated, "right": truncated},
            {"left": {"touched": bool(touched & 1)}, "right": {"touched": bool(touched & 2)}},
        )

    def render(self) -> np.ndarray | None:
        """The table from above as (height, width, 3) uint8 in the mode "rgb_array"; in "human", drawn in its window."""
        if self.render_mode == "rgb_array":
            return draw_table(self.world.bodies[0], self.world.table)
        if self._window is not None:
            self._window.draw(self.world.bodies[0])
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        if self._window is not None:
            self.render()
            self._window.wait()

    def _observe(self) -> dict[str, np.ndarray]:
        observation = np.empty((2, 1, OBSERVATION_SIZE), dtype=np.float32)
        self.world.observe(LEFT, observation[LEFT])
        self.world.observe(RIGHT, observation[RIGHT])
        return {"left": observation[LEFT, 0], "right": observation[RIGHT, 0]}
