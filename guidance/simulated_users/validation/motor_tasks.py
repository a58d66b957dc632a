"""A virtual laboratory: what simulated people do in the tasks by which real hands have been measured.

In these tasks the puck is a mark on the screen that nobody can touch. Every trial of every person is a row of its own,
with its own random numbers; results are (people, trials) unless said otherwise.
"""

from dataclasses import dataclass

import numpy as np

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import check_arrays, check_counts, check_numbers
from guidance.simulated_users.arm import HAND_REACH
from guidance.simulated_users.intention import Intention
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.strokes import to_table
from guidance.simulated_users.users import SimulatedUsers

MOVING = 0.02  # m/s: the hand has begun to move
HOLD = 0.1  # s in the target that end a reach
APPEARS = 10  # tick at which the mark comes
FAR = 0.9  # m, where it is before
UNDER_WAY = 0.1  # s before the contact, a blow cannot be called off
TABLE = TableSpec()


@dataclass
class Record:
    """What was seen of each trial, tick by tick: `force` acts during a tick, the rest is at its end.

    Attributes:
        hand, velocity, force: (people, trials, ticks, 2), m, m/s, N.
        meant: (people, trials, ticks) s until the contact that the person has planned; infinite without a plan.
    """

    hand: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    meant: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """(people, trials, ticks) m/s."""
        return np.linalg.norm(self.velocity, axis=-1)


def observe(
    people: np.ndarray,
    task: Intention,
    marks: np.ndarray,
    force: np.ndarray | None = None,
    variant: str = "comply_or_resist",
    seed: int = 0,
) -> Record:
    """Let everybody do a task, trial by trial, while a mark moves.

    Args:
        people: (people,) of dtype `PERSON`.
        task: what they have been told to do as soon as the mark does something.
        marks: (people, trials, ticks, 4) the mark's place and velocity in m and m/s of the table.
        force: (people, trials, ticks, 2) N on the hand, or None.
    """
    check_arrays("V", people=(people, "people"))
    check_arrays(marks=(marks, f"{len(people)} trials ticks 4"))
    n, trials, ticks = marks.shape[:3]
    if force is not None:
        check_arrays(force=(force, f"{n} {trials} {ticks} 2"))
    check_counts(0, seed=seed)
    users = SimulatedUsers(np.repeat(people, trials), personal_streams(n * trials, seed), TABLE, variant)
    users.instruct(task)
    marks = marks.reshape(n * trials, ticks, 4)
    force = np.zeros((n * trials, ticks, 2)) if force is None else force.reshape(n * trials, ticks, 2)
    state = np.zeros((n * trials, 12))
    state[:, 4] = TABLE.length / 4
    hand, velocity = np.empty((2, n * trials, ticks, 2))
    meant = np.empty((n * trials, ticks))
    for tick in range(ticks):
        state[:, 0], state[:, 1] = to_table(users.hand[:, 0], users.hand[:, 1], TABLE)
        state[:, 8:] = marks[:, tick]
        users.step(state, force[:, tick])
        hand[:, tick], velocity[:, tick], meant[:, tick] = users.hand, users.hand_velocity, users.time_to_contact
    shape = (n, trials, ticks)
    return Record(*(part.reshape(*shape, -1) for part in (hand, velocity, force)), meant.reshape(shape))


def marks_at(places: np.ndarray, since: np.ndarray, ticks: int) -> np.ndarray:
    """Marks that are at one place after another.

    Args:
        places: (..., k, 2) m of the hand.
        since: (..., k) the tick from which the mark is there; until the first it lies far away on the other side.

    Returns:
        (..., ticks, 4).
    """
    check_arrays(places=(places, "... k 2"), since=(since, "... k"))
    check_counts(ticks=ticks)
    marks = np.zeros((*since.shape[:-1], ticks, 4))
    marks[..., 0] = FAR
    for place, first in zip(np.moveaxis(places, -2, 0), np.moveaxis(since, -1, 0), strict=True):
        there = np.arange(ticks) >= first[..., None]
        for axis, at in enumerate(_on_table(place)):
            marks[..., axis] = np.where(there, at[..., None], marks[..., axis])
    return marks


def resting_marks(shape: tuple[int, int], ticks: int) -> np.ndarray:
    """Marks (*shape, ticks, 4) that appear at the middle of the hand's reach and stay there."""
    return marks_at(np.zeros((*shape, 1, 2)), np.full((*shape, 1), APPEARS), ticks)


