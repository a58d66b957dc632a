"""A simulated person as a device, so that everything from the guidance to the hand runs without anybody there."""

import numpy as np

from guidance.haptics.devices import Pair
from guidance.simulated_users import SimulatedUsers

STEP_MS = 1  # of the servo


class Simulated:
    """A `VirtualDevice` at which one simulated person sits.

    The person lives through a tick of the table at its end: with the game as it was shown at its beginning, and the
    mean of the forces that acted during it. With one force throughout, they do what they do without a device.

    Args:
        users: one person; also begins their rounds and games, with `users.new_round` and `users.new_game`.

    Raises:
        ValueError: not one person, or a tick that is not a whole number of servo steps.
    """

    held = True

    def __init__(self, users: SimulatedUsers) -> None:
        if users.n != 1:
            raise ValueError(f"users: n = {users.n} must be 1, a device is held by one person")
        self.users, self._tick_ms = users, round(1000 * users.table.tick)
        if abs(1000 * users.table.tick - self._tick_ms) > 1e-9 or self._tick_ms < STEP_MS:
            raise ValueError(f"table.tick = {users.table.tick} must be a whole number of ms")
        self._passed_ms, self._seen = 0, np.zeros(12)
        self._force, self._forces = (0.0, 0.0), np.zeros((self._tick_ms, 2))

    @property
    def position(self) -> Pair:
        """(2,) m, the hand from the center."""
        x, y = self.users.hand[0]
        return float(x), float(y)

    @property
    def velocity(self) -> Pair:
        """(2,) m/s, the hand's."""
        x, y = self.users.hand_velocity[0]
        return float(x), float(y)

    def set_force(self, force: Pair) -> None:
        """Have this force (2,) in N act on the hand until another is set."""
        self._force = (float(force[0]), float(force[1]))

    def relax(self) -> None:
        """Have no force act."""
        self._force = (0.0, 0.0)

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Let time pass.

        Args:
            seconds: s, a whole number of ms.
            state: (12,) float64, the game as the person sees it; only what they see as a tick begins counts.

        Raises:
            ValueError: not whole ms, or a state or a force that `SimulatedUsers.step` refuses.
        """
        steps = round(1000 * seconds)
        if steps < 1 or abs(1000 * seconds - steps) > 1e-6:
            raise ValueError(f"seconds = {seconds} must be a whole number of ms, of at least 1")
        if np.shape(state) != (12,):
            raise ValueError(f"state of shape {np.shape(state)} must be (12,)")
        for _ in range(steps):
            if self._passed_ms == 0:
                self._seen[:] = state
            self._forces[self._passed_ms] = self._force
            self._passed_ms += STEP_MS
            if self._passed_ms == self._tick_ms:
                self._passed_ms = 0
                first = self._forces[0]
                # the mean of one force is that force, to the last bit
                mean = first if (self._forces == first).all() else self._forces.mean(axis=0)
                self.users.step(self._seen[None], mean[None])

    def close(self) -> None:
        """There is nothing to let go of."""
        self.relax()
