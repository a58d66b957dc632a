"""What TensorBoard shows of a study: means by condition, force and weight histograms, Figure 6 and final scores."""

from pathlib import Path
from string import ascii_lowercase

import pandas as pd
from omegaconf import DictConfig

from airhockey_marl.experiment.tensorboard import (
    add_picture,
    code_block,
    log_final_scores,
    log_run_header,
    open_writer,
    tensorboard_dir,
)
from guidance.statistics.histograms import Histograms
from guidance.statistics.paper import compare_with_paper
from guidance.statistics.report import screen_table
from guidance.statistics.tests import METRICS, conditions_of

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


def log_study(cfg: DictConfig, folder: Path, trials: pd.DataFrame, tests: pd.DataFrame, histograms: Histograms) -> None:
    """Log a study whose report `write_report` has written to `folder`, with the tags of `TAGS`."""
    means = trials.groupby("condition")[list(METRICS)].mean()
    findings = compare_with_paper(tests, list(cfg.users.withdrawn))
    findings = findings.loc[findings["paper"] == "significant", "outcome"]
    with open_writer(tensorboard_dir(folder)) as writer:
        log_run_header(writer, cfg, TAGS, LAYOUT)
        for name, condition in conditions_of(trials).items():
            x = 1 + ascii_lowercase.index(condition.letter)  # a tag per condition: a joint curve would be smoothed
            for metric, mean in means.loc[name].dropna().items():
                writer.add_scalar(f"study/{metric}/{name}", mean, x)
        writer.add_text("means", code_block(screen_table(trials)))
        histograms.log(writer)
        add_picture(writer, "figure/figure6", (folder / "figure6.png").read_bytes(), 0)
    scores = {metric: means[metric].mean() for metric in ("win_rate", "mean_smash_speed", "defense_rate")}
    log_final_scores(folder, cfg, scores | {"replicated": float((findings == "replicated").sum())})
