"""A hand at the end of an arm, between a player's actions and the paddle: mass, damping and a limited force.

    m x'' = clip(K (r u - x)) - b x'

u is the action, x the hand's position in m, r its reach in m per unit of action; the norm of the spring's force is
clipped. The paddle is steered by where the hand is, x / r, instead of by the action: a player learns to aim where a
hand can be. At |x / r| = 1, each axis, the workspace of the device ends, and the hand is stopped.
"""

from collections.abc import Mapping
from math import hypot
from typing import Any, NamedTuple

import numpy as np

from airhockey_marl.envs.physics import VX, VY, TableSpec, X, Y, clamp, compiled
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.validation import check_numbers

SUBSTEPS = 5  # of a hand in one tick


class HandArm(NamedTuple):
    """An arm and the handle of a device; by default the medians of the simulated people of `guidance`.

    There is no muscle lag: the force on the hand would be a state that a player does not observe, and the spring hardly
    damped.
    """

    mass: float = 1.25  # kg at the hand: 1.0 of the arm (Selen et al. 2009) and 0.25 of the handle
    damping: float = 8.5  # N s/m: 0.05 s times the stiffness (van Beek et al. 2015), and 1 of the handle
    stiffness: float = 150.0  # N/m (van Beek et al. 2015)
    max_force: float = 12.5  # N: the preferred acceleration of a hand, 10 m/s2, times the mass
    reach: float = 0.075  # m of hand travel per unit of action: the radius of an Omega.7's workspace

    def check(self, tick: float, label: str = "arm") -> "HandArm":
        """Return the arm, or raise a ValueError that names the field with which it cannot be moved by `tick` s."""
        values = {f"{label}.{name}": value for name, value in self._asdict().items()}
        free = values.pop(f"{label}.damping")
        check_numbers(1e-6, at_most=1e6, **values)
        check_numbers(0.0, at_most=1e6, **{f"{label}.damping": free})
        stiffest = self.mass * (SUBSTEPS / tick) ** 2  # a quarter of where the integration becomes unstable
        check_numbers(at_most=stiffest, **{f"{label}.stiffness": self.stiffness})
        return self


def arm_from_config(settings: Mapping[str, Any] | None) -> HandArm | None:
    """The arm of `env.arm` in a training's configuration; None, for a paddle without an arm, where that is null.

    Raises:
        ValueError: a setting is unknown or out of range; names it.
    """
    return None if settings is None else construct(HandArm, settings, "env.arm").check(TableSpec().tick, "env.arm")


@compiled
def move_hand(hand: np.ndarray, action: np.ndarray, seconds: float, arm: HandArm) -> None:
    """Move a hand (4,), x, y, vx, vy in m and m/s, by `seconds`, in place; an action (2,) of NaN exerts no force.

    Semi-implicit Euler, as that of the simulated people; the damping is implicit, so it is stable however large.
    """
    dt = seconds / SUBSTEPS
    target_x, target_y = arm.reach * clamp(action[X], -1.0, 1.0), arm.reach * clamp(action[Y], -1.0, 1.0)
    aims = np.isfinite(action[X]) and np.isfinite(action[Y])
    for _ in range(SUBSTEPS):
        force_x, force_y = 0.0, 0.0
        if aims:
            force_x, force_y = arm.stiffness * (target_x - hand[X]), arm.stiffness * (target_y - hand[Y])
            share = arm.max_force / max(hypot(force_x, force_y), arm.max_force)
            force_x, force_y = share * force_x, share * force_y
        damped = 1.0 / (1.0 + dt * arm.damping / arm.mass)
        hand[VX] = damped * (hand[VX] + dt * force_x / arm.mass)
        hand[VY] = damped * (hand[VY] + dt * force_y / arm.mass)
        for axis in (X, Y):
            hand[axis] += dt * hand[axis + 2]
            if abs(hand[axis]) > arm.reach:
                hand[axis], hand[axis + 2] = clamp(hand[axis], -arm.reach, arm.reach), 0.0
