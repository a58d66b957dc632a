"""The statistics against other people's numbers, against identities, and against data in which there is nothing."""

import warnings
from itertools import product

import numpy as np
import pandas as pd
import pingouin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats as scipy_stats

from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.paper import compare_with_paper, count_findings, published_results, reference_points
from guidance.statistics.tests import order_effects, run_tests, signed_rank_test

LETTER = {name: condition.letter for name, condition in CONDITIONS.items()}


def synthetic_trials(seed: int = 0, users: int = 20, effect: float = 0.0, conditions=tuple(CONDITIONS)):
    """Participants with a level of their own, conditions that differ by `effect` SD per letter on every metric."""
    rng = np.random.default_rng(seed)
    level = rng.normal(size=(users, len(METRICS)))
    rows = []
    for user in range(users):
        for condition in conditions:
            step = effect * "abcdefghi".index(LETTER[condition])
            scores = 4 + level[user] + rng.normal(size=len(METRICS)) + step
            rows.append({"user": f"S{user + 1:02d}", "condition": condition} | dict(zip(METRICS, scores, strict=True)))
    trials = pd.DataFrame(rows)
    trials.loc[trials["condition"] == "nhg", "mean_disagreement"] = np.nan
    return trials


def trials_of(columns: dict[str, list[float]], metric: str = "win_rate") -> pd.DataFrame:
    """Trials whose `metric` is given per condition; the other metrics are undefined."""
    wide = pd.DataFrame(columns, index=[f"S{i:02d}" for i in range(len(next(iter(columns.values()))))], dtype=float)
    tidy = wide.rename_axis("user").reset_index().melt("user", var_name="condition", value_name=metric)
    return tidy.assign(**{name: np.nan for name in METRICS if name != metric})


def one(tests: pd.DataFrame, **values) -> pd.Series:
    chosen = tests[np.logical_and.reduce([tests[column] == value for column, value in values.items()])]
    assert len(chosen) == 1
    return chosen.iloc[0]


def test_anova_agrees_with_spss():
    """SPSS's printed output for five subjects under three conditions.

    UCLA Statistical Consulting, "SPSS Code Fragment: Repeated measures ANOVA in SPSS", example 1
    (ats.ucla.edu/stat/spss/code/rep_anova_sig.htm): SS 928.533 and 786.133, F(2, 8) = 4.725, p = .044,
    Greenhouse-Geisser df 1.269 and 5.075, p = .077.
    """
    columns = {
        "uphg": [100, 90, 110, 100, 100],
        "uphg_ua": [90, 100, 110, 90, 100],
        "uphg_ut_ua": [130, 100, 109, 109, 130],
    }
    anova = one(run_tests(trials_of(columns)), metric="win_rate", test="rm_anova")
    assert (anova["n"], anova["df1"], anova["df2"]) == (5, 2, 8)
    assert anova["statistic"] == pytest.approx(4.725, abs=5e-4)
    assert anova["p"] == pytest.approx(0.044, abs=5e-4)
    assert anova["epsilon"] == pytest.approx(1.269 / 2, abs=5e-4)
    assert anova["p_corrected"] == pytest.approx(0.077, abs=5e-4)
    assert anova["eta_squared"] == pytest.approx(928.533 / (928.533 + 786.133), abs=1e-5)
    assert not anova["significant"]


def test_anova_of_four_levels_drops_incomplete_participants():
    """pingouin's documented example: twelve participants, nine complete, F(3, 24) = 5.200652, eps .694329."""
    wide = pingouin.read_dataset("rm_anova_wide")
    columns = dict(zip(["nhg", "oahg_ut", "uphg_ut_ua", "combhg_ut_ua_sc"], wide.to_numpy(float).T, strict=True))
    trials = trials_of(columns).dropna(subset="win_rate")
    every = pd.MultiIndex.from_product([trials["user"].unique(), columns], names=["user", "condition"])
    trials = trials.set_index(["user", "condition"]).reindex(every).reset_index()
    anova = one(run_tests(trials), family="types", metric="win_rate", test="rm_anova")
    assert trials["user"].nunique() == 12
    assert anova["n"] == 9
    assert (anova["df1"], anova["df2"]) == (3, 24)
    assert anova["statistic"] == pytest.approx(5.200652, abs=1e-6)
    assert anova["p"] == pytest.approx(0.006557, abs=1e-6)
    assert anova["epsilon"] == pytest.approx(0.694329, abs=1e-6)


