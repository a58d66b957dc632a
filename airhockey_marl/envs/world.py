"""n tables side by side: serves, rounds, the referee, observations, and the step of all tables."""

from math import cos, floor, hypot, pi, sin

import numpy as np
from numba import njit

from airhockey_marl.envs.hand_arm import HandArm, move_hand
from airhockey_marl.envs.physics import (
    LEFT,
    PUCK,
    RIGHT,
    VX,
    VY,
    TableSpec,
    X,
    Y,
    check_table,
    clamp,
    compiled,
    step_physics,
)
from airhockey_marl.experiment.parallel import parallel_for
from airhockey_marl.experiment.validation import check_counts, check_numbers, check_rows, kind_of


@compiled
def random_unit(rng: np.ndarray, index: int) -> float:
    """A uniform number in [0, 1) from the stream `rng[index]`, by splitmix64 (Steele et al. 2014)."""
    rng[index] += np.uint64(0x9E3779B97F4A7C15)
    bits = rng[index]
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return floor((bits >> np.uint64(11)) * 1.0) * (1.0 / 9007199254740992.0)


@compiled
def serve(bodies: np.ndarray, rng: np.ndarray, index: int, table: TableSpec) -> None:
    """Serve: put the puck on the half-way line with random y, side, angle and speed; the paddles stay."""
    puck = bodies[PUCK]
    side = table.width / 2 - table.puck_radius
    speed = table.serve_speed_low + (table.serve_speed_high - table.serve_speed_low) * random_unit(rng, index)
    angle = (2.0 * random_unit(rng, index) - 1.0) * table.serve_angle
    if random_unit(rng, index) < 0.5:
        angle += pi
    puck[VX], puck[VY] = speed * cos(angle), speed * sin(angle)
    puck[X] = 0.0
    touching = table.puck_radius + table.paddle_radius
    for _ in range(8):  # not onto a paddle at the line
        puck[Y] = (2.0 * random_unit(rng, index) - 1.0) * 0.8 * side
        free = True
        for agent in (LEFT, RIGHT):
            free = free and hypot(puck[X] - bodies[agent, X], puck[Y] - bodies[agent, Y]) > touching
        if free:
            break


@compiled
def new_round(bodies: np.ndarray, timers: np.ndarray, rng: np.ndarray, index: int, table: TableSpec) -> None:
    """Begin a round: both paddles at rest in the middle of their sides, and a serve."""
    bodies[:, :] = 0.0
    bodies[LEFT, X], bodies[RIGHT, X] = -table.length / 4, table.length / 4
    timers[:] = 0.0
    serve(bodies, rng, index, table)


@compiled
def _new_rounds(bodies, timers, rng, mask, values):
    table = TableSpec(*values)
    for index in range(len(bodies)):
        if mask[index]:
            new_round(bodies[index], timers[index], rng, index, table)


@compiled
def referee(bodies: np.ndarray, timers: np.ndarray, rng: np.ndarray, index: int, table: TableSpec) -> bool:
    """Serve again, after a tick without a goal, if the puck has stalled or was kept in one half for too long.

    `timers` (3,) holds the seconds stalled, the seconds in the present half, and that half (-1, 1, or 0 for none yet).
    Returns whether it served.
    """
    puck = bodies[PUCK]
    timers[0] = timers[0] + table.tick if hypot(puck[VX], puck[VY]) < table.stall_speed else 0.0
    half = 1.0 if puck[X] > 0.0 else -1.0
    timers[1] = timers[1] + table.tick if half == timers[2] else 0.0
    timers[2] = half
    if timers[0] < table.stall_seconds and timers[1] < table.possession_seconds:
        return False
    timers[:] = 0.0
    serve(bodies, rng, index, table)
    return True


@compiled
def _write_target(target, agent, action_x, action_y, table):
    half_x, half_y = table.length / 4 - table.paddle_radius, table.width / 2 - table.paddle_radius
    turn = 1.0 if agent == LEFT else -1.0
    target[X] = turn * (clamp(action_x, -1.0, 1.0) * half_x - table.length / 4)
    target[Y] = turn * (clamp(action_y, -1.0, 1.0) * half_y)


