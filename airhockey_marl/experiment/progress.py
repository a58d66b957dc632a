"""Progress on standard error: a bar on a terminal, a line a minute in a log."""

import sys
from typing import Any

from tqdm import tqdm

LOG_INTERVAL = 60.0  # s


class LogProgress(tqdm):
    """A `tqdm` that prints a line at most every `LOG_INTERVAL`, and none for what takes less."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        waits = {"delay": LOG_INTERVAL, "mininterval": LOG_INTERVAL, "maxinterval": LOG_INTERVAL, "miniters": 1}
        line = "{desc}: {n_fmt} of {total_fmt} {unit}, {elapsed}, {remaining} left{postfix}"
        super().__init__(*arguments, **options, **waits, bar_format=line, leave=False)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        if msg is None:
            print(str(self), file=self.fp, flush=True)

    def close(self) -> None:
        if not self.disable:
            self.disable = True
            self._decr_instances(self)


def progress_bar(*arguments: Any, **options: Any) -> tqdm:
    """A `tqdm` on standard error, or a `LogProgress` where that is no terminal."""
    return (tqdm if sys.stderr.isatty() else LogProgress)(*arguments, file=sys.stderr, **options)


class ProgressBar:
    """Progress of work that comes in phases."""

    def __init__(self) -> None:
        self._bar, self._phase = None, ""

    def __call__(self, phase: str, share: float) -> None:
        """Show that the share (0 to 1) of this phase is done."""
        if phase != self._phase:
            self.close()
            self._phase, self._bar = phase, progress_bar(total=100, desc=phase, unit="%")
        self._bar.update(round(100 * share) - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
