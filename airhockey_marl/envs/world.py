"""Tables side by side: rounds and serves, the referee, what each seat sees, and one step for all of them."""

from math import cos, floor, hypot, pi, sin
from numbers import Integral

import numpy as np
from numba import njit

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
def random_unit(rng, index):
    """A uniform number in [0, 1) from the table's own stream: splitmix64 (Steele et al. 2014) on `rng[index]`."""
    rng[index] += np.uint64(0x9E3779B97F4A7C15)
    bits = rng[index]
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return floor((bits >> np.uint64(11)) * 1.0) * (1.0 / 9007199254740992.0)


@compiled
def serve(bodies, rng, index, table):
    """Put the puck on the half-way line, at a random place, moving toward a random side; the paddles stay."""
    puck = bodies[PUCK]
    side = table.width / 2 - table.puck_radius
    speed = table.serve_speed_low + (table.serve_speed_high - table.serve_speed_low) * random_unit(rng, index)
    angle = (2.0 * random_unit(rng, index) - 1.0) * table.serve_angle
    if random_unit(rng, index) < 0.5:
        angle += pi
    puck[VX], puck[VY] = speed * cos(angle), speed * sin(angle)
    puck[X] = 0.0
    touching = table.puck_radius + table.paddle_radius
    for _ in range(8):  # not onto a paddle that waits at the line
        puck[Y] = (2.0 * random_unit(rng, index) - 1.0) * 0.8 * side
        free = True
        for seat in (LEFT, RIGHT):
            free = free and hypot(puck[X] - bodies[seat, X], puck[Y] - bodies[seat, Y]) > touching
        if free:
            break


@compiled
def new_round(bodies, watch, rng, index, table):
    """Begin a round: both paddles at rest in the middle of their side, and a serve."""
    bodies[:, :] = 0.0
    bodies[LEFT, X], bodies[RIGHT, X] = -table.length / 4, table.length / 4
    watch[:] = 0.0
    serve(bodies, rng, index, table)


@compiled
def _new_rounds(bodies, watch, rng, which, values):
    table = TableSpec(*values)
    for index in range(len(bodies)):
        if which[index]:
            new_round(bodies[index], watch[index], rng, index, table)


@compiled
def referee(bodies, watch, rng, index, table):
    """After a tick without a goal: serve again if the puck has stalled, or was kept in one half for too long.

    `watch` (3,) is what the referee remembers: seconds stalled, seconds in this half, and which half (-1, 0, 1).
    Returns whether it served.
    """
    puck = bodies[PUCK]
    watch[0] = watch[0] + table.tick if hypot(puck[VX], puck[VY]) < table.stall_speed else 0.0
    half = 1.0 if puck[X] > 0.0 else -1.0
    watch[1] = watch[1] + table.tick if half == watch[2] else 0.0
    watch[2] = half
    if watch[0] < table.stall_seconds and watch[1] < table.possession_seconds:
        return False
    watch[:] = 0.0
    serve(bodies, rng, index, table)
    return True


@compiled
def _play_table(index, bodies, watch, rng, actions, ticks, goals, touched, served, values):
    table = TableSpec(*values)
    targets = np.empty((2, 2))
    half_x, half_y = table.length / 4 - table.paddle_radius, table.width / 2 - table.paddle_radius
    for seat in (LEFT, RIGHT):
        turn = 1.0 if seat == LEFT else -1.0
        targets[seat, X] = turn * (clamp(actions[index, seat, X], -1.0, 1.0) * half_x - table.length / 4)
        targets[seat, Y] = turn * (clamp(actions[index, seat, Y], -1.0, 1.0) * half_y)
    goals[index], touched[index], served[index] = 0, 0, False
    for _ in range(ticks):
        goal, touch = step_physics(bodies[index], targets, table)
        touched[index] |= touch
        if goal != 0:
            goals[index] = goal
            break
        served[index] |= referee(bodies[index], watch[index], rng, index, table)


@njit(cache=True, nogil=True)
def _play_tables(rows, bodies, watch, rng, actions, ticks, goals, touched, served, values):
    for index in rows:
        _play_table(index, bodies, watch, rng, actions, ticks, goals, touched, served, values)


@compiled
def observe(bodies, seat, out):
    """Write the 12 numbers a seat sees into `out` (n, 12): own paddle, other paddle, puck, each x, y, vx, vy.

    In m and m/s from the table's center, x toward the opponent: the right seat sees the table after a half turn, so
    one model can play either seat.
    """
    turn = 1.0 if seat == LEFT else -1.0
    for index in range(len(bodies)):
        for column in range(4):
            out[index, column] = turn * bodies[index, seat, column]
            out[index, 4 + column] = turn * bodies[index, 1 - seat, column]
            out[index, 8 + column] = turn * bodies[index, PUCK, column]


