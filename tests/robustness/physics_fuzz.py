"""Rough play: random tables, states and targets, each tick checked, and compared with a simpler integrator.

    python -m tests.robustness.physics_fuzz 100000000        so many ticks, and what was found, as JSON

The reference takes each sub-step in many small ones, in which it looks whether the puck is in something, and finds the
moment of a contact by halving the small step: no roots, no cases, and little in common with `airhockey_marl.envs.physics`. Two
runs of it, one with other small steps and from a place a hair off, tell what no integrator can know: those are not
compared, but counted.
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

TICKS = 50  # of an episode
EPISODES = 100  # at a table
COMPARED = 50  # one tick in so many is compared with the reference
SMALL_STEPS, OTHER_STEPS = 50, 171  # of a sub-step
HAIR = 1e-9  # m
# A puck that leaves the mouth of a goal again, askew, is not turned by the post on its way but slides around it: known,
# and kept, because to mend it would change the bits of ordinary play. So are goals of pucks that a paddle has squeezed
# past a post and over the line, some of which come a tick late.
UNKNOWABLE, MISSED_POST, SQUEEZED = -1, -2, -3
FINE, PUCK_NAN, PUCK_OUTSIDE, PADDLE_OUTSIDE, PADDLE_FAST, ENERGY, FAR_OFF, WRONG_GOAL, SHIFTED = range(9)
NAMES = (
    "fine",
    "not a number",
    "puck outside",
    "paddle outside",
    "paddle too fast",
    "energy from nowhere",
    "not where the reference has it",
    "another goal than the reference",
    "moved further than it flew",
)

compiled = njit(cache=True, error_model="numpy", nogil=True)


def random_tables(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, fields) tables that `check_table` allows: some numbers the usual, some anywhere up to what is allowed."""
    tables = []
    usual = np.array(TableSpec(), dtype=float)
    while len(tables) < n:
        values = usual.copy()
        for place in np.flatnonzero(rng.random(len(usual)) < rng.uniform(0, 0.6)):
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
        # of sub-steps mostly few, for a tick takes as long as it has
        values[-1] = round(values[-1]) if rng.random() < 0.01 else rng.integers(1, 9)
        try:
            check_table(TableSpec(*values[:-1], int(values[-1])))
        except ValueError:
            continue
        tables.append(values)
    return np.array(tables)


@compiled
def table_of(values):
    v = values
    return TableSpec(
        v[0],
        v[1],
        v[2],
        v[3],
        v[4],
        v[5],
        v[6],
        v[7],
        v[8],
        v[9],
        v[10],
        v[11],
        v[12],
        v[13],
        v[14],
        v[15],
        v[16],
        v[17],
        int(v[18]),
    )


@compiled
def overlap(bodies, seat, table):
    gap = hypot(bodies[PUCK, X] - bodies[seat, X], bodies[PUCK, Y] - bodies[seat, Y])
    return table.puck_radius + table.paddle_radius - gap


@compiled
def begin(bodies, rng, table):
    """A legal state: paddles in their halves, the puck on the table and in no paddle; False if none was found."""
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
    """Legal targets, and now and then one that is far off, none, or where the puck is."""
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
def in_something(x, y, vx, vy, bodies, ahead, table):
    """What the puck is in and moves into, `ahead` seconds on: (which, normal x, normal y, its velocity x and y)."""
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
def nearest(puck, bodies, small, table):
    """When in the next `small` seconds the puck is nearest to a paddle or post that it touches then; else `small`."""
    for thing in range(6):
        if thing < 2:
            x, y, vx, vy = bodies[thing, X], bodies[thing, Y], bodies[thing, VX], bodies[thing, VY]
        else:
            x, y = table.length / 2 * (1 if thing < 4 else -1), table.goal / 2 * (1 if thing % 2 else -1)
            vx = vy = 0.0
        x, y, vx, vy = puck[X] - x, puck[Y] - y, puck[VX] - vx, puck[VY] - vy
        speed2 = vx * vx + vy * vy
        ahead = -0.999999 * (x * vx + y * vy) / speed2 if speed2 > 0 else 0.0
        if 0 < ahead < small and in_something(puck[X], puck[Y], puck[VX], puck[VY], bodies, ahead, table)[0] >= 0:
            small = ahead
    return small


