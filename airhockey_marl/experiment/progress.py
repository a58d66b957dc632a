"""Progress bars."""

import sys

from tqdm import tqdm


class ProgressBar:
    """A progress bar on standard error for work that comes in phases; silent where there is no terminal."""

    def __init__(self) -> None:
        self._bar, self._phase = None, ""

    def __call__(self, phase: str, share: float) -> None:
        """Show that the share (0 to 1) of this phase is done."""
        if phase != self._phase:
            self.close()
            self._phase, self._bar = phase, tqdm(total=100, desc=phase, unit="%", file=sys.stderr, disable=None)
        self._bar.update(round(100 * share) - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
