"""A simulated person as a device, to run everything from the guidance to the hand without people."""

import numpy as np

from guidance.haptics.devices import Pair
from guidance.simulated_users import SimulatedUsers


class Simulated:
    """A `VirtualDevice` held by one simulated person.

    The person is updated at the end of each tick, with the state observed at its beginning and the mean of the forces
    that acted during it. Under a constant force, the person behaves exactly as without a device.

    Args:
        users: one person, whose rounds and games their owner begins by `users.new_round` and `users.new_game`.
    """

    is_held = True

    def __init__(self, users: SimulatedUsers) -> None:
        self.users, self._tick_ms = users, round(1000 * users.table.tick)
        self._passed_ms, self._observation = 0, np.zeros(12)
        self._force, self._forces = (0.0, 0.0), np.zeros((self._tick_ms, 2))

    @property
    def position(self) -> Pair:
        return tuple(self.users.hand[0].tolist())

    @property
    def velocity(self) -> Pair:
        return tuple(self.users.hand_velocity[0].tolist())

    def set_force(self, force: Pair) -> None:
        self._force = (float(force[0]), float(force[1]))

    def relax(self) -> None:
        self._force = (0.0, 0.0)

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Simulate whole ms; `state` is used at the beginning of a tick only."""
        for _ in range(round(1000 * seconds)):
            if self._passed_ms == 0:
                self._observation[:] = state
            self._forces[self._passed_ms] = self._force
            self._passed_ms += 1
            if self._passed_ms == self._tick_ms:
                self._passed_ms = 0
                first = self._forces[0]
                # exact where the force was constant; a mean would round
                mean = first if (self._forces == first).all() else self._forces.mean(axis=0)
                self.users.step(self._observation[None], mean[None])

    def close(self) -> None:
        self.relax()
