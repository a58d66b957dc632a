"""The statistical tests of section 5 on a tidy table of trials.

Each of the eight metrics is compared across the same participants, within a type of guidance and between types: by a
paired t-test for the two OAHG conditions, and by a repeated measures ANOVA with Greenhouse-Geisser correction for the
three UPHG conditions, the three CombHG conditions and the four types, followed by paired t-tests with Bonferroni
correction. The ratings of simulated people are proxies, and every result about them is marked as `proxy`.

`pingouin` computes the ANOVA (its values agree with SPSS, R and JASP). Pairs are tested by `scipy.stats.ttest_rel`,
because pingouin rounds the confidence interval to two decimals.
"""

from collections.abc import Mapping
from itertools import combinations, product
from typing import Any

import numpy as np
import pandas as pd

from guidance.forces.condition_specs import ConditionSpec
from guidance.statistics.design import (
    ALPHA,
    BEYOND,
    CONDITIONS,
    FAMILIES,
    FEWEST_PARTICIPANTS,
    METRICS,
    Metric,
    conditions_of,
)

EXACT_RANKS = 50  # differences
ROUNDING = 1e-12  # relative size of differences that are rounding errors
NHG = CONDITIONS["nhg"].letter

TESTS_DTYPES = (
    dict.fromkeys(["family", "metric", "kind", "test", "x", "y"], "str")
    | {"n": "int64"}
    | dict.fromkeys(["statistic", "df1", "df2", "epsilon", "p", "p_corrected", "eta_squared", "dz"], "float64")
    | dict.fromkeys(["rank_statistic", "rank_p", "rank_p_corrected"], "float64")
    | dict.fromkeys(["mean_difference", "ci_low", "ci_high"], "float64")
    | {"greater": "str", "anova_not_significant": "bool", "significant": "bool", "proxy": "bool"}
)


def run_tests(
    trials: pd.DataFrame,
    people: bool = False,
    declared: Mapping[str, ConditionSpec] | None = None,
    extra: Mapping[str, Metric] | None = None,
) -> pd.DataFrame:
    """Run every test of section 5 that the conditions present allow.

    Args:
        trials: one row per participant and condition, with the columns `user`, `condition` and the eight `METRICS`;
            NaN excludes a participant from the family's test of that metric. NHG has no disagreement, so the types are
            compared on it without NHG (section 5.2).
        people: the trials are of people: their ratings are no proxies, and some may not have finished; games that
            they have not played count as NaN.
        declared: letters, labels and comparisons of conditions beyond the paper's, see `conditions_of`.
        extra: metrics beside the eight, each a column of the trials, which are tested in the same way.

    Returns:
        One row per test, empty with fewer than three participants; families with an absent condition are skipped.
        Conditions beyond the paper's are compared with the types in the family `beyond`, and each with those that it
        names in `against` in a family of its own name.

        `test`: paired_t, rm_anova, posthoc, or planned (a comparison with a condition named in `against`).
        `x`, `y`, `greater`: the letters of a pair, and that of the larger mean.
        `n`: participants.
        `statistic`, `df1`, `df2`: t or F with its degrees of freedom (uncorrected, as the paper reports them).
        `epsilon`: Greenhouse-Geisser.
        `p`, `p_corrected`: uncorrected; corrected by Greenhouse-Geisser (ANOVA) or Bonferroni (post hoc, planned).
        `rank_statistic`, `rank_p`, `rank_p_corrected`: the same on ranks, which the paper does not report: Friedman's
        chi squared, or Wilcoxon's W with the same Bonferroni correction.
        `eta_squared`: partial. `dz`: mean / SD of the differences x - y.
        `mean_difference`, `ci_low`, `ci_high`: x - y in the metric's unit, with its 95 % interval.
        `anova_not_significant`: a post hoc test after an ANOVA without a significant effect, which the paper omits.
        `significant`: p_corrected < .05 and not anova_not_significant. `proxy`: a rating that is a proxy.
        Statistic and p are NaN where the differences do not vary.
    """
    check_trials(trials, people)
    rows: list[dict[str, Any]] = []
    conditions = conditions_of(trials, declared)
    own = {name: condition for name, condition in conditions.items() if condition.type == BEYOND}
    families, metrics = dict(FAMILIES), METRICS | {name: m for name, m in (extra or {}).items() if name in trials}
    if own:
        families[BEYOND] = FAMILIES["types"] + "".join(condition.letter for condition in own.values())
    if trials["user"].nunique() >= FEWEST_PARTICIPANTS:
        tidy = trials.assign(condition=[conditions[name].letter for name in trials["condition"]])
        for (family, letters), metric in product(families.items(), metrics):
            if (scores := _scores(tidy, metric, letters)) is not None:
                rows += [_about(family, metric, metrics[metric].kind, people) | row for row in _compare(scores)]
        for (name, condition), metric in product(own.items(), metrics):
            pairs = [_scores(tidy, metric, letter + condition.letter) for letter in condition.against]
            pairs = [_paired_t(scores, *scores) for scores in pairs if scores is not None and scores.shape[1] == 2]
            planned = _corrected("planned", pairs, anova_not_significant=False)
            rows += [_about(name, metric, metrics[metric].kind, people) | row for row in planned]
    tests = pd.DataFrame(rows, columns=list(TESTS_DTYPES))
    return tests.fillna({"x": "", "y": "", "greater": ""}).astype(TESTS_DTYPES)


