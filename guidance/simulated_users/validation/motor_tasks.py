"""Motor tasks in which real hands have been measured: reaction, reaching, interception, perturbation.

The puck is replaced by a target on the screen that cannot be touched. Every trial of every person is independent, with
its own random numbers; results are (people, trials) unless said otherwise.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users.arm import HAND_REACH
from guidance.simulated_users.intention import Intention
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.strokes import to_table
from guidance.simulated_users.users import SimulatedUsers

ONSET_SPEED = 0.02  # m/s: the hand has begun to move
HOLD_TIME = 0.1  # s in the target that end a reach
TARGET_TICK = 10  # at which a resting target appears
HIDDEN_X = 0.9  # m, where the target is before
COMMITTED_TIME = 0.1  # s before the contact, from which a strike is carried out
TABLE = TableSpec()


class TaskStream(IntEnum):
    """Seed streams of the tasks' random numbers."""

    REACTION = 1
    REACHING = 2
    INTERCEPTION = 3
    PERTURBATION = 4


@dataclass
class Recording:
    """A recording of each trial, tick by tick: `force` acts during a tick, the rest is at its end.

    Attributes:
        hand, velocity, force: (people, trials, ticks, 2), m, m/s, N.
        time_to_contact: (people, trials, ticks) s until the planned contact; infinite without a plan.
    """

    hand: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    time_to_contact: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """(people, trials, ticks) m/s."""
        return np.linalg.norm(self.velocity, axis=-1)


def run_trials(
    people: np.ndarray,
    task: Intention,
    targets: np.ndarray,
    force: np.ndarray | None = None,
    variant: str = "comply_or_resist",
    seed: int = 0,
    adaptation: bool = True,
) -> Recording:
    """Record all trials of a task.

    Args:
        people: (people,) of `USER_PARAMETERS`.
        task: their instruction, to begin when the target jumps or moves.
        targets: (people, trials, ticks, 4) the target's position and velocity in m and m/s of the table.
        force: (people, trials, ticks, 2) N on the hand, or None.
    """
    n, trials, ticks = targets.shape[:3]
    streams = personal_streams(n * trials, seed)
    users = SimulatedUsers(np.repeat(people, trials), streams, TABLE, variant, adaptation=adaptation)
    users.instruct(task)
    targets = targets.reshape(n * trials, ticks, 4)
    force = np.zeros((n * trials, ticks, 2)) if force is None else force.reshape(n * trials, ticks, 2)
    state = np.zeros((n * trials, 12))
    state[:, 4] = TABLE.length / 4
    hand, velocity = np.empty((2, n * trials, ticks, 2))
    contact = np.empty((n * trials, ticks))
    for tick in range(ticks):
        state[:, 0], state[:, 1] = to_table(users.hand[:, 0], users.hand[:, 1], TABLE)
        state[:, 8:] = targets[:, tick]
        users.step(state, force[:, tick])
        hand[:, tick], velocity[:, tick], contact[:, tick] = users.hand, users.hand_velocity, users.time_to_contact
    shape = (n, trials, ticks)
    return Recording(*(part.reshape(*shape, -1) for part in (hand, velocity, force)), contact.reshape(shape))


def jumping_targets(positions: np.ndarray, onsets: np.ndarray, ticks: int) -> np.ndarray:
    """Targets that jump from one position to the next.

    Args:
        positions: (..., k, 2) m of the hand.
        onsets: (..., k) the tick from which the target is there; before the first it lies on the opponent's side.

    Returns:
        (..., ticks, 4).
    """
    targets = np.zeros((*onsets.shape[:-1], ticks, 4))
    targets[..., 0] = HIDDEN_X
    for position, onset_tick in zip(np.moveaxis(positions, -2, 0), np.moveaxis(onsets, -1, 0), strict=True):
        present = np.arange(ticks) >= onset_tick[..., None]
        for axis, coordinate in enumerate(_on_table(position)):
            targets[..., axis] = np.where(present, coordinate[..., None], targets[..., axis])
    return targets


def resting_targets(shape: tuple[int, int], ticks: int) -> np.ndarray:
    """Targets (*shape, ticks, 4) that appear at the center of the hand's workspace and stay there."""
    return jumping_targets(np.zeros((*shape, 1, 2)), np.full((*shape, 1), TARGET_TICK), ticks)


