"""Safety layer between the guidance and any device: bounds every force on a hand, whatever the guidance requests.

Plain floats, and no numpy: the layer runs at 1 kHz in a process of its own, which must start quickly.
"""

from dataclasses import dataclass
from math import hypot, inf, isfinite, nextafter

from airhockey_marl.experiment.validation import check_numbers, labeled
from guidance.haptics.devices import Pair

NO_FORCE: Pair = (0.0, 0.0)


@dataclass(frozen=True)
class SafetyLimits:
    """Limits of the force on a hand, and of the hand itself.

    Attributes:
        force: N, maximum norm of a force.
        slew: N/s, maximum rate of change of the force; a fault alone drops it to zero at once.
        soft_start: s over which the force ramps up from zero after a start, a new grip or a release.
        stale_after: s, age at which a request expires; two ticks of the guidance.
        workspace: m from the center; a hand further away is a fault. The corner of the reach is at 0.106 m.
        speed: m/s; a faster hand is a fault. In play, 99.9 % of the time hands are slower than 0.8 m/s.
    """

    force: float = 3.0
    slew: float = 150.0
    soft_start: float = 0.5
    stale_after: float = 0.04
    workspace: float = 0.12
    speed: float = 2.5

    def __post_init__(self) -> None:
        check_numbers(0.0, **labeled(self, "safety", "soft_start"))
        check_numbers(above=0.0, **labeled(self, "safety", "force", "slew", "stale_after", "workspace", "speed"))


def clip_norm(x: float, y: float, most: float) -> Pair:
    """The vector (x, y) with its norm clipped to `most`; zero if it is not finite.

    The norm of the result never exceeds `most`, not even by a rounding error.
    """
    if not (isfinite(x) and isfinite(y)):
        return NO_FORCE
    norm = hypot(x, y)
    if norm <= most:
        return x, y
    if norm == inf:  # overflow of two huge but finite numbers
        x, y = x / 4, y / 4
        norm = hypot(x, y)
    x, y = x / norm * most, y / norm * most
    while hypot(x, y) > most:
        x, y = nextafter(x, 0.0), nextafter(y, 0.0)
    return x, y


class Safety:
    """Filters the forces on a hand so that they stay within limits.

    In every step, the result is finite, its norm is at most `limits.force`, and it differs from the previous result by
    at most `limits.slew` times the step, unless a fault drops it to zero. A fault lasts until it is released.

    Attributes:
        fault: reason why there is no force; None without a fault.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits, self.fault = limits, None
        self._force = NO_FORCE
        self._ramp = 0.0  # s in which a force could act since the start, the last grip or the last release
        self._is_hand_ok = False  # whether the last hand was finite, inside the workspace and slow enough

    def filter(self, force: Pair, age: float, position: Pair, velocity: Pair, is_held: bool, seconds: float) -> Pair:
        """The force that may act in this step, (2,) N.

        Args:
            force: (2,) N, the requested force; zero if it is not finite.
            age: s since the request.
            position: (2,) m, the hand relative to the center.
            velocity: (2,) m/s, of the hand.
            is_held: whether the hand is at the device.
            seconds: s, duration of this step.
        """
        limits = self.limits
        problem = self._problem(position, velocity, seconds)
        self._is_hand_ok = problem is None
        if problem is not None:
            self._trip(problem)
        if self.fault is not None:
            return NO_FORCE
        x = y = 0.0
        if not is_held:
            self._ramp = 0.0
        elif age <= limits.stale_after:
            self._ramp = min(self._ramp + seconds, limits.soft_start)
            x, y = clip_norm(force[0], force[1], limits.force)
            if self._ramp < limits.soft_start:
                gain = self._ramp / limits.soft_start
                x, y = x * gain, y * gain
        old_x, old_y = self._force
        max_change = limits.slew * seconds
        if hypot(x - old_x, y - old_y) > max_change:
            change_x, change_y = clip_norm(x - old_x, y - old_y, max_change)
            x, y = clip_norm(old_x + change_x, old_y + change_y, limits.force)
        self._force = x, y
        return self._force

    def rest(self) -> None:
        """Drop the force to zero; the next one ramps up. A fault remains."""
        self._force, self._ramp = NO_FORCE, 0.0

    def fail(self, reason: str) -> None:
        """Report a device failure: a fault that can be released only after a step without one."""
        self._is_hand_ok = False
        self._trip(reason)

    def release(self) -> bool:
        """End a fault if the last hand was finite, inside the workspace and slow enough; the force then ramps up.

        Returns:
            Whether there is no fault now.
        """
        if self._is_hand_ok:
            self.fault = None
        return self.fault is None

    def _trip(self, reason: str) -> None:
        if self.fault is None:
            self.fault, self._force, self._ramp = reason, NO_FORCE, 0.0

    def _problem(self, position: Pair, velocity: Pair, seconds: float) -> str | None:
        limits = self.limits
        away, speed = hypot(position[0], position[1]), hypot(velocity[0], velocity[1])
        # NaN fails every comparison, so each tests for the valid range
        if away <= limits.workspace and speed <= limits.speed and 0.0 < seconds < inf:
            return None
        if not (isfinite(away) and isfinite(speed)):
            return f"the device reports a hand at {position} m with a velocity of {velocity} m/s"
        if not away <= limits.workspace:
            return f"the hand is {away:.3f} m from the center, further than {limits.workspace:g} m"
        if not speed <= limits.speed:
            return f"the hand moves at {speed:.2f} m/s, faster than {limits.speed:g} m/s"
        return f"a step took {seconds} s"