def test_paired_t_agrees_with_student():
    """Student (1908), The probable error of a mean, Biometrika 6: two soporifics, t(9) = 4.06, p = .0028."""
    columns = {
        "oahg": [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
        "oahg_ut": [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
    }
    row = one(run_tests(trials_of(columns)), metric="win_rate", test="paired_t")
    assert row["statistic"] == pytest.approx(4.0621, abs=5e-5)
    assert row["p"] == row["p_corrected"] == pytest.approx(0.002833, abs=5e-7)
    assert (row["ci_low"], row["ci_high"]) == pytest.approx((0.7001, 2.4599), abs=5e-5)
    assert (row["mean_difference"], row["greater"]) == (pytest.approx(1.58), "b")
    assert row["significant"]


def test_paper_reports_partial_eta_squared():
    """Every F of section 5 gives its eta squared as F df1 / (F df1 + df2): the effect size is the partial one."""
    paper = published_results("anova")
    partial = paper["f"] * paper["df1"] / (paper["f"] * paper["df1"] + paper["df2"])
    assert len(paper) == 20
    assert (partial - paper["eta_squared"]).abs().max() < 0.0015


def test_our_eta_squared_is_the_papers():
    anova = run_tests(synthetic_trials(effect=0.2)).query("test == 'rm_anova'")
    effect = anova["statistic"] * anova["df1"]
    assert len(anova) == 24
    np.testing.assert_allclose(anova["eta_squared"], effect / (effect + anova["df2"]))


def test_which_pairs_are_tested():
    """The pairs and their number are the paper's 101; NHG has no disagreement."""
    tests = run_tests(synthetic_trials())
    pairs = tests[tests["test"] != "rm_anova"]
    key = ["family", "metric", "kind", "x", "y"]
    paper = published_results("grid")
    assert set(pairs[key].itertuples(index=False, name=None)) == set(paper[key].itertuples(index=False, name=None))
    assert len(pairs) == len(paper) == 101
    assert one(tests, family="types", metric="mean_disagreement", test="rm_anova")["df2"] == 38
    assert (tests["proxy"] == (tests["kind"] == "subjective")).all()


def test_ranks_agree_with_conover():
    """Friedman's chi squared: Conover 1999, example 5.8.1, twelve homeowners who rank four grasses: T1 = 8.097."""
    ranks = [
        *([4, 3, 2, 1], [4, 2, 3, 1], [3, 1.5, 1.5, 4], [3, 1, 2, 4], [4, 2, 1, 3], [2, 2, 2, 4]),
        *([1, 3, 2, 4], [2, 4, 1, 3], [3.5, 1, 2, 3.5], [4, 1, 3, 2], [4, 2, 3, 1], [3.5, 1, 2, 3.5]),
    ]
    trials = synthetic_trials(users=12).set_index(["user", "condition"]).sort_index()
    users = trials.index.get_level_values("user").unique()
    for user, row in zip(users, ranks, strict=True):
        for condition, rank in zip(("nhg", "oahg_ut", "uphg_ut_ua", "combhg_ut_ua_sc"), row, strict=True):
            trials.loc[(user, condition), "comfort"] = rank
    tests = run_tests(trials.reset_index())
    anova = tests.query("family == 'types' and metric == 'comfort' and test == 'rm_anova'").iloc[0]
    assert anova["rank_statistic"] == pytest.approx(8.097, abs=5e-4)
    assert anova["rank_p"] == pytest.approx(0.044, abs=5e-4)
    pair = tests.query("family == 'types' and metric == 'comfort' and x == 'a' and y == 'c'").iloc[0]
    difference = np.array(ranks)[:, 0] - np.array(ranks)[:, 1]
    assert pair["rank_p"] == pytest.approx(scipy_stats.wilcoxon(difference).pvalue)
    assert pair["rank_p_corrected"] == pytest.approx(min(1, 6 * pair["rank_p"]))


def test_other_conditions_meet_the_types_and_leave_the_paper_alone():
    nine = synthetic_trials(effect=0.2)
    mine = nine[nine["condition"] == "oahg_ut"].assign(condition="mine", win_rate=lambda t: 2 * t["win_rate"] + 5)
    tests, before = run_tests(pd.concat([nine, mine])), run_tests(nine)
    assert tests[tests["family"] != "beyond"].reset_index(drop=True).equals(before)
    beyond = tests[(tests["family"] == "beyond") & (tests["metric"] == "win_rate")]
    assert len(beyond) == 1 + 10 and set(beyond["y"]) == {"", "c", "f", "i", "j"}
    assert beyond.loc[beyond["y"] == "j", "significant"].all()
    assert compare_with_paper(tests).equals(compare_with_paper(before))


def test_dz_t_and_interval_identities():
    pairs = run_tests(synthetic_trials(effect=0.1)).query("test != 'rm_anova'")
    n = pairs["n"]
    np.testing.assert_allclose(pairs["statistic"], pairs["dz"] * np.sqrt(n))
    half = scipy_stats.t.isf(0.025, n - 1) * pairs["mean_difference"] / pairs["statistic"]
    np.testing.assert_allclose(pairs["ci_low"], pairs["mean_difference"] - half)
    np.testing.assert_allclose(pairs["ci_high"], pairs["mean_difference"] + half)
    assert (pairs["greater"] == np.where(pairs["mean_difference"] > 0, pairs["x"], pairs["y"])).all()


def test_bonferroni_and_gate():
    tests = run_tests(synthetic_trials(effect=0.12))
    posthoc = tests[tests["test"] == "posthoc"]
    m = posthoc.groupby(["family", "metric"])["p"].transform("size")
    assert set(m) == {3, 6}
    np.testing.assert_allclose(posthoc["p_corrected"], np.minimum(1, m * posthoc["p"]))
    anova = tests[tests["test"] == "rm_anova"].set_index(["family", "metric"])["p_corrected"]
    opened = anova.loc[pd.MultiIndex.from_frame(posthoc[["family", "metric"]])].to_numpy() < 0.05
    assert 0 < opened.sum() < len(opened)  # both kinds occur
    assert (posthoc["anova_not_significant"] == ~opened).all()
    assert (posthoc["significant"] == (opened & (posthoc["p_corrected"] < 0.05))).all()
    assert (posthoc["anova_not_significant"] & (posthoc["p_corrected"] < 0.05)).any()  # a gate that matters


def test_missing_value_is_listwise_within_family_and_metric():
    trials = synthetic_trials()
    trials.loc[(trials["user"] == "S03") & (trials["condition"] == "uphg"), "defense_rate"] = np.nan
    n = run_tests(trials).groupby(["family", "metric"])["n"].agg(["min", "max"])
    assert tuple(n.loc[("UPHG", "defense_rate")]) == (19, 19)
    assert (n.drop(("UPHG", "defense_rate")) == 20).all(axis=None)


def test_missing_games_are_refused():
    trials = synthetic_trials(users=5)
    hole = (trials["user"] == "S02") & (trials["condition"].isin(["uphg", "nhg"]))
    with pytest.raises(ValueError, match=r"S02 lacks nhg, uphg$"):
        run_tests(trials[~hole])


def test_repeated_games_are_refused():
    trials = synthetic_trials(users=5)
    with pytest.raises(ValueError, match=r"condition: S01 nhg, S01 oahg$"):
        run_tests(pd.concat([trials, trials.iloc[:2]]))


@given(st.lists(st.integers(-3, 3), min_size=1, max_size=9).filter(any))
def test_signed_ranks_with_ties_agree_with_all_signs(difference):
    difference = np.array(difference, dtype=float)
    ranks = scipy_stats.rankdata(np.abs(difference[difference != 0]))
    signs = np.array(list(product((0, 1), repeat=len(ranks))))
    w, p = signed_rank_test(difference)
    assert w == min(ranks[difference[difference != 0] > 0].sum(), ranks[difference[difference != 0] < 0].sum())
    assert p == pytest.approx(min(1, 2 * np.mean(signs @ ranks <= w)), abs=1e-12)


@pytest.mark.parametrize("n", [3, 13, 20, 50, 51, 200])
def test_signed_ranks_without_ties_agree_with_scipy(n):
    difference = np.random.default_rng(n).normal(0.3, 1, size=n)
    assert signed_rank_test(difference) == pytest.approx(tuple(scipy_stats.wilcoxon(difference)), abs=1e-12)


def test_thirteen_people_need_no_enumeration_of_signs(monkeypatch):
    """Which scipy's test does for up to 13 differences with ties: 8,192 for each of about 300 pairs, in minutes."""
    monkeypatch.setattr(scipy_stats, "permutation_test", None)
    trials = synthetic_trials(users=13)
    tests = run_tests(trials.assign(comfort=trials["comfort"].round().clip(1, 7)))
    assert tests.loc[tests["test"] == "posthoc", "rank_p"].notna().all()


@pytest.mark.parametrize(
    ("column", "value", "message"), [("condition", "magic", "magic"), ("comfort", np.inf, "infinite")]
)
def test_wrong_values_are_refused(column, value, message):
    trials = synthetic_trials(users=4)
    trials.loc[trials.index[0], column] = value
    with pytest.raises(ValueError, match=message):
        run_tests(trials)


def test_absent_conditions_skip_their_families():
    tests = run_tests(synthetic_trials(conditions=("nhg", "oahg", "oahg_ut")))
    assert set(tests["family"]) == {"OAHG"}
    assert run_tests(synthetic_trials(conditions=("nhg",))).empty


def test_too_few_participants_give_an_empty_table():
    tests = run_tests(synthetic_trials(users=2))
    assert tests.empty
    assert list(tests.columns) == list(run_tests(synthetic_trials(users=3)).columns)
    assert compare_with_paper(tests)["outcome"].eq("not_tested").all()


@pytest.mark.parametrize("shift", [0.0, 0.1])
def test_differences_that_do_not_vary(shift):
    """The same game in every condition, or one that differs by a constant: no statistic and no warning."""
    trials = synthetic_trials(conditions=("nhg",), users=6).drop(columns="condition").fillna(1.0)
    letters = enumerate(CONDITIONS)
    same = pd.concat(
        trials.set_index("user").add(shift * i).reset_index().assign(condition=name) for i, name in letters
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        tests = run_tests(same)
    assert len(tests) == 125
    assert tests[["statistic", "p", "p_corrected", "dz"]].isna().all(axis=None)
    assert not tests["significant"].any()
    assert (tests.loc[tests["test"] != "rm_anova", "greater"] != "").all() == (shift > 0)


def test_two_identical_conditions_of_three():
    trials = synthetic_trials(effect=1.0, conditions=("uphg", "uphg_ua", "uphg_ut_ua"))
    trials.loc[trials["condition"] == "uphg_ua", list(METRICS)] = trials.loc[
        trials["condition"] == "uphg", list(METRICS)
    ].to_numpy()
    tests = run_tests(trials)
    same = tests[(tests["x"] == "d") & (tests["y"] == "e")]
    assert same["statistic"].isna().all() and not same["significant"].any() and not same["anova_not_significant"].any()
    assert tests.loc[tests["test"] == "rm_anova", "significant"].all()


def test_shuffled_labels_give_nominal_false_positives():
    """Strong effects whose condition labels are shuffled within each participant are nothing: 5 %, no more."""
    trials = synthetic_trials(effect=0.3).fillna(4.0)
    rng = np.random.default_rng(7)
    p_pairs, p_anova, significant = [], [], []
    for _ in range(10):
        shuffled = trials.assign(condition=trials.groupby("user")["condition"].transform(rng.permutation))
        tests = run_tests(shuffled)
        p_pairs += tests.loc[tests["test"] != "rm_anova", "p"].tolist()
        p_anova += tests.loc[tests["test"] == "rm_anova", "p_corrected"].tolist()
        significant += tests.loc[tests["test"] == "posthoc", "significant"].tolist()
    assert 0.025 < np.mean(np.array(p_pairs) < 0.05) < 0.08
    assert 0.02 < np.mean(np.array(p_anova) < 0.05) < 0.09
    assert np.mean(significant) < 0.03


def paper_trials(strength: float = 3.0, users: int = 20) -> pd.DataFrame:
    """Trials in which a finding of the paper holds where a simple ranking of the conditions can produce it."""
    rng = np.random.default_rng(3)
    better, worse = "win_rate", "mean_disagreement"
    trials = synthetic_trials(seed=4, users=users)
    rank = {"a": 0, "b": 2, "c": 2, "d": 1, "e": 2, "f": 3, "g": 3, "h": 3, "i": 3}
    order = trials["condition"].map(LETTER).map(rank)
    noise = rng.normal(size=(len(trials), 2))
    trials[better] = strength * order + noise[:, 0]
    trials.loc[trials["condition"] != "nhg", worse] = -strength * order + noise[:, 1]
    return trials


def test_comparison_with_the_paper():
    comparison = compare_with_paper(run_tests(paper_trials()))
    assert len(comparison) == 101
    assert comparison["id"].tolist()[:38] == [f"C{i:02d}" for i in range(1, 39)]
    outcome = comparison.set_index(["family", "metric", "x", "y"])["outcome"]
    assert outcome["UPHG", "win_rate", "d", "f"] == "replicated"
    assert outcome["types", "win_rate", "a", "c"] == "replicated"
    assert outcome["UPHG", "win_rate", "d", "e"] == "false_positives"
    assert outcome["UPHG", "mean_disagreement", "d", "f"] == "replicated"
    assert outcome["OAHG", "mean_disagreement", "b", "c"] == "not_significant"
    assert outcome["CombHG", "win_rate", "g", "h"] == "agrees"

    reversed_trials = paper_trials(strength=-3.0)
    against = compare_with_paper(run_tests(reversed_trials)).set_index(["family", "metric", "x", "y"])
    assert against.loc[("UPHG", "win_rate", "d", "f"), "outcome"] == "reversed"
    assert against.loc[("UPHG", "win_rate", "d", "f"), "greater"] == "d"


def test_comparison_without_some_conditions():
    comparison = compare_with_paper(run_tests(paper_trials().query("condition.str.contains('uphg')")))
    assert (comparison["outcome"].eq("not_tested") == comparison["family"].ne("UPHG")).all()


def test_summary_counts_every_cell_once():
    comparison = compare_with_paper(run_tests(paper_trials()))
    counts = count_findings(comparison)
    assert counts["cells"].to_dict() == {"M": 8, "P": 9, "S": 18, "S0": 3, "all": 38, "none": 63}
    classes = counts.loc[["M", "P", "S", "S0"]]
    assert (classes.sum() == counts.loc["all"]).all()
    assert counts.loc["all", "replicated"] == (comparison["outcome"] == "replicated").sum() > 4
    assert counts.loc["none", "false_positives"] == (comparison["outcome"] == "false_positives").sum() > 0
    assert counts.loc["none", ["replicated", "reversed"]].sum() == 0


def test_reference_points():
    """By hand: 1 test alone, 20 findings among 3 comparisons and 17 among 6, each with half of .05 / m."""
    by_chance, rerun = reference_points()
    assert by_chance == pytest.approx(0.025 * (1 + 20 / 3 + 17 / 6))
    assert rerun == pytest.approx(31, abs=0.5)
    assert reference_points(n=200)[1] == pytest.approx(38, abs=0.01)


def with_positions(trials: pd.DataFrame, slope: float, seed: int = 0) -> pd.DataFrame:
    """Trials in a random order of each participant, which changes every metric by `slope` per position."""
    rng = np.random.default_rng(seed)
    order = np.concatenate([rng.permutation(len(games)) + 1 for _, games in trials.groupby("user")])
    trials = trials.sort_values("user", kind="stable").assign(position=order)
    return trials.assign(**{metric: trials[metric] + slope * order for metric in METRICS})


def test_an_order_effect_is_found_beside_those_of_participants_and_conditions():
    for slope in (0.0, 0.5):
        rows = order_effects(with_positions(synthetic_trials(effect=2.0), slope))
        assert [row["metric"] for row in rows] == [name for name, m in METRICS.items() if m.kind == "objective"]
        for row in rows:
            assert row["ci_low"] < slope < row["ci_high"] and row["ci_high"] - row["ci_low"] < 0.2
            assert (row["p"] < 0.001) == (slope > 0) and row["n"] == (
                160 if row["metric"] == "mean_disagreement" else 180
            )


def test_order_effects_have_nominal_intervals():
    rows = [row for seed in range(40) for row in order_effects(with_positions(synthetic_trials(seed), 0.3, seed))]
    assert np.mean([row["ci_low"] < 0.3 < row["ci_high"] for row in rows]) == pytest.approx(0.95, abs=0.04)
    assert np.mean([row["p"] < 0.05 for row in rows]) > 0.95


def test_order_effects_agree_with_a_regression_on_dummies():
    trials = with_positions(synthetic_trials(users=5), 0.1)
    dummies = pd.get_dummies(trials[["user", "condition"]], dtype=float)
    dummies = dummies.drop(columns=["user_S01", "condition_nhg"]).assign(position=trials["position"])
    fit = pingouin.linear_regression(dummies, trials["win_rate"]).set_index("names").loc["position"]
    row = order_effects(trials)[0]
    assert (row["slope"], row["p"]) == pytest.approx((fit["coef"], fit["pval"]))


def test_positions_that_are_the_same_for_everybody_tell_nothing():
    trials = synthetic_trials()
    assert order_effects(trials) == []
    assert order_effects(trials.assign(position=np.tile(np.arange(1, 10), 20))) == []
    assert order_effects(with_positions(trials[trials["user"] == "S01"], 0.1)) == []