@compiled
def reference(bodies, targets, table, steps):
    """A tick in small steps, in place: (goal, most contacts of a sub-step, whether it met a post on its way out)."""
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
            small = nearest(puck, bodies, min(left, dt / steps), table)
            which, _, _, _, _ = in_something(puck[X], puck[Y], puck[VX], puck[VY], bodies, small, table)
            if which >= 0:
                low, high = 0.0, small
                for _ in range(60):
                    middle = (low + high) / 2
                    if in_something(puck[X], puck[Y], puck[VX], puck[VY], bodies, middle, table)[0] >= 0:
                        high = middle
                    else:
                        low = middle
                which, nx, ny, wx, wy = in_something(puck[X], puck[Y], puck[VX], puck[VY], bodies, high, table)
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
def wrong_alone(before, bodies, goal, touched, still, table):
    """What is wrong with a tick that can be seen without a reference."""
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
    if goal != 0:  # a fast puck has flown on behind the line; it went over it in the mouth
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
            for seat in (LEFT, RIGHT):  # else a squeeze, from which the puck is taken out
                unmoved = unmoved and overlap(bodies, seat, table) < -room
            if unmoved:
                return SHIFTED
    elif now > was + (1 + table.paddle_restitution) * table.paddle_speed * 8 * table.substeps:
        return ENERGY
    return SQUEEZED if squeezed else FINE


@compiled
def beside_reference(before, bodies, goal, targets, table):
    """What is wrong with a tick beside the reference; UNKNOWABLE where no integrator can know, or MISSED_POST."""
    one, other = before.copy(), before.copy()
    for seat in (LEFT, RIGHT):
        if overlap(before, seat, table) > 0:  # squeezed already
            return UNKNOWABLE
    fastest = max(table.paddle_speed, hypot(before[PUCK, VX], before[PUCK, VY]))
    if 2 * fastest * table.tick / table.substeps / SMALL_STEPS > table.puck_radius:  # it would step over things itself
        return UNKNOWABLE
    other[PUCK, X] += HAIR
    other[PUCK, Y] -= HAIR
    goal_one, contacts, met = reference(one, targets, table, SMALL_STEPS)
    goal_other, others, _ = reference(other, targets, table, OTHER_STEPS)
    if contacts > 3 or others > 3 or goal_one != goal_other:
        return UNKNOWABLE
    for column in range(4):
        if abs(one[PUCK, column] - other[PUCK, column]) > 1e-6:
            return UNKNOWABLE
    wrong = FINE
    if goal != goal_one:
        wrong = WRONG_GOAL
    elif goal == 0:
        for column in range(2):
            if abs(one[PUCK, column] - bodies[PUCK, column]) > 1e-4:
                wrong = FAR_OFF
    return MISSED_POST if wrong != FINE and met else wrong


@compiled
def play(values, seed, ticks, compared):
    """Play an episode: (what is wrong, at which tick, ticks played, compared, unknowable, missed, squeezed)."""
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
        wrong = wrong_alone(before, bodies, goal, touched, still, table)
        squeezed += wrong == SQUEEZED
        wrong = max(wrong, FINE)
        if wrong == FINE and random_unit(rng, 0) * compared < 1.0:
            wrong = beside_reference(before, bodies, goal, targets, table)
            unknown += wrong == UNKNOWABLE
            missed += wrong == MISSED_POST
            known += wrong >= FINE
            wrong = max(wrong, FINE)
        if wrong != FINE:
            return wrong, number, number + 1, known, unknown, missed, squeezed
        if goal != 0:
            return FINE, number, number + 1, known, unknown, missed, squeezed
    return FINE, ticks, ticks, known, unknown, missed, squeezed


@compiled
def play_many(tables, seeds, ticks, compared, counts, failures):
    """Episodes of row i are played at table i; failures (rows, 3) is what, which seed and which tick, of the last."""
    for row in range(len(tables)):
        for seed in seeds[row]:
            wrong, number, played, known, unknown, missed, squeezed = play(tables[row], seed, ticks, compared)
            counts[0] += played
            counts[1] += known
            counts[2] += unknown
            counts[3] += missed
            counts[4] += squeezed
            if wrong != FINE:
                counts[5 + wrong] += 1
                failures[row, 0], failures[row, 1], failures[row, 2] = wrong, seed, number


def fuzz(least: int, seed: int = 0, tables: int = 200, episodes: int = EPISODES) -> dict:
    """Play at least so many ticks: how many there were, what was wrong how often, and cases to play again."""
    rng, counts, cases, began = np.random.default_rng(seed), np.zeros(5 + len(NAMES), np.int64), [], time.perf_counter()
    while counts[0] < least:
        values = random_tables(rng, tables)
        seeds = rng.integers(0, 2**62, (tables, episodes)).astype(np.uint64)
        failures = np.zeros((tables, 3), np.uint64)
        play_many(values, seeds, TICKS, COMPARED, counts, failures)
        for row in np.flatnonzero(failures[:, 0]):
            what, number, at = failures[row].tolist()
            cases.append({"what": NAMES[what], "seed": number, "tick": at, "table": values[row].tolist()})
    return {
        "ticks": int(counts[0]),
        "compared": int(counts[1]),
        "unknowable": int(counts[2]),
        "missed_posts": int(counts[3]),
        "squeezed_goals": int(counts[4]),
        "wrong": {NAMES[what]: int(counts[5 + what]) for what in range(1, len(NAMES)) if counts[5 + what]},
        "cases": cases,
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    found = fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    found["cases"] = found["cases"][:20]
    print(json.dumps(found, indent=1))