@compiled
def _play_table(index, bodies, timers, rng, hands, actions, ticks, goals, touched, served, values, arm_values):
    table = TableSpec(*values)
    targets = np.empty((2, 2))
    for agent in (LEFT, RIGHT):
        _write_target(targets[agent], agent, actions[index, agent, X], actions[index, agent, Y], table)
    goals[index], touched[index], served[index] = 0, 0, False
    for _ in range(ticks):
        if arm_values is not None:  # decided when it is compiled
            arm = HandArm(*arm_values)
            for agent in (LEFT, RIGHT):
                hand = hands[index, agent]
                move_hand(hand, actions[index, agent], table.tick, arm)
                _write_target(targets[agent], agent, hand[X] / arm.reach, hand[Y] / arm.reach, table)
        goal, touch = step_physics(bodies[index], targets, table)
        touched[index] |= touch
        if goal != 0:
            goals[index] = goal
            break
        served[index] |= referee(bodies[index], timers[index], rng, index, table)


@njit(cache=True, nogil=True)
def _play_tables(indices, bodies, timers, rng, hands, actions, ticks, goals, touched, served, values, arm_values):
    for index in indices:
        _play_table(index, bodies, timers, rng, hands, actions, ticks, goals, touched, served, values, arm_values)


@compiled
def observe(bodies: np.ndarray, agent: int, out: np.ndarray) -> None:
    """Write an agent's observations of n tables into `out` (n, 12): own paddle, other paddle, puck, each x, y, vx, vy.

    In m and m/s from the table's center, x toward the opponent: the right agent observes the table after a half turn,
    so one model can play either side.
    """
    turn = 1.0 if agent == LEFT else -1.0
    for index in range(len(bodies)):
        for column in range(4):
            out[index, column] = turn * bodies[index, agent, column]
            out[index, 4 + column] = turn * bodies[index, 1 - agent, column]
            out[index, 8 + column] = turn * bodies[index, PUCK, column]


FLOATS = (np.dtype(np.float32), np.dtype(np.float64))  # those that compiled code takes
INTEGERS = (int, np.integer)  # made once: `step` checks against it every time


