"""How large the forces and the weights of each condition were, over every tick of everybody's games."""

from collections.abc import Sequence

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from airhockey_marl.experiment.validation import check_counts, check_numbers, check_rows
from guidance.forces.conditions import Condition, GuidanceOutput

BINS = 50
WEIGHTS = GuidanceOutput._fields[1:]


class Histograms:
    """Counts by condition; games are ordered as in `guide.Guide`, condition by condition.

    Args:
        users: games of each condition.
        largest_force: N, that no force exceeds.
    """

    def __init__(self, conditions: Sequence[Condition], users: int, largest_force: float) -> None:
        check_counts(users=users)
        check_numbers(0.0, largest_force=largest_force)
        self.conditions, self.users, self.largest_force = list(conditions), users, largest_force
        self.counts: dict[str, np.ndarray] = {}  # by name of the signal: (conditions, BINS)
        self.sums: dict[str, np.ndarray] = {}  # (conditions, 2): of the values, and of their squares

    def add(self, guided: GuidanceOutput, games: np.ndarray) -> None:
        """Count what the games (k,) were answered in a tick."""
        check_rows("games", games, len(self.conditions) * self.users)
        if len(guided.force) != len(games):
            raise ValueError(f"guided: of {len(guided.force)} games, must be of {len(games)} as games")
        which = games // self.users
        self._count("force", np.linalg.norm(guided.force.numpy(), axis=-1), which, self.largest_force)
        for name in WEIGHTS:
            if (weights := getattr(guided, name)) is not None:
                self._count(name, weights.numpy(), which, 1.0)

    def _count(self, name: str, values: np.ndarray, which: np.ndarray, largest: float) -> None:
        n = len(self.conditions)
        counts = self.counts.setdefault(name, np.zeros((n, BINS), dtype=np.int64))
        sums = self.sums.setdefault(name, np.zeros((n, 2)))
        has = np.isfinite(values)  # a condition without this weight has none
        values, which = values[has], which[has]
        share = values / largest if largest > 0 else np.zeros_like(values)  # a spring that is clipped to nothing
        bins = np.clip((share * BINS).astype(np.int64), 0, BINS - 1)
        counts += np.bincount(which * BINS + bins, minlength=n * BINS).reshape(n, BINS)
        for power in (1, 2):
            sums[:, power - 1] += np.bincount(which, values**power, minlength=n)

    def log(self, writer: SummaryWriter) -> None:
        """Log `force/<condition>` and `w_*/<condition>`, those that there were any of."""
        for name, counts in self.counts.items():
            largest = self.largest_force if name == "force" else 1.0
            edges = np.linspace(0.0, largest, BINS + 1)
            for condition, row, (total, squares) in zip(self.conditions, counts, self.sums[name], strict=True):
                if not row.any():
                    continue
                filled = np.flatnonzero(row)
                low, high = edges[filled[0]], edges[filled[-1] + 1]
                tag = f"{name}/{condition.name}"
                writer.add_histogram_raw(tag, low, high, row.sum(), total, squares, edges[1:].tolist(), row.tolist())
