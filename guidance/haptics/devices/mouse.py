"""A mouse: the hand is at its pointer, and a force deflects the hand from there. Nothing pushes the real hand."""

import numpy as np

from guidance.haptics.devices.pointer import PointerHand


class Mouse(PointerHand):
    """A `VirtualDevice` whose hand is at the mouse's pointer, see `PointerHand`."""

    is_held = True  # `HapticHand.push` reports whether the window has the focus

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Simulate the passing of time; the game's state has no effect."""
        self.move(seconds)

    def close(self) -> None:
        """Apply no force."""
        self.relax()
