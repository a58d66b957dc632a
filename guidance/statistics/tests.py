"""The paper's statistics (section 5) on a tidy table of games, and the paper's own findings beside them.

Within a guidance type, and then between types, every one of the eight metrics is compared across the same
participants: a paired t-test for the two OAHG conditions, a repeated measures ANOVA with Greenhouse-Geisser correction
for the three UPHG, the three CombHG and the four types, and after a significant ANOVA paired t-tests with Bonferroni
correction. Of simulated people the four ratings are proxies, and every result about them says `proxy`; people rate.

`pingouin` computes the ANOVA (its values agree with SPSS, R and JASP). The pairs come from `scipy.stats.ttest_rel`,
because pingouin rounds the confidence interval to two decimals.
"""

from itertools import combinations, product
from string import ascii_lowercase
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pingouin
from scipy import stats

ALPHA = 0.05
FEWEST_PARTICIPANTS = 3  # two participants leave a single degree of freedom for a difference
ROUNDING = 1e-12  # differences below this share of the values are rounding, not data


class Condition(NamedTuple):
    """A condition: its letter and name, in the paper (section 4.2) for the nine of it, and its type of guidance."""

    letter: str
    label: str
    guidance: str


class Metric(NamedTuple):
    """A metric of the user study (section 4.3)."""

    label: str
    kind: str  # objective | subjective
    unit: str


CONDITIONS = {
    "nhg": Condition("a", "NHG", "NHG"),
    "oahg": Condition("b", "OAHG (vanilla)", "OAHG"),
    "oahg_ut": Condition("c", "OAHG (UT)", "OAHG"),
    "uphg": Condition("d", "UPHG (vanilla)", "UPHG"),
    "uphg_ua": Condition("e", "UPHG (UA)", "UPHG"),
    "uphg_ut_ua": Condition("f", "UPHG (UT+UA)", "UPHG"),
    "combhg_ua": Condition("g", "CombHG (UA)", "CombHG"),
    "combhg_ua_sc": Condition("h", "CombHG (UA+SC)", "CombHG"),
    "combhg_ut_ua_sc": Condition("i", "CombHG (UT+UA+SC)", "CombHG"),
}
METRICS = {
    "win_rate": Metric("Win rate", "objective", "share of rounds"),
    "mean_smash_speed": Metric("Mean smash speed", "objective", "m/s"),
    "defense_rate": Metric("Defense rate", "objective", "share of pucks blocked"),
    "mean_disagreement": Metric("Mean disagreement", "objective", "N"),
    "helpfulness": Metric("Helpfulness", "subjective", "1-7"),
    "naturalness": Metric("Naturalness", "subjective", "1-7"),
    "controllability": Metric("Controllability", "subjective", "1-7"),
    "comfort": Metric("Comfort", "subjective", "1-7"),
}
FAMILIES = {"OAHG": "bc", "UPHG": "def", "CombHG": "ghi", "types": "acfi"}
BEYOND = "beyond"  # the type of every condition that is not the paper's, and the family in which it meets the types


def conditions_of(trials: pd.DataFrame) -> dict[str, Condition]:
    """The conditions in the trials by name: the paper's in its order, then any others, lettered from j on."""
    present = list(dict.fromkeys(trials["condition"]))
    own = [name for name in present if name not in CONDITIONS]
    letters = ascii_lowercase[len(CONDITIONS) :]
    if len(own) > len(letters):
        raise ValueError(f"{len(own)} conditions that are not the paper's, must be at most {len(letters)}")
    return {name: condition for name, condition in CONDITIONS.items() if name in present} | {
        name: Condition(letter, name, BEYOND) for name, letter in zip(own, letters, strict=False)
    }


TESTS_DTYPES = (
    dict.fromkeys(["family", "metric", "kind", "test", "x", "y"], "str")
    | {"n": "int64"}
    | dict.fromkeys(["statistic", "df1", "df2", "epsilon", "p", "p_corrected", "eta_squared", "dz"], "float64")
    | dict.fromkeys(["rank_statistic", "rank_p", "rank_p_corrected"], "float64")
    | dict.fromkeys(["mean_difference", "ci_low", "ci_high"], "float64")
    | {"greater": "str", "anova_not_significant": "bool", "significant": "bool", "proxy": "bool"}
)