def _scores(tidy: pd.DataFrame, metric: str, letters: str) -> pd.DataFrame | None:
    """Scores (participants, conditions) without missing values; None if a condition is absent."""
    levels = [letter for letter in letters if (letter, metric) != (NHG, "mean_disagreement")]
    if not set(levels) <= set(tidy["condition"]):
        return None
    return tidy.pivot(index="user", columns="condition", values=metric)[levels].astype(float).dropna()


def _about(family: str, metric: str, kind: str, people: bool) -> dict[str, Any]:
    return {"family": family, "metric": metric, "kind": kind, "proxy": kind == "subjective" and not people}


def order_effects(trials: pd.DataFrame) -> list[dict[str, Any]]:
    """How much each objective metric changes from one position in a participant's order to the next.

    Least squares of the metric on the position, with a constant for each participant and for each condition.

    Returns:
        A row per metric: `metric`, `n` (games), `slope`, its 95 % interval `ci_low` to `ci_high`, and `p`. None where
        the positions are not known or are the same for everybody.
    """
    from scipy import stats

    rows: list[dict[str, Any]] = []
    for metric in (name for name, metric in METRICS.items() if metric.kind == "objective" and "position" in trials):
        games = trials[["user", "condition", "position", metric]].dropna()
        if games.empty:
            continue
        constants = pd.get_dummies(games[["user", "condition"]], dtype=float).to_numpy()
        position, scores = (
            games[name].to_numpy(float) - constants @ np.linalg.lstsq(constants, games[name].to_numpy(float))[0]
            for name in ("position", metric)
        )
        df, variation = len(games) - np.linalg.matrix_rank(constants) - 1, position @ position
        if df < 1 or variation < 1e-9 * len(games):
            continue
        slope = position @ scores / variation
        error = np.sqrt(np.sum((scores - slope * position) ** 2) / df / variation)
        half = error * stats.t.isf(0.025, df)
        p = 2 * stats.t.sf(abs(slope) / error, df) if error > 0 else np.nan
        row = {"metric": metric, "n": len(games), "slope": slope, "ci_low": slope - half, "ci_high": slope + half}
        rows.append(row | {"p": p})
    return rows


def check_trials(trials: pd.DataFrame, people: bool = False) -> None:
    """Check that trials can be compared within participants.

    Args:
        people: the trials are of people, who need not all have played the same conditions yet.

    Raises:
        ValueError: an absent column, too many conditions, an infinite value, two rows for one participant and
            condition, or, unless of people, a participant without a row for a condition that others have; the message
            names them.
    """
    if absent := [column for column in ("user", "condition", *METRICS) if column not in trials]:
        raise ValueError(f"trials lack the columns {', '.join(absent)}")
    conditions_of(trials)
    if np.isinf(trials[list(METRICS)].to_numpy(float)).any():
        raise ValueError("trials hold infinite values")
    games = trials.groupby(["user", "condition"]).size()
    if repeated := ", ".join(f"{user} {condition}" for user, condition in games[games > 1].index):
        raise ValueError(f"more than one game of a participant in a condition: {repeated}")
    missing = "; ".join(f"{user} lacks {', '.join(names)}" for user, names in missing_games(trials).items())
    if missing and not people:
        raise ValueError(f"every participant must have played every condition: {missing}")


def missing_games(trials: pd.DataFrame) -> dict[str, list[str]]:
    """The conditions that a participant has not played, by participant, of those who have not played all."""
    games = trials.groupby(["user", "condition"]).size().unstack(fill_value=0)
    absent = {user: [name for name in games if row[name] == 0] for user, row in games.iterrows()}
    return {user: names for user, names in absent.items() if names}


def _compare(scores: pd.DataFrame) -> list[dict[str, Any]]:
    """The tests of one metric in one family; scores (participants, conditions) without missing values."""
    pairs = list(combinations(scores, 2))
    if len(pairs) == 1:
        row = _paired_t(scores, *pairs[0])
        return [row | _verdict("paired_t", row["p"], anova_not_significant=False)]
    anova = _rm_anova(scores)
    anova_not_significant = not anova["p_corrected"] < ALPHA  # also if it is NaN
    posthoc = [_paired_t(scores, *pair) for pair in pairs]
    verdict = _verdict("rm_anova", anova["p_corrected"], anova_not_significant=False)
    return [anova | verdict, *_corrected("posthoc", posthoc, anova_not_significant)]


