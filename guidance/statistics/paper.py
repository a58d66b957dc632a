"""The paper's published results, and the comparison of a study with them."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd

from guidance.statistics.design import ALPHA

PAPER = Path(__file__).parent / "paper_tables"
EVIDENCE = {"M": "mechanical", "P": "performance", "S": "proxy", "S0": "proxy, nearly automatic"}
EVIDENCE_OF_PEOPLE = EVIDENCE | {"S": "rating", "S0": "rating, against no force"}


def published_results(table: str) -> pd.DataFrame:
    """One of the paper's tables: `findings`, `grid`, `anova` or `weights`; p stays as printed (".000", "<.001")."""
    return pd.read_csv(PAPER / f"{table}.csv", dtype={"p_reported": "str"})


def compare_with_paper(tests: pd.DataFrame, withdrawn: Collection[str] = ()) -> pd.DataFrame:
    """Compare a study with the 101 pairs of the paper: 38 significant findings (Tables 2 and 3) and 63 non-findings.

    Args:
        tests: see `guidance.statistics.tests.run_tests`.
        withdrawn: metrics that do not count, because they failed a check before the study.

    Returns:
        One row per pair of the paper, the findings first.
        The paper's side: `family`, `metric`, `kind`, `x`, `y`, `id` and `table` (of a finding), `evidence` (M, P, S,
        S0; "" for a non-finding), `paper` (significant | not_significant | anova_not_significant), `paper_greater`
        (letter), `p_paper` (as printed), `dz_paper` (the smallest |dz| that gives the printed p).
        Ours: `n`, `mean_difference` (x - y), `ci_low`, `ci_high`, `dz`, `p` (corrected), `rank_p` (Wilcoxon's,
        corrected), `anova_not_significant`, `significant`, `greater` (letter of the larger mean), and `outcome`. Of a
        finding this is replicated (significant with the same sign), reversed (significant with the opposite sign) or
        not_significant; of a non-finding false_positives or agrees; of both not_tested where no test could be
        computed, and withdrawn where the metric is.
    """
    findings = published_results("findings")[["id", "table", "evidence", "dz_min"]]
    findings = findings.rename(columns={"dz_min": "dz_paper"})
    paper = published_results("grid").merge(findings, on="id", how="left")
    paper = paper.rename(columns={"greater": "paper_greater", "p_reported": "p_paper"})
    status = {"sig": "significant", "ns": "not_significant", "ns_anova_gate": "anova_not_significant"}
    paper["paper"] = paper.pop("status").map(status)
    paper = paper.fillna({"id": "", "evidence": "", "paper_greater": "", "p_paper": ""})

    ours = tests.loc[tests["test"] != "rm_anova", ["family", "metric", "x", "y", "n", "mean_difference", "ci_low"]]
    ours = ours.join(
        tests[["ci_high", "dz", "p_corrected", "rank_p_corrected", "anova_not_significant", "significant", "greater"]]
    )
    both = paper.merge(
        ours.rename(columns={"p_corrected": "p", "rank_p_corrected": "rank_p"}),
        on=["family", "metric", "x", "y"],
        how="left",
    )
    flags = {name: both[name].eq(True) for name in ("anova_not_significant", "significant")}
    both = both.assign(**flags, greater=both["greater"].fillna(""))

    finding = both["paper"].eq("significant")
    same_sign = both["greater"].eq(both["paper_greater"])
    both["outcome"] = np.select(
        [
            both["metric"].isin(withdrawn),
            both["p"].isna(),
            finding & both["significant"] & same_sign,
            finding & both["significant"],
            finding,
            both["significant"],
        ],
        ["withdrawn", "not_tested", "replicated", "reversed", "not_significant", "false_positives"],
        "agrees",
    )
    return both.sort_values("id", key=lambda ids: ids.replace("", "~"), kind="stable", ignore_index=True)


def count_findings(comparison: pd.DataFrame) -> pd.DataFrame:
    """Count the outcomes of `compare_with_paper`.

    Returns:
        Indexed by evidence class: M, P, S, S0, `all` (the 38 findings) and `none` (the 63 non-findings); columns
        `cells`, `tested`, `replicated`, `reversed`, `false_positives` (counts).
    """
    finding = comparison["evidence"].ne("")
    groups = {evidence: comparison["evidence"].eq(evidence) for evidence in EVIDENCE}
    groups |= {"all": finding, "none": ~finding}
    tested = ~comparison["outcome"].isin(("not_tested", "withdrawn"))
    outcomes = ("replicated", "reversed", "false_positives")
    counts = {
        evidence: {"cells": int(chosen.sum()), "tested": int((chosen & tested).sum())}
        | {outcome: int((chosen & comparison["outcome"].eq(outcome)).sum()) for outcome in outcomes}
        for evidence, chosen in groups.items()
    }
    return pd.DataFrame.from_dict(counts, orient="index").rename_axis("evidence")


def reference_points(n: int = 20) -> tuple[float, float]:
    """Expected number of replicated findings, of 38: by chance, and in a re-run with the paper's own people.

    By chance, half of the false positives of a two-sided test at .05 / m have the paper's sign. For the re-run, every
    finding has the effect size dz that its printed p implies, and the power of a paired t-test with n participants.
    """
    from scipy import stats

    findings = published_results("findings")
    tail = ALPHA / 2 / findings["bonferroni_m"]
    power = stats.nct.sf(stats.t.isf(tail, n - 1), n - 1, findings["dz_min"] * np.sqrt(n))
    return float(tail.sum()), float(power.sum())
