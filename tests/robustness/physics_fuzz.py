"""Fuzz the physics: random tables, states and targets; each tick is checked, some against a simpler integrator.

    python -m tests.robustness.physics_fuzz 100000000        number of ticks; prints the findings as JSON

The reference divides each sub-step into many small ones, checks at each whether the puck overlaps something, and finds
the time of a contact by bisection: no roots, no cases, and little in common with `airhockey_marl.envs.physics`. It runs
twice, the second time with another step size and from a slightly shifted state: where the two differ, no integrator can
know the outcome, and the tick is counted as unknowable instead of compared.
"""

import json
import sys
import time
from math import hypot

import numpy as np
from numba import njit

from airhockey_marl.envs.physics import (
    LEFT,
    MAX_VALUES,
    PUCK,
    RIGHT,
    VX,
    VY,
    TableSpec,
    X,
    Y,
    _drive_paddle,
    _own_half,
    check_table,
    step_physics,
)
from airhockey_marl.envs.world import random_unit

TICKS = 50  # per episode
EPISODES = 100  # per table
COMPARED = 50  # one tick in so many is compared with the reference
SMALL_STEPS, OTHER_STEPS = 50, 171  # per sub-step, of the two runs of the reference
SHIFT = 1e-9  # m, of the second run
# Known deviations, kept because mending them would change the bits of ordinary play: a puck that drifts out of the
# mouth of a goal slides around the post instead of bouncing off it (MISSED_POST), and the goal of a puck that a paddle
# squeezes past a post may come a tick late (SQUEEZED).
UNKNOWABLE, MISSED_POST, SQUEEZED = -1, -2, -3
FINE, PUCK_NAN, PUCK_OUTSIDE, PADDLE_OUTSIDE, PADDLE_FAST, ENERGY, FAR_OFF, WRONG_GOAL, SHIFTED = range(9)
NAMES = (
    "fine",
    "not a number",
    "puck outside",
    "paddle outside",
    "paddle too fast",
    "energy gained without a touch",
    "not where the reference puts it",
    "another goal than the reference's",
    "moved further than its speed allows",
)

compiled = njit(cache=True, error_model="numpy", nogil=True)


