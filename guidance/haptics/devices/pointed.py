"""A hand that its owner points somewhere, and that a force pushes off from there as it pushes a simulated person's."""

from math import ceil, hypot

import numpy as np

from guidance.haptics.devices import Pair
from guidance.simulated_users import Population, sample_people
from guidance.simulated_users.arm import ARM_STATE, HAND_REACH, STEADY, move_arm, rest

FASTEST = 1.5  # m/s, a hand in play is not faster, and no paddle follows one that is
STEP = 0.001  # s, of the arm
ARM_LAWS = ("muscle_lag", "arm_mass", "stiffness")  # what differs between arms


def median_person() -> np.void:
    """Someone of dtype `PERSON` with the arm that has as many stiffer and heavier ones as softer and lighter ones."""
    usual = Population.usual()
    alike = Population.usual(**{name: getattr(usual, name)._replace(log_sd=0.0) for name in ARM_LAWS})
    return sample_people(1, 0, alike)[0]


def clamped(value: float) -> float:
    """`value` in m, within the hand's reach."""
    return min(max(value, -HAND_REACH), HAND_REACH)


class PointedHand:
    """A hand that is where its owner points, plus what the force deflects the arm by.

    Without a force it is exactly there once it has caught up; a constant force F deflects it by F / K in the end, K
    being the arm's stiffness. It stops at the reach of 0.075 m on either axis.

    Args:
        person: whose arm it is, a record of dtype `PERSON`; the median one's if None.
        fastest: m/s, no faster does the hand follow: a pointer can leap, a hand cannot.

    Raises:
        ValueError: `fastest` is not above 0.
    """

    def __init__(self, person: np.void | None = None, fastest: float = FASTEST) -> None:
        if not fastest > 0:
            raise ValueError(f"fastest = {fastest} must be a number above 0, in m/s")
        self.fastest, self._person = fastest, median_person() if person is None else person
        self._stiffness = float(self._person["stiffness"])
        self._arm = np.zeros(1, ARM_STATE)[0]
        rest(self._arm, self._person)
        self._pointed = self._followed = self._position = self._velocity = self._force = (0.0, 0.0)

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center."""
        return self._position

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's in the last time that passed."""
        return self._velocity

    def set_force(self, force: Pair) -> None:
        """Have this force (2,) in N act on the hand until another is set."""
        self._force = (float(force[0]), float(force[1]))

    def relax(self) -> None:
        """Have no force act."""
        self._force = (0.0, 0.0)

    def point(self, x: float, y: float) -> None:
        """Point at where the hand is to be, m; at the edge of the reach if it is outside.

        Raises:
            ValueError: a coordinate is not a number.
        """
        for name, value in (("x", x), ("y", y)):
            if value != value:
                raise ValueError(f"{name} = {value} must be a number, in m")
        self._pointed = (clamped(float(x)), clamped(float(y)))

    def move(self, seconds: float) -> None:
        """Let time pass for the hand: it follows what is pointed at, and yields to the force."""
        steps = max(ceil(seconds / STEP - 1e-6), 1)
        for _ in range(steps):
            move_arm(self._arm, self._person, STEADY, self._stiffness, 0.0, 0.0, *self._force, seconds / steps)
        (x, y), (to_x, to_y) = self._followed, self._pointed
        away, most = hypot(to_x - x, to_y - y), self.fastest * seconds
        if away > most:
            self._followed = x + (to_x - x) * most / away, y + (to_y - y) * most / away
        else:
            self._followed = to_x, to_y
        was_x, was_y = self._position
        x = clamped(self._followed[0] + float(self._arm["hand_x"]))
        y = clamped(self._followed[1] + float(self._arm["hand_y"]))
        self._position, self._velocity = (x, y), ((x - was_x) / seconds, (y - was_y) / seconds)
