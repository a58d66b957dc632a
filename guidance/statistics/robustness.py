"""Robustness of the paper's findings over many studies: replication rates, effect sizes, influence of assumptions."""

from collections.abc import Collection

import numpy as np
import pandas as pd

from guidance.statistics.design import METRICS
from guidance.statistics.paper import EVIDENCE, compare_with_paper
from guidance.statistics.tests import run_tests

PAIR = ["id", "family", "metric", "x", "y"]
KEPT = [*PAIR, "evidence", "paper", "paper_greater", "dz_paper", "p_paper", "outcome", "significant", "greater", "dz"]


def outcomes_of(trials: pd.DataFrame, withdrawn: Collection[str] = ()) -> pd.DataFrame:
    """The comparison of one study with the paper: a row per pair.

    Args:
        trials: of one study, see `run_tests`.
        withdrawn: metrics that do not count.

    Returns:
        Columns of `compare_with_paper`, and of findings `dz_toward_paper`, the effect size in the paper's direction.
    """
    comparison = compare_with_paper(run_tests(trials), withdrawn)[KEPT]
    sign = np.where(comparison["x"] == comparison["paper_greater"], 1.0, -1.0)
    return comparison.assign(dz_toward_paper=np.where(comparison["id"] != "", sign * comparison["dz"], np.nan))


def scores_of(trials: pd.DataFrame, outcomes: pd.DataFrame) -> dict[str, float]:
    """Scores of one study: findings replicated by evidence class, other outcomes, mean weights, unguided play."""
    outcome = outcomes["outcome"]
    scores = {
        f"replicated_{evidence}": int((outcomes["evidence"].eq(evidence) & outcome.eq("replicated")).sum())
        for evidence in EVIDENCE
    }
    scores["replicated"] = sum(scores.values())
    scores |= {name: int(outcome.eq(name).sum()) for name in ("reversed", "false_positives")}
    scores |= {name: trials[f"{name}_mean"].mean() for name in ("w_unc_optimal", "w_unc_user", "w_sim")}
    unguided = trials.loc[trials["condition"] == "nhg"]
    return scores | {
        "win_rate_nhg": unguided["win_rate"].mean(),
        "round_s_nhg": unguided["duration_s"].sum() / unguided["rounds"].sum(),
    }