def random_tables(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, fields) tables that `check_table` accepts: some fields at their defaults, others anywhere in their range."""
    tables = []
    default = np.array(TableSpec(), dtype=float)
    while len(tables) < n:
        values = default.copy()
        for place in np.flatnonzero(rng.random(len(default)) < rng.uniform(0, 0.6)):
            name = TableSpec._fields[place]
            lowest = 1.0 if name == "substeps" else 1e-9
            highest = 1.0 if name.endswith("restitution") else MAX_VALUES[name]
            kind = rng.random()
            if kind < 0.1:
                values[place] = highest
            elif kind < 0.2:
                values[place] = lowest
            elif kind < 0.6 or name.endswith("restitution"):
                values[place] = np.exp(rng.uniform(np.log(lowest), np.log(highest)))
                if name.endswith("restitution"):
                    values[place] = rng.random()
            else:
                values[place] *= np.exp(rng.normal(0, 1))
        # mostly few sub-steps, because the time of a tick grows with their number
        values[-1] = round(values[-1]) if rng.random() < 0.01 else rng.integers(1, 9)
        try:
            check_table(TableSpec(*values[:-1], int(values[-1])))
        except ValueError:
            continue
        tables.append(values)
    return np.array(tables)


@compiled
def table_of(v):
    # fmt: off
    return TableSpec(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12], v[13],
                     v[14], v[15], v[16], v[17], int(v[18]))
    # fmt: on


@compiled
def overlap(bodies, seat, table):
    gap = hypot(bodies[PUCK, X] - bodies[seat, X], bodies[PUCK, Y] - bodies[seat, Y])
    return table.puck_radius + table.paddle_radius - gap


@compiled
def begin(bodies, rng, table):
    """Draw a legal state: paddles in their halves, the puck on the table and in no paddle; False if none was found."""
    for seat in (LEFT, RIGHT):
        low, high, side = _own_half(seat, table)
        bodies[seat, X] = low + (high - low) * random_unit(rng, 0)
        bodies[seat, Y] = side * (2 * random_unit(rng, 0) - 1)
        angle, speed = 2 * np.pi * random_unit(rng, 0), table.paddle_speed * random_unit(rng, 0)
        bodies[seat, VX], bodies[seat, VY] = speed * np.cos(angle), speed * np.sin(angle)
    side, end = table.width / 2 - table.puck_radius, table.length / 2 - table.puck_radius
    angle, speed = 2 * np.pi * random_unit(rng, 0), 10 ** (4 * random_unit(rng, 0) - 2)
    bodies[PUCK, VX], bodies[PUCK, VY] = speed * np.cos(angle), speed * np.sin(angle)
    for _ in range(50):
        bodies[PUCK, X] = end * (2 * random_unit(rng, 0) - 1)
        bodies[PUCK, Y] = side * (2 * random_unit(rng, 0) - 1)
        if overlap(bodies, LEFT, table) <= 0 and overlap(bodies, RIGHT, table) <= 0:
            return True
    return False


@compiled
def aim(bodies, targets, rng, table):
    """Draw legal targets, and sometimes one far off the table, none (NaN), or the place of the puck."""
    for seat in (LEFT, RIGHT):
        low, high, side = _own_half(seat, table)
        kind = random_unit(rng, 0)
        targets[seat, X] = low + (high - low) * random_unit(rng, 0)
        targets[seat, Y] = side * (2 * random_unit(rng, 0) - 1)
        if kind < 0.1:
            targets[seat] = np.nan
        elif kind < 0.2:
            targets[seat] *= 100
        elif kind < 0.5:
            targets[seat] = bodies[PUCK, :2]


@compiled
def find_contact(x, y, vx, vy, bodies, ahead, table):
    """What the puck overlaps and moves into, `ahead` seconds on: (index or -1, normal x, y, its velocity x, y)."""
    px, py = x + vx * ahead, y + vy * ahead
    for seat in (LEFT, RIGHT):
        wx, wy = bodies[seat, VX], bodies[seat, VY]
        nx, ny = px - bodies[seat, X] - wx * ahead, py - bodies[seat, Y] - wy * ahead
        gap = hypot(nx, ny)
        if 0 < gap < table.puck_radius + table.paddle_radius and (vx - wx) * nx + (vy - wy) * ny < 0:
            return seat, nx / gap, ny / gap, wx, wy
    if abs(py) > table.width / 2 - table.puck_radius and py * vy > 0:
        return 2, 0.0, (-1.0 if py > 0 else 1.0), 0.0, 0.0
    end = table.length / 2
    if abs(py) >= table.goal / 2 and abs(px) > end - table.puck_radius and px * vx > 0:
        return 3, (-1.0 if px > 0 else 1.0), 0.0, 0.0, 0.0
    for post_x in (-end, end):
        for post_y in (-table.goal / 2, table.goal / 2):
            nx, ny = px - post_x, py - post_y
            gap = hypot(nx, ny)
            if 0 < gap < table.puck_radius and vx * nx + vy * ny < 0:
                return 4, nx / gap, ny / gap, 0.0, 0.0
    return -1, 0.0, 0.0, 0.0, 0.0


@compiled
def time_to_nearest(puck, bodies, small, table):
    """Time within `small` s at which the puck is nearest to a paddle or post that it then touches; else `small`."""
    for thing in range(6):
        if thing < 2:
            x, y, vx, vy = bodies[thing, X], bodies[thing, Y], bodies[thing, VX], bodies[thing, VY]
        else:
            x, y = table.length / 2 * (1 if thing < 4 else -1), table.goal / 2 * (1 if thing % 2 else -1)
            vx = vy = 0.0
        x, y, vx, vy = puck[X] - x, puck[Y] - y, puck[VX] - vx, puck[VY] - vy
        speed2 = vx * vx + vy * vy
        ahead = -0.999999 * (x * vx + y * vy) / speed2 if speed2 > 0 else 0.0
        if 0 < ahead < small and find_contact(puck[X], puck[Y], puck[VX], puck[VY], bodies, ahead, table)[0] >= 0:
            small = ahead
    return small


@compiled
def reference(bodies, targets, table, steps):
    """Advance a tick in small steps, in place: (goal, most contacts in a sub-step, met a post on the way out)."""
    dt, most, met, puck = table.tick / table.substeps, 0, False, bodies[PUCK]
    for _ in range(table.substeps):
        for seat in (LEFT, RIGHT):
            to_x, to_y = targets[seat, X], targets[seat, Y]
            if not (np.isfinite(to_x) and np.isfinite(to_y)):
                to_x, to_y = bodies[seat, X], bodies[seat, Y]
            _drive_paddle(bodies[seat], seat, to_x, to_y, dt, table)
        speed = hypot(puck[VX], puck[VY])
        if speed > 0:
            slower = max(0.0, speed - dt * (table.drag * speed + table.friction)) / speed
            puck[VX] *= slower
            puck[VY] *= slower
        contacts, left = 0, dt
        while left > 0:
            small = time_to_nearest(puck, bodies, min(left, dt / steps), table)
            which, _, _, _, _ = find_contact(puck[X], puck[Y], puck[VX], puck[VY], bodies, small, table)
            if which >= 0:
                low, high = 0.0, small
                for _ in range(60):
                    middle = (low + high) / 2
                    if find_contact(puck[X], puck[Y], puck[VX], puck[VY], bodies, middle, table)[0] >= 0:
                        high = middle
                    else:
                        low = middle
                which, nx, ny, wx, wy = find_contact(puck[X], puck[Y], puck[VX], puck[VY], bodies, high, table)
                small = high
            for body in range(3):
                bodies[body, X] += bodies[body, VX] * small
                bodies[body, Y] += bodies[body, VY] * small
            left -= small
            if abs(puck[X]) > table.length / 2:
                return (1 if puck[X] > 0 else -1), most, met
            if which >= 0:
                elastic = table.paddle_restitution if which <= RIGHT else table.wall_restitution
                met = met or (which == 4 and puck[X] * puck[VX] <= 0)
                into = (puck[VX] - wx) * nx + (puck[VY] - wy) * ny
                puck[VX] -= (1 + elastic) * into * nx
                puck[VY] -= (1 + elastic) * into * ny
                contacts += 1
                most = max(most, contacts)
                if contacts > 3:
                    return 0, most, met
    return 0, most, met


@compiled
def check_tick(before, bodies, goal, touched, still, table):
    """Fault of a tick that shows without a reference."""
    for body in range(3):
        for column in range(4):
            if not np.isfinite(bodies[body, column]):
                return PUCK_NAN
    room = 1e-9 * max(1.0, table.length, table.width)
    puck, end = bodies[PUCK], table.length / 2
    if goal == 0 and abs(puck[Y]) > table.width / 2 - table.puck_radius + room:
        return PUCK_OUTSIDE
    squeezed = (
        goal == 0 and touched != 0 and abs(puck[Y]) < table.goal / 2 and abs(before[PUCK, X]) <= end < abs(puck[X])
    )
    furthest = end if abs(puck[Y]) < table.goal / 2 else end - table.puck_radius
    if goal == 0 and not squeezed and abs(puck[X]) > furthest + room:
        return PUCK_OUTSIDE
    if goal != 0:  # a fast puck is beyond the line already; it must have crossed it in the mouth
        crossed = puck[Y] - puck[VY] * (puck[X] - goal * end) / puck[VX]
        if goal * puck[X] <= end:
            return PUCK_OUTSIDE
        if abs(crossed) > table.goal / 2 + room:
            squeezed = touched != 0 or max(overlap(before, LEFT, table), overlap(before, RIGHT, table)) > 0
            squeezed = squeezed or abs(before[PUCK, X]) > end
            if not squeezed:
                return PUCK_OUTSIDE
    for seat in (LEFT, RIGHT):
        low, high, side = _own_half(seat, table)
        if not (low - room <= bodies[seat, X] <= high + room and abs(bodies[seat, Y]) <= side + room):
            return PADDLE_OUTSIDE
        if hypot(bodies[seat, VX], bodies[seat, VY]) > table.paddle_speed * (1 + 1e-9):
            return PADDLE_FAST
    was, now = hypot(before[PUCK, VX], before[PUCK, VY]), hypot(puck[VX], puck[VY])
    if touched == 0 or still:
        if now > was * (1 + 1e-12):
            return ENERGY
        flew = hypot(puck[X] - before[PUCK, X], puck[Y] - before[PUCK, Y])
        if touched == 0 and flew > was * table.tick * (1 + 1e-9) + room:
            unmoved = overlap(before, LEFT, table) <= 0 and overlap(before, RIGHT, table) <= 0
            unmoved = unmoved and abs(before[PUCK, X]) < end - table.puck_radius  # nor off a post, see MISSED_POST
            for seat in (LEFT, RIGHT):  # else a squeeze, out of which the physics moves the puck
                unmoved = unmoved and overlap(bodies, seat, table) < -room
            if unmoved:
                return SHIFTED
    elif now > was + (1 + table.paddle_restitution) * table.paddle_speed * 8 * table.substeps:
        return ENERGY
    return SQUEEZED if squeezed else FINE


@compiled
def compare_tick(before, bodies, goal, targets, table):
    """Fault of a tick against the reference; UNKNOWABLE where no integrator can know the outcome, or MISSED_POST."""
    one, other = before.copy(), before.copy()
    for seat in (LEFT, RIGHT):
        if overlap(before, seat, table) > 0:  # squeezed before the tick
            return UNKNOWABLE
    fastest = max(table.paddle_speed, hypot(before[PUCK, VX], before[PUCK, VY]))
    if 2 * fastest * table.tick / table.substeps / SMALL_STEPS > table.puck_radius:
        return UNKNOWABLE  # the reference itself would step over bodies
    other[PUCK, X] += SHIFT
    other[PUCK, Y] -= SHIFT
    goal_one, contacts, met = reference(one, targets, table, SMALL_STEPS)
    goal_other, others, _ = reference(other, targets, table, OTHER_STEPS)
    if contacts > 3 or others > 3 or goal_one != goal_other:
        return UNKNOWABLE
    for column in range(4):
        if abs(one[PUCK, column] - other[PUCK, column]) > 1e-6:
            return UNKNOWABLE
    fault = FINE
    if goal != goal_one:
        fault = WRONG_GOAL
    elif goal == 0:
        for column in range(2):
            if abs(one[PUCK, column] - bodies[PUCK, column]) > 1e-4:
                fault = FAR_OFF
    return MISSED_POST if fault != FINE and met else fault


@compiled
def play(values, seed, ticks, compared):
    """Play an episode: (fault, its tick, ticks played, compared, unknowable, missed posts, squeezed goals)."""
    table, rng = table_of(values), np.array([seed], dtype=np.uint64)
    bodies, targets = np.zeros((3, 4)), np.zeros((2, 2))
    known = unknown = missed = squeezed = 0
    if not begin(bodies, rng, table):
        return FINE, 0, 0, 0, 0, 0, 0
    still = random_unit(rng, 0) < 0.25
    if still:
        bodies[:PUCK, VX:] = 0.0
        targets[:] = np.nan
    for number in range(ticks):
        if not still and random_unit(rng, 0) < 0.3:
            aim(bodies, targets, rng, table)
        before = bodies.copy()
        goal, touched = step_physics(bodies, targets, table)
        fault = check_tick(before, bodies, goal, touched, still, table)
        squeezed += fault == SQUEEZED
        fault = max(fault, FINE)
        if fault == FINE and random_unit(rng, 0) * compared < 1.0:
            fault = compare_tick(before, bodies, goal, targets, table)
            unknown += fault == UNKNOWABLE
            missed += fault == MISSED_POST
            known += fault >= FINE
            fault = max(fault, FINE)
        if fault != FINE:
            return fault, number, number + 1, known, unknown, missed, squeezed
        if goal != 0:
            return FINE, number, number + 1, known, unknown, missed, squeezed
    return FINE, ticks, ticks, known, unknown, missed, squeezed


@compiled
def play_many(tables, seeds, ticks, compared, counts, failures):
    """Play the episodes of row i at table i; failures (rows, 3): fault, seed and tick of its last failure."""
    for row in range(len(tables)):
        for seed in seeds[row]:
            fault, number, played, known, unknown, missed, squeezed = play(tables[row], seed, ticks, compared)
            counts[0] += played
            counts[1] += known
            counts[2] += unknown
            counts[3] += missed
            counts[4] += squeezed
            if fault != FINE:
                counts[5 + fault] += 1
                failures[row, 0], failures[row, 1], failures[row, 2] = fault, seed, number


def fuzz(min_ticks: int, seed: int = 0, tables: int = 200, episodes: int = EPISODES) -> dict:
    """Play at least so many ticks: number of ticks, faults by name, and the cases to reproduce them."""
    rng, counts, cases, began = np.random.default_rng(seed), np.zeros(5 + len(NAMES), np.int64), [], time.perf_counter()
    while counts[0] < min_ticks:
        values = random_tables(rng, tables)
        seeds = rng.integers(0, 2**62, (tables, episodes)).astype(np.uint64)
        failures = np.zeros((tables, 3), np.uint64)
        play_many(values, seeds, TICKS, COMPARED, counts, failures)
        for row in np.flatnonzero(failures[:, 0]):
            fault, number, tick = failures[row].tolist()
            cases.append({"fault": NAMES[fault], "seed": number, "tick": tick, "table": values[row].tolist()})
    return {
        "ticks": int(counts[0]),
        "compared": int(counts[1]),
        "unknowable": int(counts[2]),
        "missed_posts": int(counts[3]),
        "squeezed_goals": int(counts[4]),
        "faults": {NAMES[fault]: int(counts[5 + fault]) for fault in range(1, len(NAMES)) if counts[5 + fault]},
        "cases": cases,
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    result = fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    result["cases"] = result["cases"][:20]
    print(json.dumps(result, indent=1))
