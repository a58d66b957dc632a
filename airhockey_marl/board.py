"""TensorBoard's files, in which a run that was stopped and goes on shows every step once."""

import re
import time
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

STAMPED = re.compile(r"(events\.out\.tfevents\.)(\d{10})(\..*)")


def open_board(folder: Path, purge_step: int) -> SummaryWriter:
    """Go on writing scalars; what was logged from `purge_step` on, by a run that was killed, is struck out.

    TensorBoard reads files in the order of the seconds in their names, and strikes out of what it has read before.
    Files that are not older than now, because the clock was set back or went on no second, are given older names.
    """
    now, stamped = int(time.time()), sorted(path for path in folder.glob("events*") if STAMPED.fullmatch(path.name))
    for place, path in enumerate(stamped):
        prefix, second, rest = STAMPED.fullmatch(path.name).groups()
        oldest_left = now - (len(stamped) - place)
        if int(second) > oldest_left:
            path.rename(path.with_name(f"{prefix}{oldest_left:010d}{rest}"))
    return SummaryWriter(str(folder), purge_step=purge_step)