def _corrected(test: str, rows: list[dict[str, Any]], anova_not_significant: bool) -> list[dict[str, Any]]:
    """Paired tests with Bonferroni's correction for their number."""
    return [
        row
        | _verdict(test, _bonferroni(row["p"], len(rows)), anova_not_significant)
        | {"rank_p_corrected": _bonferroni(row.get("rank_p", np.nan), len(rows))}
        for row in rows
    ]


def _bonferroni(p: float, tests: int) -> float:
    return min(1.0, tests * p) if p >= 0 else np.nan


def _verdict(test: str, p_corrected: float, anova_not_significant: bool) -> dict[str, Any]:
    significant = bool(p_corrected < ALPHA and not anova_not_significant)
    flags = {"anova_not_significant": anova_not_significant, "significant": significant}
    return {"test": test, "p_corrected": p_corrected} | flags


def _constant(values: np.ndarray, scale: float) -> bool:
    """Whether values (any shape) differ by rounding errors only."""
    return bool(np.ptp(values) <= ROUNDING * scale)


def _rm_anova(scores: pd.DataFrame) -> dict[str, Any]:
    import pingouin
    from scipy.stats import friedmanchisquare

    n, levels = scores.shape
    row = {"n": n, "df1": levels - 1, "df2": (levels - 1) * (n - 1), "p_corrected": np.nan}
    if n < FEWEST_PARTICIPANTS:
        return row
    values = scores.to_numpy()
    within_participant = values - values.mean(axis=1, keepdims=True)
    if _constant(within_participant - within_participant.mean(axis=0), np.abs(values).max()):
        return row
    tidy = scores.reset_index().melt("user", var_name="condition", value_name="score")
    anova = pingouin.rm_anova(tidy, "score", "condition", "user", correction=True, effsize="np2").iloc[0]
    friedman = friedmanchisquare(*values.T)
    return row | {
        "rank_statistic": friedman.statistic,
        "rank_p": friedman.pvalue,
        "rank_p_corrected": friedman.pvalue,
        "statistic": anova["F"],
        "epsilon": anova["eps"],
        "p": anova["p_unc"],
        "p_corrected": anova["p_GG_corr"],
        "eta_squared": anova["np2"],
    }


def _paired_t(scores: pd.DataFrame, x: str, y: str) -> dict[str, Any]:
    from scipy import stats

    difference = (scores[x] - scores[y]).to_numpy()
    n = len(difference)
    mean = difference.mean() if n else np.nan
    scale = scores[[x, y]].abs().to_numpy().max(initial=0.0)
    row = {"x": x, "y": y, "n": n, "df1": n - 1, "p": np.nan, "mean_difference": mean}
    if abs(mean) > ROUNDING * scale:
        row["greater"] = x if mean > 0 else y
    if n < FEWEST_PARTICIPANTS or _constant(difference, scale):
        return row
    t = stats.ttest_rel(scores[x], scores[y])
    low, high = t.confidence_interval(0.95)
    dz = mean / difference.std(ddof=1)
    w, rank_p = signed_rank_test(difference)
    return row | {
        "statistic": t.statistic,
        "p": t.pvalue,
        "dz": dz,
        "ci_low": low,
        "ci_high": high,
        "rank_statistic": w,
        "rank_p": rank_p,
        "rank_p_corrected": rank_p,
    }


def signed_rank_test(difference: np.ndarray) -> tuple[float, float]:
    """Wilcoxon's signed-rank test of differences (n,), two-sided: the smaller sum of ranks, and p.

    Differences of zero are left out. p is exact up to `EXACT_RANKS` differences, ties included: the distribution of the
    sum of ranks is the convolution of those of each rank, which is in the sum or not with equal chances. scipy's
    enumerates all signs where there are ties, for which 13 people take minutes. Beyond, it is the normal approximation.
    """
    from scipy import stats

    if np.count_nonzero(difference) > EXACT_RANKS:
        return tuple(stats.wilcoxon(difference, method="approx"))
    difference = difference[difference != 0]
    ranks = (2 * stats.rankdata(np.abs(difference))).astype(int)  # doubled: ties have halves
    chances = np.ones(1)
    for rank in ranks:
        chances = (np.pad(chances, (0, rank)) + np.pad(chances, (rank, 0))) / 2
    w = min(ranks[difference > 0].sum(), ranks[difference < 0].sum())
    return float(w / 2), float(min(1.0, 2 * chances[: w + 1].sum()))