def _on_table(hand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return to_table(hand[..., 0], hand[..., 1], TABLE)


def onset(speed: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Seconds (...) from the beginning of tick `start` (...) until the speed (..., ticks) rises above `ONSET_SPEED`."""
    ticks = np.arange(speed.shape[-1])
    moving = (speed > ONSET_SPEED) & (ticks >= start[..., None])
    first = moving.argmax(-1)
    now, before = (np.take_along_axis(speed, at[..., None], -1)[..., 0] for at in (first, np.maximum(first - 1, 0)))
    # between the end of the tick before and this one's
    within = (ONSET_SPEED - before) / np.where(now > before, now - before, 1.0)
    return np.where(moving.any(-1), (first - start + np.clip(within, 0.0, 1.0)) * TABLE.tick, np.nan)


def reaction_times(people: np.ndarray, trials: int = 20, seed: int = 0) -> np.ndarray:
    """Simple visual reaction time, s: a target appears beside the resting hand, which is to reach it."""
    rng = np.random.default_rng([seed, TaskStream.REACTION])
    shape = (len(people), trials)
    appearance = rng.integers(60, 100, shape)
    position = np.stack([np.zeros(shape), 0.05 * rng.choice([-1.0, 1.0], shape)], axis=-1)
    targets = jumping_targets(position[..., None, :], appearance[..., None], ticks=150)
    return onset(run_trials(people, Intention.REACH, targets, seed=seed).speed, appearance)


@dataclass
class Reaches:
    """Reaches between targets.

    Attributes:
        recording: of each trial.
        jump: (people, trials) the tick at which the target jumped.
        distance: (people, trials) m of the hand.
        error: (people, trials, ticks) m from the hand to the target.
    """

    recording: Recording
    jump: np.ndarray
    distance: np.ndarray
    error: np.ndarray

    def movement_time(self, width: float) -> np.ndarray:
        """(people, trials) s from the onset until the hand stays within half a `width`, in m, of the target."""
        start = onset(self.recording.speed, self.jump)
        ticks, hold = self.error.shape[-1], round(HOLD_TIME / TABLE.tick)
        inside = self.error <= width / 2
        stays = np.lib.stride_tricks.sliding_window_view(inside, hold, axis=-1).all(-1)
        stays &= np.arange(ticks - hold + 1) >= self.jump[..., None]
        arrived = (stays.argmax(-1) - self.jump + 1) * TABLE.tick
        return np.where(stays.any(-1), arrived - start, np.nan)

    def peaks(self) -> np.ndarray:
        """(people, trials) local maxima of the speed, at least a tenth of the highest, before the first stop."""
        counts = np.zeros(self.jump.shape, dtype=np.int64)
        for index in np.ndindex(*self.jump.shape):
            speed = self.profile(index)
            inner = speed[1:-1]
            counts[index] = np.sum((inner > speed[:-2]) & (inner >= speed[2:]) & (inner > 0.1 * speed.max()))
        return counts

    def profile(self, index: tuple[int, ...]) -> np.ndarray:
        """(ticks,) speed of one trial from the onset to the end of the main movement, m/s."""
        speed = self.recording.speed[index][self.jump[index] :]
        top = int(speed.argmax())
        slow = speed < 0.1 * speed[top]
        first = top - int(slow[top::-1].argmax()) if slow[: top + 1].any() else 0
        last = top + int(slow[top:].argmax()) if slow[top:].any() else len(speed) - 1
        return speed[first : last + 1]


def reaches(people: np.ndarray, trials: int = 40, seed: int = 0) -> Reaches:
    """Reaches of 1.5 to 12 cm in random directions, from rest to rest."""
    rng = np.random.default_rng([seed, TaskStream.REACHING])
    shape = (len(people), trials)
    distance = 0.015 * 8 ** rng.random(shape)
    angle = rng.uniform(-np.pi, np.pi, shape)
    half = 0.5 * distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    half = np.clip(half, -HAND_REACH, HAND_REACH)
    jump = rng.integers(60, 80, shape)
    onsets = np.stack([np.full(shape, TARGET_TICK), jump], axis=-1)
    targets = jumping_targets(np.stack([-half, half], axis=-2), onsets, ticks=220)
    recording = run_trials(people, Intention.REACH, targets, seed=seed)
    error = np.linalg.norm(recording.hand - half[..., None, :], axis=-1)
    return Reaches(recording, jump, 2 * np.linalg.norm(half, axis=-1), error)


WIDTHS = (0.004, 0.006, 0.010, 0.016)  # m of the hand


def fitts_slopes(data: Reaches) -> np.ndarray:
    """(people,) s per bit: movement time regressed on log2(D / W + 1) (MacKenzie 1992)."""
    times = np.concatenate([data.movement_time(width) for width in WIDTHS], axis=1)
    bits = np.concatenate([np.log2(data.distance / width + 1.0) for width in WIDTHS], axis=1)
    slopes = []
    for x, y in zip(bits, times, strict=True):
        complete = np.isfinite(y)
        slopes.append(np.polyfit(x[complete], y[complete], 1)[0] if complete.sum() > 2 else np.nan)
    return np.array(slopes)


def timing_errors(people: np.ndarray, trials: int = 30, seed: int = 0) -> np.ndarray:
    """Timing error, s, of hitting a target that approaches at 0.5 to 1 m/s: actual less planned time of contact.

    The plan is the last one before the contact; NaN where no strike was planned.
    """
    rng = np.random.default_rng([seed, TaskStream.INTERCEPTION])
    shape, ticks = (len(people), trials), 160
    speed = rng.uniform(0.5, 1.0, shape)[..., None]
    side = rng.uniform(-0.15, 0.15, shape)[..., None]
    seconds = TABLE.tick * (np.arange(ticks) - 50)
    targets = np.zeros((*shape, ticks, 4))
    targets[..., 0] = np.where(seconds < 0, HIDDEN_X, 0.6 - speed * seconds)
    targets[..., 1] = side
    targets[..., 2] = np.where(seconds < 0, 0.0, -speed)
    recording = run_trials(people, Intention.SMASH, targets, seed=seed)
    x, y = _on_table(recording.hand)
    # the hand is recorded at the end of a tick, the target at its beginning
    distance = np.hypot(x - targets[..., 0] - TABLE.tick * targets[..., 2], y - targets[..., 1])
    touching = TABLE.puck_radius + TABLE.paddle_radius
    contact = distance <= touching
    tick = contact.argmax(-1)
    before = np.maximum(tick - 1, 0)
    last, previous = (np.take_along_axis(distance, at[..., None], -1)[..., 0] for at in (tick, before))
    part = (previous - touching) / np.where(previous > last, previous - last, 1.0)
    planned = np.take_along_axis(recording.time_to_contact, before[..., None], -1)[..., 0]
    valid = contact.any(-1) & (tick > 0) & (planned < COMMITTED_TIME)
    return np.where(valid, TABLE.tick * np.clip(part, 0.0, 1.0) - planned, np.nan)


def mechanics(
    people: np.ndarray,
    trials: int = 4,
    seconds: float = 10.0,
    variant: str = "comply_or_resist",
    seed: int = 0,
    adaptation: bool = True,
) -> np.ndarray:
    """(people, 3) mass in kg, damping in N s/m and stiffness in N/m of a resting hand, from small perturbations.

    A random force of 0.5 N either way that changes every 60 ms, and the least-squares fit of F = M x'' + B x' + K x.
    """
    rng = np.random.default_rng([seed, TaskStream.PERTURBATION])
    ticks, hold = round(seconds / TABLE.tick), 3
    shape = (len(people), trials)
    force = 0.5 * rng.choice([-1.0, 1.0], (*shape, -(-ticks // hold), 2)).repeat(hold, axis=2)[:, :, :ticks]
    force[:, :, :50] = 0.0
    rec = run_trials(people, Intention.REACH, resting_targets(shape, ticks), force, variant, seed, adaptation)
    return np.array([_fit_mechanics(*person) for person in zip(rec.force, rec.hand, rec.velocity, strict=True)])


def _fit_mechanics(force: np.ndarray, hand: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """M, B, K (3,) of one person from force, position and velocity (trials, ticks, 2)."""
    middle = [0.5 * (part[:, 51:] + part[:, 50:-1]).ravel() for part in (velocity, hand)]
    change = np.diff(velocity[:, 50:], axis=1).ravel() / TABLE.tick
    return np.linalg.lstsq(np.stack([change, *middle], axis=1), force[:, 51:].ravel(), rcond=None)[0]


def push_response(
    people: np.ndarray,
    variant: str = "comply_or_resist",
    newtons: float = 2.0,
    seconds: float = 1.0,
    seed: int = 0,
    adaptation: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of a resting hand by a sideways push: (ticks,) s since the push began, (people, ticks) m."""
    ticks, start = round((1.6 + seconds) / TABLE.tick), 60
    shape = (len(people), 1)
    force = np.zeros((*shape, ticks, 2))
    force[:, :, start : start + round(seconds / TABLE.tick), 1] = newtons
    hand = run_trials(people, Intention.REACH, resting_targets(shape, ticks), force, variant, seed, adaptation).hand
    return (np.arange(ticks) + 1 - start) * TABLE.tick, hand[:, 0, :, 1]
