"""The report of many replicated studies."""

import base64
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from airhockey_marl.experiment.files import atomic_write, write_text
from airhockey_marl.experiment.html import template
from airhockey_marl.experiment.plotting import save_figure
from airhockey_marl.experiment.validation.tables import Column, read_table
from guidance.statistics.codebook import TRIAL_COLUMNS
from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.figures import robustness_map
from guidance.statistics.paper import EVIDENCE, reference_points
from guidance.statistics.robustness import (
    adaptation_effects,
    effects_of,
    effects_over,
    false_positives_over,
    findings_over,
    influential_assumptions,
    outcomes_of,
    scores_of,
    shuffle_conditions,
)
from guidance.study.replication import NO_LEARNING, ONE_PLAYSTYLE, REPLICATES, SHUFFLED_ADAPTATION, batches_of

SHUFFLED_CONDITIONS = "shuffled"  # a group of studies that is not played: the first replicates, with other labels
BATCH_COLUMNS = TRIAL_COLUMNS | {"study": Column(low=0.0, whole=True)}

NAMES = {  # of groups of studies; the others are of other assumptions
    REPLICATES: "as the study is",
    SHUFFLED_ADAPTATION: "UA from somebody else’s game",
    ONE_PLAYSTYLE: "people of one style",
    NO_LEARNING: "people who learn no force",
    SHUFFLED_CONDITIONS: "conditions shuffled within people",
}


def summarize(folder: Path, cfg: DictConfig, facts: dict, factors: pd.DataFrame) -> str:
    """Test every study, write tables, figure and page to `folder`, and return a table for the screen."""
    withdrawn, outcomes, scores, effects = list(cfg.users.withdrawn), [], [], []
    for group, study, trials in _studies(folder, cfg):
        outcome = outcomes_of(trials, withdrawn)
        outcomes.append(outcome.assign(group=group, study=study))
        scores.append({"group": group, "study": study} | scores_of(trials, outcome))
        effects.append(effects_of(trials).assign(group=group, study=study))
    outcomes, scores = pd.concat(outcomes, ignore_index=True), pd.DataFrame(scores)
    effects = effects_over(pd.concat(effects, ignore_index=True))
    findings, wrong = findings_over(outcomes), false_positives_over(outcomes)
    groups = list(scores["group"].unique())
    variants = [variant for variant in cfg.sensitivity.variants if variant in groups]
    leans = {name: influential_assumptions(outcomes[outcomes["group"] == name], factors) for name in variants}
    tables = {"outcomes": outcomes, "studies": scores, "robustness": findings, "effects": effects}
    for name, table in tables.items():
        with atomic_write(folder / f"{name}.csv") as temporary:
            table.to_csv(temporary, index=False)
    names = {group: NAMES.get(group, f"other assumptions, {group}") for group in groups}
    svg = save_figure(lambda: robustness_map(findings, names), folder, "robustness", dpi=130)
    by_group = {}
    for group, rows in scores.groupby("group", sort=False):
        rows = rows.drop(columns=["group", "study"])
        points = {"mean": rows.mean(), "low": rows.quantile(0.05), "high": rows.quantile(0.95)}
        by_group[group] = {"studies": len(rows)} | pd.DataFrame(points).T.to_dict()
    by_chance, rerun = reference_points(cfg.participants)
    page = template(Path(__file__).parent / "templates", "replication_report.html").render(
        groups=by_group,
        wrong=wrong[wrong["outcome"] >= 0.25].sort_values("outcome", ascending=False).to_dict("records"),
        leans={group: table[table["p"] < 0.05].to_dict("records") for group, table in leans.items()},
        evidence=EVIDENCE,
        metrics=METRICS,
        withdrawn=withdrawn,
        cells=findings.loc[findings["group"] == groups[0], "evidence"].value_counts().to_dict(),
        counting=int((findings.loc[findings["group"] == groups[0], "withdrawn"] == 0).sum()),
        by_chance=by_chance,
        rerun=rerun,
        figure=base64.b64encode(svg).decode("ascii"),
        facts=facts,
        names=names,
        participants=cfg.participants,
        ua=adaptation_effects(outcomes).to_dict("records"),
        effects=_by_condition(effects[effects["group"] == groups[0]]),
    )
    write_text(folder / "replicate.html", page)
    width = max(map(len, by_group)) + 2
    titles = f"{'':{width}}{'studies':>8}{'of 38':>16}" + "".join(f"{e:>8}" for e in EVIDENCE)
    lines = [f"{titles}{'reversed':>10}{'wrong':>8}"]
    for group, row in by_group.items():
        total = row["replicated"]
        share = f"{total['mean']:>6.1f} [{total['low']:.0f}, {total['high']:.0f}]"
        lines.append(
            f"{group:{width}}{row['studies']:>8}{share:16}"
            + "".join(f"{row[f'replicated_{e}']['mean']:>8.1f}" for e in EVIDENCE)
            + f"{row['reversed']['mean']:>10.1f}{row['false_positives']['mean']:>8.1f}"
        )
    return "\n".join(lines)


def _studies(folder: Path, cfg: DictConfig) -> Iterator[tuple[str, int, pd.DataFrame]]:
    """Group, number and trials of every study, and of the first replicates with their conditions shuffled."""
    shuffled = []
    for batch in batches_of(cfg):
        for study, trials in read_table(batch.file(folder), BATCH_COLUMNS).groupby("study"):
            yield batch.group, study, trials
            if batch.group == REPLICATES and study < cfg.controls:
                shuffled.append((SHUFFLED_CONDITIONS, study, shuffle_conditions(trials, cfg.seed + study)))
    yield from shuffled


def _by_condition(effects: pd.DataFrame) -> dict[str, dict[str, dict]]:
    """The rows of `effects_over` of one group, by label of the condition and metric."""
    names = [name for name in CONDITIONS if name in set(effects["condition"])]
    rows = effects.set_index(["condition", "metric"])
    return {
        f"({CONDITIONS[name].letter}) {CONDITIONS[name].label}": {
            metric: rows.loc[name, metric].to_dict() for metric in METRICS
        }
        for name in names
    }
