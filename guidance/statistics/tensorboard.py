"""What TensorBoard shows of a study: means by condition, force and weight histograms, Figure 6 and final scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING

import numpy as np
from omegaconf import DictConfig

from airhockey_marl.experiment.tensorboard import (
    add_picture,
    code_block,
    log_final_scores,
    log_run_header,
    open_writer,
    tensorboard_dir,
)
from guidance.forces.conditions import GuidanceOutput
from guidance.statistics.design import METRICS
from guidance.statistics.report import screen_table

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from guidance.forces.conditions import Condition as PlayedCondition
    from guidance.statistics.groups import Group

BINS = 50
WEIGHTS = GuidanceOutput._fields[1:]
TAGS = {
    "study/*": "mean of a metric over people, study/<metric>/<condition>; x is the condition, (a) to (i) as 1 to 9; "
    "rates are shares from 0 to 1, mean_smash_speed is in m/s, mean_disagreement in N, ratings are from 1 to 7",
    "means/text_summary": "the same means as a table",
    "force/*": "histogram of the size of the force in N over all ticks and people, by condition",
    "w_*": "histogram of a weight (w_unc_optimal, w_unc_user, w_sim) over all ticks and people, by condition",
    "figure/*": "pictures of a study: figure6",
    "score/*": "means over people and conditions of win_rate, defense_rate and mean_smash_speed (m/s), and replicated: "
    "how many of the paper's significant findings are",
}
LAYOUT = {
    "Study: conditions (a) to (i) from left to right": {
        "share of rounds won": [r"study/win_rate/.*"],
        "mean smash speed, in m/s": [r"study/mean_smash_speed/.*"],
        "share of shots stopped": [r"study/defense_rate/.*"],
        "mean disagreement, in N": [r"study/mean_disagreement/.*"],
        "ratings by proxy, from 1 to 7": [r"study/(helpfulness|naturalness|controllability|comfort)/.*"],
    },
}


def log_study(cfg: DictConfig, folder: Path, group: Group, histograms: Histograms) -> None:
    """Log a study whose report `write_report` has written to `folder`, with the tags of `TAGS`."""
    means = group.trials.groupby("condition")[list(METRICS)].mean()
    with open_writer(tensorboard_dir(folder)) as writer:
        log_run_header(writer, cfg, TAGS, LAYOUT)
        for name, condition in group.conditions.items():
            x = 1 + ascii_lowercase.index(condition.letter)  # a tag per condition: a joint curve would be smoothed
            for metric, mean in means.loc[name].dropna().items():
                writer.add_scalar(f"study/{metric}/{name}", mean, x)
        writer.add_text("means", code_block(screen_table(group)))
        histograms.log(writer)
        add_picture(writer, "figure/figure6", (folder / "figure6.png").read_bytes(), 0)
    scores = {metric: means[metric].mean() for metric in ("win_rate", "mean_smash_speed", "defense_rate")}
    log_final_scores(folder, cfg, scores | {"replicated": float((group.findings["outcome"] == "replicated").sum())})


class Histograms:
    """Running histograms of guidance outputs.

    Args:
        users: games of each condition; games are ordered by condition, as in `BatchedGuidance`.
        largest_force: upper end of the force histogram in N.
    """

    def __init__(self, conditions: Sequence[PlayedCondition], users: int, largest_force: float) -> None:
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
