"""A virtual hand at a pointer, which a force deflects as it deflects a simulated person's arm; a mouse has one."""

from math import ceil, hypot

import numpy as np

from guidance.haptics.devices import Pair
from guidance.simulated_users import Population, sample_people
from guidance.simulated_users.arm import ARM_STATE, HAND_REACH, NO_NOISE, move_arm, reset_arm

MAX_SPEED = 1.5  # m/s; hands in play are not faster, and a paddle could not follow them
STEP = 0.001  # s, integration step of the arm
ARM_PARAMETERS = ("muscle_lag", "arm_mass", "stiffness")  # those that vary between people


def median_person() -> np.void:
    """A person (dtype `USER_PARAMETERS`) whose arm has the population's median parameters."""
    population = Population.default()
    medians = {name: population[name]._replace(log_sd=0.0) for name in ARM_PARAMETERS}
    return sample_people(1, 0, population.with_parameters(**medians))[0]


def clip_reach(value: float) -> float:
    """`value` in m, clipped to the hand's reach."""
    return min(max(value, -HAND_REACH), HAND_REACH)


class PointerHand:
    """A hand at the position of a pointer, plus the deflection of the arm by the force.

    Without a force, the hand is exactly at the pointer once it has caught up; a constant force F deflects it by F / K
    in the end, where K is the arm's stiffness. It stops at the reach of 0.075 m on either axis.

    Args:
        person: whose arm it is, a record of dtype `USER_PARAMETERS`; None for the median arm.
        max_speed: m/s at which the hand follows; a pointer can jump, a hand cannot.
    """

    def __init__(self, person: np.void | None = None, max_speed: float = MAX_SPEED) -> None:
        self.max_speed, self._person = max_speed, median_person() if person is None else person
        self._stiffness = float(self._person["stiffness"])
        self._arm = np.zeros(1, ARM_STATE)[0]
        reset_arm(self._arm, self._person)
        self._pointer = self._base = self._position = self._velocity = self._force = (0.0, 0.0)

    @property
    def position(self) -> Pair:
        return self._position

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, mean velocity of the hand during the last `move`."""
        return self._velocity

    def set_force(self, force: Pair) -> None:
        self._force = (float(force[0]), float(force[1]))

    def relax(self) -> None:
        self._force = (0.0, 0.0)

    def point(self, x: float, y: float) -> None:
        """Set the pointer, in m; outside the reach, it is clipped to the edge."""
        self._pointer = (clip_reach(float(x)), clip_reach(float(y)))

    def move(self, seconds: float) -> None:
        """Simulate the passing of time: the hand follows the pointer and yields to the force."""
        steps = max(ceil(seconds / STEP - 1e-6), 1)
        for _ in range(steps):
            move_arm(self._arm, self._person, NO_NOISE, self._stiffness, 0.0, 0.0, *self._force, seconds / steps)
        (x, y), (to_x, to_y) = self._base, self._pointer
        distance, max_distance = hypot(to_x - x, to_y - y), self.max_speed * seconds
        if distance > max_distance:
            self._base = x + (to_x - x) * max_distance / distance, y + (to_y - y) * max_distance / distance
        else:
            self._base = to_x, to_y
        old_x, old_y = self._position
        x = clip_reach(self._base[0] + float(self._arm["hand_x"]))
        y = clip_reach(self._base[1] + float(self._arm["hand_y"]))
        self._position, self._velocity = (x, y), ((x - old_x) / seconds, (y - old_y) / seconds)


class Mouse(PointerHand):
    """A `VirtualDevice` whose hand is at the mouse's pointer, see `PointerHand`; nothing pushes the real hand."""

    is_held = True  # `HapticHand.push` reports whether the window has the focus

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Simulate the passing of time; the game's state has no effect."""
        self.move(seconds)

    def close(self) -> None:
        self.relax()