def _on_table(hand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return to_table(hand[..., 0], hand[..., 1], TABLE)


def onset(speed: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Seconds (...) from the beginning of tick `start` (...) until the speed (..., ticks) rises above `MOVING`."""
    check_arrays(start=(start, "..."), speed=(speed, "... ticks"))
    ticks = np.arange(speed.shape[-1])
    moving = (speed > MOVING) & (ticks >= start[..., None])
    first = moving.argmax(-1)
    now, before = (np.take_along_axis(speed, at[..., None], -1)[..., 0] for at in (first, np.maximum(first - 1, 0)))
    within = (MOVING - before) / np.where(now > before, now - before, 1.0)  # the end of a tick before, or this one's
    return np.where(moving.any(-1), (first - start + np.clip(within, 0.0, 1.0)) * TABLE.tick, np.nan)


def reaction_times(people: np.ndarray, trials: int = 20, seed: int = 0) -> np.ndarray:
    """Simple visual reaction time, s: the hand rests at home; a mark appears beside it, the hand is to go there."""
    check_counts(trials=trials)
    check_counts(0, seed=seed)
    rng = np.random.default_rng([seed, 1])
    shape = (len(people), trials)
    appears = rng.integers(60, 100, shape)
    aside = np.stack([np.zeros(shape), 0.05 * rng.choice([-1.0, 1.0], shape)], axis=-1)
    marks = marks_at(aside[..., None, :], appears[..., None], ticks=150)
    return onset(observe(people, Intention.REACH, marks, seed=seed).speed, appears)


@dataclass
class Reaches:
    """Reaches between marks.

    Attributes:
        record: of each trial.
        jump: (people, trials) the tick at which the mark jumped.
        distance: (people, trials) m of the hand.
        off: (people, trials, ticks) m, the hand from the mark.
    """

    record: Record
    jump: np.ndarray
    distance: np.ndarray
    off: np.ndarray

    def movement_time(self, width: float) -> np.ndarray:
        """(people, trials) s from the onset until the hand stays within half a `width` of the mark; m."""
        check_numbers(above=0.0, width=width)
        start = onset(self.record.speed, self.jump)
        ticks, held = self.off.shape[-1], round(HOLD / TABLE.tick)
        inside = self.off <= width / 2
        stays = np.lib.stride_tricks.sliding_window_view(inside, held, axis=-1).all(-1)
        stays &= np.arange(ticks - held + 1) >= self.jump[..., None]
        arrived = (stays.argmax(-1) - self.jump + 1) * TABLE.tick
        return np.where(stays.any(-1), arrived - start, np.nan)

    def peaks(self) -> np.ndarray:
        """(people, trials) local maxima of the speed of at least a tenth of the highest, until the hand first stops."""
        counts = np.zeros(self.jump.shape, dtype=np.int64)
        for index in np.ndindex(*self.jump.shape):
            speed = self.profile(index)
            inner = speed[1:-1]
            counts[index] = np.sum((inner > speed[:-2]) & (inner >= speed[2:]) & (inner > 0.1 * speed.max()))
        return counts

    def profile(self, index: tuple[int, ...]) -> np.ndarray:
        """(ticks,) the speed of one trial from the onset until the first main movement has ended, m/s."""
        speed = self.record.speed[index][self.jump[index] :]
        top = int(speed.argmax())
        slow = speed < 0.1 * speed[top]
        first = top - int(slow[top::-1].argmax()) if slow[: top + 1].any() else 0
        last = top + int(slow[top:].argmax()) if slow[top:].any() else len(speed) - 1
        return speed[first : last + 1]


def reaches(people: np.ndarray, trials: int = 40, seed: int = 0) -> Reaches:
    """Reaches of 1.5 to 12 cm in random directions, from rest to rest."""
    check_counts(trials=trials)
    check_counts(0, seed=seed)
    rng = np.random.default_rng([seed, 2])
    shape = (len(people), trials)
    distance = 0.015 * 8 ** rng.random(shape)
    angle = rng.uniform(-np.pi, np.pi, shape)
    half = 0.5 * distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    half = np.clip(half, -HAND_REACH, HAND_REACH)
    jump = rng.integers(60, 80, shape)
    since = np.stack([np.full(shape, APPEARS), jump], axis=-1)
    marks = marks_at(np.stack([-half, half], axis=-2), since, ticks=220)
    record = observe(people, Intention.REACH, marks, seed=seed)
    off = np.linalg.norm(record.hand - half[..., None, :], axis=-1)
    return Reaches(record, jump, 2 * np.linalg.norm(half, axis=-1), off)


WIDTHS = (0.004, 0.006, 0.010, 0.016)  # m of the hand


def fitts_slopes(data: Reaches) -> np.ndarray:
    """(people,) s per bit: movement time regressed on log2(D / W + 1) (MacKenzie 1992)."""
    times = np.concatenate([data.movement_time(width) for width in WIDTHS], axis=1)
    bits = np.concatenate([np.log2(data.distance / width + 1.0) for width in WIDTHS], axis=1)
    slopes = []
    for x, y in zip(bits, times, strict=True):
        done = np.isfinite(y)
        slopes.append(np.polyfit(x[done], y[done], 1)[0] if done.sum() > 2 else np.nan)
    return np.array(slopes)


def timing_errors(people: np.ndarray, trials: int = 30, seed: int = 0) -> np.ndarray:
    """Hitting a mark that comes straight at one, at 0.5 to 1 m/s: s by which paddle and mark meet later than meant.

    The moment meant is the one planned last; not a number where no blow was under way.
    """
    check_counts(trials=trials)
    check_counts(0, seed=seed)
    rng = np.random.default_rng([seed, 3])
    shape, ticks = (len(people), trials), 160
    speed = rng.uniform(0.5, 1.0, shape)[..., None]
    side = rng.uniform(-0.15, 0.15, shape)[..., None]
    since = TABLE.tick * (np.arange(ticks) - 50)
    marks = np.zeros((*shape, ticks, 4))
    marks[..., 0] = np.where(since < 0, FAR, 0.6 - speed * since)
    marks[..., 1] = side
    marks[..., 2] = np.where(since < 0, 0.0, -speed)
    record = observe(people, Intention.SMASH, marks, seed=seed)
    x, y = _on_table(record.hand)
    # a record is of the end of its tick, the mark of the beginning
    away = np.hypot(x - marks[..., 0] - TABLE.tick * marks[..., 2], y - marks[..., 1])
    touching = TABLE.puck_radius + TABLE.paddle_radius
    near = away <= touching
    met = near.argmax(-1)
    before = np.maximum(met - 1, 0)
    now_away, before_away = (np.take_along_axis(away, at[..., None], -1)[..., 0] for at in (met, before))
    part = (before_away - touching) / np.where(before_away > now_away, before_away - now_away, 1.0)
    planned = np.take_along_axis(record.meant, before[..., None], -1)[..., 0]
    valid = near.any(-1) & (met > 0) & (planned < UNDER_WAY)
    return np.where(valid, TABLE.tick * np.clip(part, 0.0, 1.0) - planned, np.nan)


def mechanics(
    people: np.ndarray, trials: int = 4, seconds: float = 10.0, variant: str = "comply_or_resist", seed: int = 0
) -> np.ndarray:
    """(people, 3) mass in kg, damping in N s/m and stiffness in N/m of a hand that holds still, from small pushes.

    A random force of 0.5 N either way that changes every 60 ms, and the least-squares fit of F = M x'' + B x' + K x.
    """
    check_counts(trials=trials)
    check_counts(0, seed=seed)
    check_numbers(above=1.0, seconds=seconds)
    rng = np.random.default_rng([seed, 4])
    ticks, held = round(seconds / TABLE.tick), 3
    shape = (len(people), trials)
    force = 0.5 * rng.choice([-1.0, 1.0], (*shape, -(-ticks // held), 2)).repeat(held, axis=2)[:, :, :ticks]
    force[:, :, :50] = 0.0
    record = observe(people, Intention.REACH, resting_marks(shape, ticks), force, variant, seed)
    return np.array([_fit(*person) for person in zip(record.force, record.hand, record.velocity, strict=True)])


def _fit(force: np.ndarray, hand: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """M, B, K from (trials, ticks, 2): means over each tick of position and velocity, and the change of the latter."""
    middle = [0.5 * (part[:, 51:] + part[:, 50:-1]).ravel() for part in (velocity, hand)]
    change = np.diff(velocity[:, 50:], axis=1).ravel() / TABLE.tick
    return np.linalg.lstsq(np.stack([change, *middle], axis=1), force[:, 51:].ravel(), rcond=None)[0]


def push_response(
    people: np.ndarray, variant: str = "comply_or_resist", newtons: float = 2.0, seconds: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """A hand that holds still is pushed sideways: (ticks,) s since the push, (people, ticks) m it gives way."""
    check_numbers(above=0.0, seconds=seconds)
    check_numbers(newtons=newtons)
    ticks, start = round((1.6 + seconds) / TABLE.tick), 60
    shape = (len(people), 1)
    force = np.zeros((*shape, ticks, 2))
    force[:, :, start : start + round(seconds / TABLE.tick), 1] = newtons
    hand = observe(people, Intention.REACH, resting_marks(shape, ticks), force, variant, seed).hand
    return (np.arange(ticks) + 1 - start) * TABLE.tick, hand[:, 0, :, 1]
