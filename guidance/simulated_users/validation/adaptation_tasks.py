"""Force fields in which real hands have been measured: reaches back and forth, as in Smith, Ghazizadeh & Shadmehr 2006.

Two targets 10 cm apart take turns. A field acts on the hand for whole reaches; results have a value per person.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from guidance.simulated_users.intention import Intention
from guidance.simulated_users.population import personal_streams
from guidance.simulated_users.strokes import to_table
from guidance.simulated_users.users import SimulatedUsers
from guidance.simulated_users.validation.motor_tasks import TABLE

HALF_DISTANCE = 0.05  # m of the hand from the middle to a target, sideways
REACH_TIME = 0.8  # s from one target to the next
CHANNEL_STIFFNESS, CHANNEL_DAMPING = 600.0, 40.0  # N/m, N s/m: as stiff as a tick of 20 ms allows
VISCOUS, CURL = 5.0, 10.0  # N s/m
EXPOSURES = {"30 s": 30.0, "2 min": 120.0}

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Position and velocity of the hand (n, 2) -> force (n, 2) in N."""


def viscous(gain: float) -> Field:
    """A force along the velocity: a push if the gain in N s/m is positive, a drag if it is negative."""
    return lambda hand, velocity: gain * velocity


def curl(gain: float) -> Field:
    """A force at right angles to the velocity."""
    return lambda hand, velocity: gain * velocity[:, ::-1] * np.array([1.0, -1.0])


def channel(hand: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """An error clamp: the straight line between the targets has stiff walls, which measure what is pushed."""
    wall = -CHANNEL_STIFFNESS * hand[:, 0] - CHANNEL_DAMPING * velocity[:, 0]
    return np.stack([wall, np.zeros_like(wall)], axis=1)


FIELDS = {
    "push of 5 N s/m": viscous(VISCOUS),
    "drag of 5 N s/m": viscous(-VISCOUS),
    "curl field of 10 N s/m": curl(CURL),
}
NO_FIELD = viscous(0.0)


@dataclass
class FieldReaches:
    """A recording of all reaches, tick by tick.

    Attributes:
        hand, velocity: (reaches, ticks, people, 2) m and m/s at the beginning of a tick.
        force: (reaches, ticks, people, 2) N, the field during that tick.
        expected: (reaches, ticks, people, 2) N, the force that the person has learned to expect at that velocity.
    """

    hand: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    expected: np.ndarray

    def compensated(self, reaches: slice) -> np.ndarray:
        """(people,) share of the field's force that is expected: the regression of the one on the other."""
        expected, force = self.expected[reaches], self.force[reaches]
        return (expected * force).sum((0, 1, 3)) / (force * force).sum((0, 1, 3))

    def against_walls(self, gain: float) -> np.ndarray:
        """(reaches, people) share of a curl field of this gain that the walls of a channel measure."""
        along = self.velocity[..., 1]
        return (self.force[..., 0] * along).sum(1) / (gain * along * along).sum(1)

    def peak_speed(self) -> np.ndarray:
        """(reaches, people) m/s."""
        return np.abs(self.velocity[..., 1]).max(1)

    def sideways(self) -> np.ndarray:
        """(reaches, people) m, deviation from the straight line at peak speed, to the side of a positive curl field."""
        peak = np.abs(self.velocity[..., 1]).argmax(1)[:, None]
        deviation, along = (
            np.take_along_axis(part, peak, 1)[:, 0] for part in (self.hand[..., 0], self.velocity[..., 1])
        )
        return deviation * np.sign(along)


def reach_in_fields(people: np.ndarray, fields: Sequence[Field], variant: str, seed: int = 0) -> FieldReaches:
    """Reaches of people (n,) who have learned nothing yet, one per field."""
    n, ticks = len(people), round(REACH_TIME / TABLE.tick)
    users = SimulatedUsers(people, personal_streams(n, seed), TABLE, variant)
    users.instruct(Intention.REACH)
    state = np.zeros((n, 12))
    state[:, 4] = TABLE.length / 4
    record = np.empty((4, len(fields), ticks, n, 2))
    for reach, field in enumerate(fields):
        state[:, 8], state[:, 9] = to_table(0.0, HALF_DISTANCE * (-1) ** reach, TABLE)
        for tick in range(ticks):
            hand, velocity = users.hand, users.hand_velocity
            state[:, 0], state[:, 1] = to_table(hand[:, 0], hand[:, 1], TABLE)
            context = np.concatenate([velocity, people["reference_speed"][:, None]], axis=1)
            expected = np.einsum("nmak,nk->na", users.learned, context)
            force = field(hand, velocity)
            record[:, reach, tick] = hand, velocity, force, expected
            users.step(state, force)
    return FieldReaches(*record)


def reaches_in(seconds: float) -> int:
    """How many reaches there are in a time."""
    return round(seconds / REACH_TIME)


def compensation(people: np.ndarray, variant: str, seed: int = 0) -> dict[str, np.ndarray]:
    """Shares of each of `FIELDS` that are compensated after each of `EXPOSURES`, over its last four reaches."""
    results = {}
    for name, field in FIELDS.items():
        data = reach_in_fields(people, [field] * reaches_in(max(EXPOSURES.values())), variant, seed)
        for exposure, seconds in EXPOSURES.items():
            last = reaches_in(seconds)
            results[f"{name}, compensated after {exposure}"] = data.compensated(slice(last - 4, last))
    return results


def after_effects(people: np.ndarray, variant: str, seed: int = 0) -> dict[str, np.ndarray]:
    """First reaches after 30 s of a field, relative to the group's first reaches in it: opposite, so above 0.

    What is compared is the change of peak speed (push, drag) and the sideways deviation (curl field), of two reaches.
    """
    results, before, during = {}, 10, reaches_in(30.0)
    for name, field in FIELDS.items():
        data = reach_in_fields(people, [NO_FIELD] * before + [field] * during + [NO_FIELD] * 2, variant, seed)
        effect = data.sideways() if name.startswith("curl") else data.peak_speed()
        effect = effect - effect[2:before].mean(0)
        first = effect[before : before + 2].mean()
        results[f"{name}, after-effect"] = -effect[before + during :].mean(0) / first
    return results


def spontaneous_recovery(people: np.ndarray, variant: str, seed: int = 0) -> np.ndarray:
    """(people,) share of a curl field that comes back in an error clamp, after a short time in the opposite field.

    2 min of the field, 20 reaches in its opposite, 60 in a channel: the largest mean of ten reaches against the walls.
    """
    fields = [curl(CURL)] * reaches_in(120.0) + [curl(-CURL)] * 20 + [channel] * 60
    share = reach_in_fields(people, fields, variant, seed).against_walls(CURL)[-60:]
    return share.reshape(6, 10, -1).mean(1).max(0)


def random_field(people: np.ndarray, variant: str, seed: int = 0) -> np.ndarray:
    """(people,) mean share of a curl field that is expected when its sign is random from reach to reach."""
    signs = np.random.default_rng(seed).permutation(np.repeat([-1.0, 1.0], reaches_in(120.0) // 2))
    data = reach_in_fields(people, [curl(CURL * sign) for sign in signs], variant, seed)
    along, expected = data.velocity[..., 1], data.expected[..., 0]
    return (expected * along).sum((0, 1)) / (CURL * along * along).sum((0, 1))