class World:
    """n independent tables, stepped together.

    Table i has its own stream of random numbers, so its play does not depend on the other tables.

    Args:
        n: number of tables.
        table: sizes and limits of all tables; `TableSpec()` by default.
        seed: see the method `seed`.
        arm: between every action and its paddle; None where the action is the paddle's desired position itself.

    Attributes:
        table: the `TableSpec`.
        bodies: (n, 3, 4) float64, the state: left paddle, right paddle and puck, each x, y, vx, vy in m and m/s.
        goals: (n,) int64, +1 if the left agent scored in the last `step`, -1 if the right one did, 0 otherwise.
        touched: (n,) int64, bits of `TOUCHED_BY`: the agents that hit the puck in the last `step`.
        served: (n,) bool, the puck was served again in the last `step`.
        timers: (n, 3) float64, the referee's memory, see `referee`.
        rng: (n,) uint64, states of the random numbers.
        hands: (n, 2, 4) float64, with an arm the hand of each agent, egocentric x, y, vx, vy in m and m/s.
    """

    PARALLEL_FROM = 256  # tables; below, starting the threads costs more than they save

    def __init__(
        self, n: int, table: TableSpec | None = None, seed: int | None = 0, arm: HandArm | None = None
    ) -> None:
        check_counts(tables=n)
        self.n, self.table = n, check_table(table or TableSpec())
        self._values = tuple(self.table)  # numba takes a plain tuple faster than a NamedTuple, by 1.5 us a call
        self._arm_values = None if arm is None else tuple(map(float, arm.check(self.table.tick)))
        self._all = np.arange(n)
        self.bodies = np.zeros((n, 3, 4))
        self.timers = np.zeros((n, 3))
        self.rng = np.zeros(n, dtype=np.uint64)
        self.hands = np.zeros((n, 2, 4))
        self.goals = np.zeros(n, dtype=np.int64)
        self.touched = np.zeros(n, dtype=np.int64)
        self.served = np.zeros(n, dtype=np.bool_)
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """Seed the random numbers: table i gets `seed` + i, as in vector environments; None takes one from entropy."""
        if seed is None:
            seed = np.random.SeedSequence().entropy
        check_counts(0, seed=seed)
        seeds = np.arange(self.n, dtype=np.uint64) + np.uint64(int(seed) % 2**63)
        self.rng[:] = (seeds + np.uint64(1)) * np.uint64(0xD1342543DE82EF95)  # far apart in splitmix64's period

    def new_rounds(self, mask: np.ndarray | None = None) -> None:
        """Begin a round at the tables of a boolean mask (n,), by default at all."""
        mask = np.ones(self.n, dtype=bool) if mask is None else mask
        if not isinstance(mask, np.ndarray) or mask.shape != (self.n,) or mask.dtype != bool:
            raise ValueError(f"mask: {kind_of(mask)}, must be bools of shape {(self.n,)}")
        _new_rounds(self.bodies, self.timers, self.rng, mask, self._values)
        if self._arm_values is not None:
            self.hands[mask] = 0.0  # at rest in the middle, as the paddles are

    def step(self, actions: np.ndarray, ticks: int = 1, indices: np.ndarray | None = None) -> None:
        """Play one tick, or several with the same actions; a table stops at a goal.

        Args:
            actions: (n, 2, 2) float, for each agent the desired position of its paddle, or with an arm of its hand,
                egocentric, in [-1, 1]; values outside are clipped, NaN means stay, or with an arm no force.
            ticks: of `table.tick` seconds.
            indices: (k,) int64, the tables to step, by default all; the others do not change.
        """
        # checked, because compiled code would access foreign memory
        if not isinstance(actions, np.ndarray) or actions.shape != (self.n, 2, 2) or actions.dtype not in FLOATS:
            raise ValueError(f"actions: {kind_of(actions)}, must be numpy float32 or float64 of shape {(self.n, 2, 2)}")
        if indices is None:
            indices = self._all
        else:
            check_rows("indices", indices, self.n)
        if not isinstance(ticks, INTEGERS) or ticks < 0:
            raise ValueError(f"ticks = {ticks!r} must be a whole number of at least 0")
        results = self.goals, self.touched, self.served
        state = self.bodies, self.timers, self.rng, self.hands
        arguments = (*state, actions, ticks, *results, self._values, self._arm_values)
        parallel_for(_play_tables, indices, *arguments, least=self.PARALLEL_FROM // 2)

    def observe(self, agent: int, out: np.ndarray) -> np.ndarray:
        """Write the observations of `agent` (`LEFT` or `RIGHT`) into `out` (n, 12) and return it; see `observe`."""
        if agent not in (LEFT, RIGHT):
            raise ValueError(f"agent = {agent!r} must be {LEFT} or {RIGHT}")
        if not isinstance(out, np.ndarray) or out.shape != (self.n, 12) or out.dtype not in FLOATS:
            raise ValueError(f"out: {kind_of(out)}, must be numpy float32 or float64 of shape {(self.n, 12)}")
        observe(self.bodies, agent, out)
        return out


AGENTS = ("left", "right")
OBSERVATION_SIZE, ACTION_SIZE = 12, 2


def round_steps(round_seconds: float, table: TableSpec, frame_skip: int = 1) -> int:
    """Number of steps of `frame_skip` ticks in `round_seconds`; raises a ValueError if it is less than one."""
    check_counts(frame_skip=frame_skip)
    check_numbers(round_seconds=round_seconds)
    steps = round(round_seconds / (frame_skip * table.tick))
    if steps < 1:
        raise ValueError(f"round_seconds = {round_seconds} must be at least one step ({frame_skip * table.tick} s)")
    return steps