WHOLE = (int, np.integer)  # a tuple, made once: what is asked of every step


class World:
    """n tables side by side, each with its own stream of random numbers.

    Attributes:
        bodies: (n, 3, 4) float64, see the module's docstring.
        goals, touched, served: (n,) what the last `step` brought: +1/-1/0, bits of `TOUCHED_BY`, bool.
    """

    PARALLEL_FROM = 256  # tables; below, starting the threads costs more than they save

    def __init__(self, n: int, table: TableSpec | None = None) -> None:
        if not isinstance(n, Integral) or isinstance(n, bool) or n < 1:
            raise ValueError(f"tables = {n!r} must be at least 1")
        self.n, self.table = n, check_table(table or TableSpec())
        self._values = tuple(self.table)  # numba takes a plain tuple faster than a NamedTuple, by 1.5 us a call
        self._all = np.arange(n)
        self.bodies = np.zeros((n, 3, 4))
        self.watch = np.zeros((n, 3))
        self.rng = np.zeros(n, dtype=np.uint64)
        self.goals = np.zeros(n, dtype=np.int64)
        self.touched = np.zeros(n, dtype=np.int64)
        self.served = np.zeros(n, dtype=np.bool_)
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Give table i the stream of seed + i, as vector environments do."""
        if not isinstance(seed, Integral):
            raise ValueError(f"seed = {seed!r} must be a whole number")
        seeds = np.arange(self.n, dtype=np.uint64) + np.uint64(seed % 2**63)
        self.rng[:] = (seeds + np.uint64(1)) * np.uint64(0xD1342543DE82EF95)  # far apart in splitmix64's period

    def new_rounds(self, which: np.ndarray | None = None) -> None:
        """Begin a round at the tables of the boolean mask `which` (n,); at all of them without it."""
        which = np.ones(self.n, dtype=bool) if which is None else which
        if not isinstance(which, np.ndarray) or which.shape != (self.n,) or which.dtype != bool:
            raise ValueError(f"which: {kind_of(which)}, must be bools of shape {(self.n,)}")
        _new_rounds(self.bodies, self.watch, self.rng, which, self._values)

    def step(self, actions: np.ndarray, ticks: int = 1, rows: np.ndarray | None = None) -> None:
        """Play a tick, or several with the same actions; a table stops at a goal.

        `actions` (n, 2, 2) float is the wanted paddle position of each seat, egocentric, in [-1, 1]. `rows` (int64)
        are the tables that play, all of them if None; at the others time stands still.

        Raises:
            ValueError: a shape, a type or a number is another one: compiled code would write where nothing is.
        """
        if not isinstance(actions, np.ndarray) or actions.shape != (self.n, 2, 2) or actions.dtype.kind != "f":
            raise ValueError(f"actions: {kind_of(actions)}, must be an array of floats of shape {(self.n, 2, 2)}")
        if rows is None:
            rows = self._all
        else:
            check_rows("rows", rows, self.n)
        if not isinstance(ticks, WHOLE) or ticks < 0:
            raise ValueError(f"ticks = {ticks!r} must be a whole number of at least 0")
        arguments = (
            self.bodies,
            self.watch,
            self.rng,
            actions,
            ticks,
            self.goals,
            self.touched,
            self.served,
            self._values,
        )
        parallel_for(_play_tables, rows, *arguments, least=self.PARALLEL_FROM // 2)

    def observe(self, seat: int, out: np.ndarray) -> np.ndarray:
        """Write what `seat` sees into `out` (n, 12) and return it."""
        if seat not in (LEFT, RIGHT):
            raise ValueError(f"seat = {seat!r} must be {LEFT} or {RIGHT}")
        if not isinstance(out, np.ndarray) or out.shape != (self.n, 12) or out.dtype.kind != "f":
            raise ValueError(f"out: {kind_of(out)}, must be an array of floats of shape {(self.n, 12)}")
        observe(self.bodies, seat, out)
        return out


SEATS = ("left", "right")
OBSERVATION_SIZE, ACTION_SIZE = 12, 2


def round_steps(round_seconds: float, table: TableSpec, frame_skip: int = 1) -> int:
    """Steps in `round_seconds`.

    Raises:
        ValueError: less than one step, or a step of less than a tick.
    """
    check_counts(frame_skip=frame_skip)
    check_numbers(round_seconds=round_seconds)
    steps = round(round_seconds / (frame_skip * table.tick))
    if steps < 1:
        raise ValueError(f"round_seconds = {round_seconds} must be at least one step ({frame_skip * table.tick} s)")
    return steps
