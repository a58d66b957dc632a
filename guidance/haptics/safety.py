"""One safety layer between the guidance and any device: what reaches a hand is bounded, whatever was asked for.

Plain floats, and no import but the standard library's: it runs a thousand times a second, in a process of its own that
should start at once.
"""

from dataclasses import dataclass, fields
from math import hypot, inf, isfinite, nextafter

Pair = tuple[float, float]

NONE: Pair = (0.0, 0.0)


@dataclass(frozen=True)
class SafetyLimits:
    """What a force on a hand, and the hand itself, must keep to.

    Attributes:
        force: N, the most that the norm of a force may be.
        slew: N/s, the most that a force changes by, but for the drop to nothing of a fault.
        soft_start: s in which the force rises from nothing to its share of one after a start, a grip and a release.
        stale_after: s, a force asked for longer ago is not asked for any more; two ticks of the guidance.
        workspace: m from the center, a hand that is further away is a fault; the corner of the reach is at 0.106 m.
        speed: m/s, a hand that is faster is a fault; 99.9 % of the time in play, hands are slower than 0.8 m/s.

    Raises:
        ValueError: a limit is out of range; names the field, the value and what is allowed.
    """

    force: float = 3.0
    slew: float = 150.0
    soft_start: float = 0.5
    stale_after: float = 0.04
    workspace: float = 0.12
    speed: float = 2.5

    def __post_init__(self) -> None:
        for item in fields(self):
            value, name = getattr(self, item.name), item.name
            number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
            if not number or value < 0 or (value == 0 and name != "soft_start"):
                allowed = "of at least 0" if name == "soft_start" else "above 0"
                raise ValueError(f"safety.{name} = {value} must be a finite number {allowed}")


def clip_norm(x: float, y: float, most: float) -> Pair:
    """The vector (x, y), if it is longer than `most` shortened to it; nothing if it is not finite.

    The norm of what is returned is never above `most`, not by a rounding either.
    """
    if not (isfinite(x) and isfinite(y)):
        return NONE
    norm = hypot(x, y)
    if norm <= most:
        return x, y
    if norm == inf:  # of two huge but finite numbers
        x, y = x / 4, y / 4
        norm = hypot(x, y)
    x, y = x / norm * most, y / norm * most
    while hypot(x, y) > most:
        x, y = nextafter(x, 0.0), nextafter(y, 0.0)
    return x, y


class Safety:
    """Lets a force through to the hand, as far as its limits allow.

    In every step: what is returned is finite; its norm is at most `limits.force`; it differs from what was returned
    before by at most `limits.slew` times the step, unless it drops to nothing because of a fault. A fault stays until
    it is released.

    Attributes:
        fault: why there is no force, in words; None while there may be one.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits, self.fault = limits, None
        self._force = NONE
        self._live = 0.0  # s in which a force could act since the start, the last grip or the last release
        self._sound = False  # whether the hand was last seen finite, inside and slow

    def filter(self, force: Pair, age: float, position: Pair, velocity: Pair, held: bool, seconds: float) -> Pair:
        """The force that may act now, N.

        Args:
            force: (2,) N, what is asked for; none if it is not finite.
            age: s since it was asked for.
            position: (2,) m, the hand from the center.
            velocity: (2,) m/s, the hand's.
            held: the hand is at the device.
            seconds: s of this step.
        """
        limits = self.limits
        wrong = self._wrong(position, velocity, seconds)
        self._sound = wrong is None
        if wrong is not None:
            self._trip(wrong)
        if self.fault is not None:
            return NONE
        x = y = 0.0
        if not held:
            self._live = 0.0
        elif age <= limits.stale_after:
            self._live = min(self._live + seconds, limits.soft_start)
            x, y = clip_norm(force[0], force[1], limits.force)
            if self._live < limits.soft_start:
                share = self._live / limits.soft_start
                x, y = x * share, y * share
        was_x, was_y = self._force
        most = limits.slew * seconds
        if hypot(x - was_x, y - was_y) > most:
            change_x, change_y = clip_norm(x - was_x, y - was_y, most)
            x, y = clip_norm(was_x + change_x, was_y + change_y, limits.force)
        self._force = x, y
        return self._force

    def rest(self) -> None:
        """Nothing acts and nothing is asked for: the next force starts softly. A fault stays."""
        self._force, self._live = NONE, 0.0

    def fail(self, reason: str) -> None:
        """The device failed: a fault, which cannot be released before a step in which it did not."""
        self._sound = False
        self._trip(reason)

    def release(self) -> bool:
        """End a fault if the hand was last seen finite, inside and slow; the force then starts softly.

        Returns:
            Whether there is no fault any more.
        """
        if self._sound:
            self.fault = None
        return self.fault is None

    def _trip(self, reason: str) -> None:
        if self.fault is None:
            self.fault, self._force, self._live = reason, NONE, 0.0

    def _wrong(self, position: Pair, velocity: Pair, seconds: float) -> str | None:
        limits = self.limits
        away, speed = hypot(position[0], position[1]), hypot(velocity[0], velocity[1])
        # comparisons this way round, because none holds for a number that is not one
        if away <= limits.workspace and speed <= limits.speed and 0.0 < seconds < inf:
            return None
        if not (isfinite(away) and isfinite(speed)):
            return f"the device reports a hand at {position} m with a velocity of {velocity} m/s"
        if not away <= limits.workspace:
            return f"the hand is {away:.3f} m from the center, further than {limits.workspace:g} m"
        if not speed <= limits.speed:
            return f"the hand moves at {speed:.2f} m/s, faster than {limits.speed:g} m/s"
        return f"a step took {seconds} s"
