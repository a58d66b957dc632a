"""A mouse: the hand is at the pointer, and the force is what deflects it from there. Nothing pushes the real hand."""

import numpy as np

from guidance.haptics.devices.pointed import PointedHand


class Mouse(PointedHand):
    """A `VirtualDevice` whose hand is the mouse's pointer, see `PointedHand`."""

    held = True  # what is pushed says whether the window has the focus

    def advance(self, seconds: float, state: np.ndarray) -> None:
        """Let time pass; the game does not matter to it."""
        self.move(seconds)

    def close(self) -> None:
        """There is nothing to let go of."""
        self.relax()
