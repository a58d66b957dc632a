"""Histograms of the forces and weights of each condition over all ticks and people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from guidance.forces.conditions import Condition, GuidanceOutput

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

BINS = 50
WEIGHTS = GuidanceOutput._fields[1:]


class Histograms:
    """Running histograms of guidance outputs.

    Args:
        users: games of each condition; games are ordered by condition, as in `BatchedGuidance`.
        largest_force: upper end of the force histogram in N.
    """

    def __init__(self, conditions: Sequence[Condition], users: int, largest_force: float) -> None:
        self.conditions, self.users, self.largest_force = list(conditions), users, largest_force
        self.counts: dict[str, np.ndarray] = {}  # by signal: (conditions, BINS)
        self.sums: dict[str, np.ndarray] = {}  # (conditions, 2): sums of values and of squares

    def add(self, output: GuidanceOutput, games: np.ndarray) -> None:
        """Count the guidance output (k, ...) of a tick in the games (k,), by index."""
        condition = games // self.users
        self._count("force", np.linalg.norm(output.force.numpy(), axis=-1), condition, self.largest_force)
        for name in WEIGHTS:
            if (weights := getattr(output, name)) is not None:
                self._count(name, weights.numpy(), condition, 1.0)

    def _count(self, name: str, values: np.ndarray, condition: np.ndarray, largest: float) -> None:
        n = len(self.conditions)
        counts = self.counts.setdefault(name, np.zeros((n, BINS), dtype=np.int64))
        sums = self.sums.setdefault(name, np.zeros((n, 2)))
        known = np.isfinite(values)  # NaN in a condition without this weight
        values, condition = values[known], condition[known]
        share = values / largest if largest > 0 else np.zeros_like(values)  # 0: a spring with a limit of 0 N
        bins = np.clip((share * BINS).astype(np.int64), 0, BINS - 1)
        counts += np.bincount(condition * BINS + bins, minlength=n * BINS).reshape(n, BINS)
        for power in (1, 2):
            sums[:, power - 1] += np.bincount(condition, values**power, minlength=n)

    def log(self, writer: SummaryWriter) -> None:
        """Log `force/<condition>` and `w_*/<condition>`, except for histograms without a value."""
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