def findings_over(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Replication rate and effect size of each finding in each group of studies.

    Args:
        outcomes: rows of `outcomes_of` of many studies, and their `group` and `study`.

    Returns:
        Per group and finding: `studies`, the shares `replicated` and `reversed`, and the `median`, `low` and `high` (5
        and 95 %) of the effect size in the paper's direction.
    """
    findings = outcomes[outcomes["id"].ne("")]
    keys = ["group", *PAIR, "evidence", "paper_greater", "dz_paper"]
    grouped = findings.groupby(keys, sort=False, dropna=False)
    shares = {
        name: grouped["outcome"].agg(lambda column, name=name: column.eq(name).mean())
        for name in ("replicated", "reversed", "withdrawn")
    }
    effect = grouped["dz_toward_paper"]
    quantiles = {name: effect.quantile(q) for name, q in (("median", 0.5), ("low", 0.05), ("high", 0.95))}
    return pd.DataFrame({"studies": grouped.size(), **shares, **quantiles}).reset_index()


def false_positives_over(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Share of the studies of a group in which a non-finding of the paper is significant, per non-finding."""
    others = outcomes[outcomes["id"].eq("")]
    keys = ["group", "family", "metric", "x", "y", "paper"]
    return others.groupby(keys, sort=False)["outcome"].agg(lambda c: c.eq("false_positives").mean()).reset_index()


def effects_of(trials: pd.DataFrame) -> pd.DataFrame:
    """How each condition of one study differs from no guidance: a row per condition and metric.

    Returns:
        `condition`, `metric`, `mean` over people, `difference` from NHG, and its effect size `dz`. The last two are NaN
        without NHG in the study, and for disagreement, which NHG has none of.
    """
    rows = []
    for metric in METRICS:
        scores = trials.pivot(index="user", columns="condition", values=metric)
        gains = scores.sub(scores["nhg"], axis=0) if "nhg" in scores else scores * np.nan
        spread = gains.std().replace(0.0, np.nan)
        rows.append(
            pd.DataFrame({"mean": scores.mean(), "difference": gains.mean(), "dz": gains.mean() / spread})
            .rename_axis("condition")
            .reset_index()
            .assign(metric=metric)
        )
    return pd.concat(rows, ignore_index=True)


def effects_over(effects: pd.DataFrame) -> pd.DataFrame:
    """The effects of `effects_of` over the studies of each group.

    Args:
        effects: rows of `effects_of` of many studies, and their `group` and `study`.

    Returns:
        Per group, metric and condition: `studies`; of `mean`, `difference` and `dz` the mean, and the 5 and 95 %
        quantiles as `<name>_low` and `<name>_high`; `positive`, the share of the studies whose difference is above 0.
    """
    grouped = effects.groupby(["group", "metric", "condition"], sort=False)
    columns = {"studies": grouped.size()}
    for name in ("mean", "difference", "dz"):
        columns |= {name: grouped[name].mean(), f"{name}_low": grouped[name].quantile(0.05)}
        columns[f"{name}_high"] = grouped[name].quantile(0.95)
    columns["positive"] = grouped["difference"].agg(lambda gains: (gains > 0).mean() if gains.notna().any() else np.nan)
    return pd.DataFrame(columns).reset_index()


def shuffle_conditions(trials: pd.DataFrame, seed: int) -> pd.DataFrame:
    """The trials of one study with each person's games in random order: a study without any effect of guidance.

    Disagreement goes round among the conditions that have a force.
    """
    rng, trials = np.random.default_rng(seed), trials.copy()
    guided = trials["condition"].ne("nhg")
    free = [name for name in METRICS if name != "mean_disagreement"]
    for rows in trials.groupby("user", sort=False).groups.values():
        trials.loc[rows, free] = trials.loc[rng.permutation(rows), free].to_numpy()
        rows = rows[guided[rows]]
        trials.loc[rows, "mean_disagreement"] = trials.loc[rng.permutation(rows), "mean_disagreement"].to_numpy()
    return trials


def adaptation_effects(outcomes: pd.DataFrame) -> pd.DataFrame:
    """The effect of UA, (e) against (d), per group: mean effect size of e - d, and its 95 % interval over studies.

    Returns:
        `group`, `metric`, `studies`, `mean`, `low`, `high`.
    """
    from scipy.stats import t

    pairs = outcomes[outcomes["x"].eq("d") & outcomes["y"].eq("e")]
    grouped = pairs.groupby(["group", "metric"], sort=False)["dz"]
    n, mean, error = grouped.count(), -grouped.mean(), grouped.sem()
    half = error * t.isf(0.025, (n - 1).where(n > 1))
    return pd.DataFrame({"studies": n, "mean": mean, "low": mean - half, "high": mean + half}).reset_index()


def influential_assumptions(outcomes: pd.DataFrame, factors: pd.DataFrame, strongest: int = 3) -> pd.DataFrame:
    """The assumptions that each finding's effect size depends on most.

    Args:
        outcomes: as for `findings_over`, of the studies of one group.
        factors: by `study`, the factor of each assumption.
        strongest: number of assumptions per finding.

    Returns:
        Per finding the assumptions with the largest Spearman correlation, in size, between factor and effect in the
        paper's direction: `parameter`, `correlation`, and `p` with Bonferroni's correction over the assumptions.
    """
    from scipy.stats import spearmanr

    rows = []
    for key, studies in outcomes[outcomes["id"].ne("")].groupby(PAIR, sort=False):
        effect = studies.set_index("study")["dz_toward_paper"].dropna()
        if len(effect) < 5 or effect.nunique() < 2:
            continue
        here = factors.loc[effect.index]
        correlations = [(name, *spearmanr(here[name], effect)) for name in here]
        correlations.sort(key=lambda entry: -abs(entry[1]))
        rows += [
            dict(zip(PAIR, key, strict=True))
            | {"parameter": name, "correlation": rho, "p": min(1.0, p * len(here.columns))}
            for name, rho, p in correlations[:strongest]
        ]
    return pd.DataFrame(rows, columns=[*PAIR, "parameter", "correlation", "p"])