def run_tests(trials: pd.DataFrame, people: bool = False) -> pd.DataFrame:
    """Run every test of section 5 that the conditions present allow.

    Args:
        trials: one row per participant and condition, with the columns `user`, `condition` and the eight `METRICS`;
            an undefined value is NaN and excludes that participant from the family's test of that metric. NHG has no
            disagreement, so the types are compared on it without NHG (section 5.2). Conditions that are not the
            paper's meet the types of guidance in a family of their own, `beyond`.
        people: they are of people, whose ratings are no proxies, and some of whom may not have finished: these are
            excluded as if what they have not played were NaN.

    Returns:
        One row per test, empty with fewer than three participants; families with an absent condition are skipped.
        `test` is paired_t, rm_anova or posthoc; `x`, `y` the letters of a pair and `greater` the one with the larger
        mean; `n` the participants; `statistic` t or F with `df1`, `df2` (uncorrected, as the paper reports them);
        `rank_statistic`, `rank_p`, `rank_p_corrected` the same by ranks, which ratings on a scale of seven would ask
        for and the paper does not report: Friedman's chi squared, or Wilcoxon's W with the same Bonferroni correction;
        `epsilon` Greenhouse-Geisser; `p` uncorrected; `p_corrected` by Greenhouse-Geisser (ANOVA) or Bonferroni (post
        hoc), else `p`; `eta_squared` partial; `dz` = mean / SD of the differences x - y; `mean_difference` x - y in
        the metric's unit with its 95 % interval `ci_low`, `ci_high`; `anova_not_significant` a post hoc test whose ANOVA was not
        significant, which the paper does not run; `significant` p_corrected < .05 and not anova_not_significant; `proxy` a rating
        that is a proxy. Where the differences do not vary, the statistic and the p are NaN.

    Raises:
        ValueError: trials that `check_trials` refuses.
    """
    check_trials(trials, people)
    rows: list[dict[str, Any]] = []
    conditions = conditions_of(trials)
    own = "".join(condition.letter for condition in conditions.values() if condition.guidance == BEYOND)
    families = FAMILIES | ({BEYOND: FAMILIES["types"] + own} if own else {})
    if trials["user"].nunique() >= FEWEST_PARTICIPANTS:
        tidy = trials.assign(condition=[conditions[name].letter for name in trials["condition"]])
        for (family, letters), metric in product(families.items(), METRICS):
            levels = [letter for letter in letters if (letter, metric) != ("a", "mean_disagreement")]
            if set(levels) <= set(tidy["condition"]):
                scores = tidy.pivot(index="user", columns="condition", values=metric)[levels].astype(float).dropna()
                kind = METRICS[metric].kind
                shared = {
                    "family": family,
                    "metric": metric,
                    "kind": kind,
                    "proxy": kind == "subjective" and not people,
                }
                rows += [shared | row for row in _compare(scores)]
    tests = pd.DataFrame(rows, columns=list(TESTS_DTYPES))
    return tests.fillna({"x": "", "y": "", "greater": ""}).astype(TESTS_DTYPES)


def check_trials(trials: pd.DataFrame, people: bool = False) -> None:
    """Refuse trials that cannot be compared within participants.

    Args:
        people: they are of people, who play one condition after the other: all need not have played the same.

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
    if named := ", ".join(f"{user} {condition}" for user, condition in games[games > 1].index):
        raise ValueError(f"more than one game of a participant in a condition: {named}")
    named = "; ".join(f"{user} lacks {', '.join(names)}" for user, names in missing_games(trials).items())
    if named and not people:
        raise ValueError(f"every participant must have played every condition: {named}")


def missing_games(trials: pd.DataFrame) -> dict[str, list[str]]:
    """Whoever has not played all conditions that are in the trials, and which ones."""
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
    anova_not_significant = not anova["p_corrected"] < ALPHA  # a NaN gates too
    posthoc = [_paired_t(scores, *pair) for pair in pairs]
    return [anova | _verdict("rm_anova", anova["p_corrected"], anova_not_significant=False)] + [
        row
        | _verdict("posthoc", _bonferroni(row["p"], len(pairs)), anova_not_significant)
        | {"rank_p_corrected": _bonferroni(row.get("rank_p", np.nan), len(pairs))}
        for row in posthoc
    ]


def _bonferroni(p: float, tests: int) -> float:
    return min(1.0, tests * p) if p >= 0 else np.nan


def _verdict(test: str, p_corrected: float, anova_not_significant: bool) -> dict[str, Any]:
    significant = bool(p_corrected < ALPHA and not anova_not_significant)
    return {
        "test": test,
        "p_corrected": p_corrected,
        "anova_not_significant": anova_not_significant,
        "significant": significant,
    }


def _constant(values: np.ndarray, scale: float) -> bool:
    """Whether values (any shape) differ by rounding only, as differences of equal or shifted columns do."""
    return bool(np.ptp(values) <= ROUNDING * scale)


def _rm_anova(scores: pd.DataFrame) -> dict[str, Any]:
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
    friedman = stats.friedmanchisquare(*values.T)
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
    wilcoxon = stats.wilcoxon(difference)
    return row | {
        "statistic": t.statistic,
        "p": t.pvalue,
        "dz": dz,
        "ci_low": low,
        "ci_high": high,
        "rank_statistic": wilcoxon.statistic,
        "rank_p": wilcoxon.pvalue,
        "rank_p_corrected": wilcoxon.pvalue,
    }
