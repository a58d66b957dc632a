"""Replicated studies: their tables, resumed runs and runs on a Ray cluster."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats as scipy_stats

from airhockey_marl.experiment.command import run as start_command
from guidance.commands import replicate
from guidance.statistics.figures import robustness_map
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
from guidance.statistics.tests import run_tests
from tests.guidance.statistics.test_report import synthetic_trials
from tests.processes import smoke, start

RESULTS = ("outcomes.csv", "studies.csv", "robustness.csv", "effects.csv", "factors.csv")


@pytest.fixture(scope="module")
def outcomes():
    studies = [outcomes_of(synthetic_trials(seed), ["comfort"]) for seed in range(6)]
    return pd.concat([o.assign(group="g", study=k) for k, o in enumerate(studies)], ignore_index=True)


def test_shares_count_studies(outcomes):
    findings = findings_over(outcomes)
    assert len(findings) == 38 and (findings["studies"] == 6).all()
    for row in findings.itertuples():
        mine = outcomes[outcomes["id"] == row.id]
        assert row.replicated == mine["outcome"].eq("replicated").mean()
        assert row.median == pytest.approx(mine["dz_toward_paper"].median())
        assert (row.metric == "comfort") == (row.withdrawn == 1)
    assert findings["replicated"].max() > 0
    assert len(false_positives_over(outcomes)) == 63


def test_a_positive_effect_is_one_in_the_papers_direction(outcomes):
    findings = outcomes[(outcomes["id"] != "") & outcomes["significant"]]
    toward = findings["greater"] == findings["paper_greater"]
    assert ((findings["dz_toward_paper"] > 0) == toward).all() and toward.any()


def test_scores_add_up(outcomes):
    trials = synthetic_trials(0)
    scores = scores_of(trials, outcomes_of(trials, ["comfort"]))
    assert scores["replicated"] == sum(scores[f"replicated_{e}"] for e in ("M", "P", "S", "S0"))
    assert scores["win_rate_nhg"] == trials.loc[trials["condition"] == "nhg", "win_rate"].mean()


def test_what_ua_changes_is_the_effect_of_e_over_d(outcomes):
    found = adaptation_effects(outcomes).set_index("metric")
    pair = outcomes[(outcomes["x"] == "d") & (outcomes["y"] == "e") & (outcomes["metric"] == "win_rate")]
    assert found.loc["win_rate", "mean"] == pytest.approx(-pair["dz"].mean())
    low, high = found.loc["win_rate", ["low", "high"]]
    interval = scipy_stats.t.interval(0.95, len(pair) - 1, -pair["dz"].mean(), pair["dz"].sem())
    assert (low, high) == pytest.approx(interval)


def test_effects_are_paired_differences_from_no_guidance():
    trials = synthetic_trials(3)
    effects = effects_of(trials).set_index(["condition", "metric"])
    scores = trials.pivot(index="user", columns="condition", values="win_rate")
    gain = scores["oahg"] - scores["nhg"]
    row = effects.loc["oahg", "win_rate"]
    assert row["mean"] == pytest.approx(scores["oahg"].mean())
    assert row["difference"] == pytest.approx(gain.mean()) and row["dz"] == pytest.approx(gain.mean() / gain.std())
    assert np.isnan(effects.loc["oahg", "mean_disagreement"]["difference"])  # NHG has none
    studies = [effects_of(synthetic_trials(seed)).assign(group="g", study=seed) for seed in range(6)]
    over = effects_over(pd.concat(studies)).set_index(["condition", "metric"])
    gains = [study.set_index(["condition", "metric"]).loc["oahg", "win_rate"]["difference"] for study in studies]
    row = over.loc["oahg", "win_rate"]
    assert row["studies"] == 6 and row["difference"] == pytest.approx(np.mean(gains))
    assert row["positive"] == np.mean(np.array(gains) > 0)


def test_shuffled_conditions_leave_false_positives_only():
    """Every person keeps their games; over many studies comparisons are significant about as often as by chance."""
    shares, trials = [], synthetic_trials(0)
    for seed in range(8):
        shuffled = shuffle_conditions(trials, seed)
        for metric in ("win_rate", "mean_disagreement"):
            for user, rows in shuffled.groupby("user"):
                before = trials.loc[trials["user"] == user, metric]
                assert sorted(rows[metric].dropna()) == sorted(before.dropna())
        assert shuffled.loc[shuffled["condition"] == "nhg", "mean_disagreement"].isna().all()
        tests = run_tests(shuffled)
        shares.append(tests.loc[tests["test"] == "posthoc", "significant"].mean())
    assert np.mean(shares) < 0.1 and run_tests(trials)["significant"].mean() > 0.2


def test_the_assumption_that_matters_is_found(outcomes):
    rng = np.random.default_rng(0)
    studies = pd.concat([outcomes[outcomes["study"] == 0].assign(study=k) for k in range(40)], ignore_index=True)
    factors = pd.DataFrame(rng.random((40, 5)), columns=list("abcde"))
    studies["dz_toward_paper"] = studies["study"].map(factors["c"]) + 0.05 * rng.standard_normal(len(studies))
    found = influential_assumptions(studies, factors, strongest=1)
    assert len(found) == 38 and (found["parameter"] == "c").all() and (found["correlation"] > 0.9).all()
    assert (found["p"] < 0.001).all()


def test_the_map_has_a_cell_per_finding_and_group(outcomes):
    both = pd.concat([outcomes, outcomes.assign(group="h")])
    cells, effects = robustness_map(findings_over(both), {group: group for group in set(both["group"])}).axes
    assert cells.images[0].get_array().shape == (38, 2)
    assert len(effects.lines[1].get_xdata()) == 38


FEW = ["guidance", "replicate", "study.rounds=1", "sensitivity.variants=[goal_sharing]"]


def test_a_killed_run_ends_like_one_never_killed(tmp_path):
    """Batches that are there are kept, missing ones are played again."""
    smoke(*FEW, f"hydra.run.dir={tmp_path}/whole")
    batches = sorted(path.name for path in (tmp_path / "whole" / "batches").iterdir())
    groups = {"goal_sharing": (3, 5), "alike": (0,), "replicates": (0, 2), "swapped": (0,), "unlearned": (0,)}
    assert batches == sorted(f"{group}-{first:04d}.csv" for group, firsts in groups.items() for first in firsts)
    expected = {name: (tmp_path / "whole" / name).read_bytes() for name in (*RESULTS, "robustness.svg")}
    for name in (*RESULTS, "batches/goal_sharing-0003.csv", "batches/replicates-0002.csv", "replicate.html"):
        (tmp_path / "whole" / name).unlink()
    done = start("guidance", "replicate", f"resume={tmp_path}/whole", f"hydra.run.dir={tmp_path}/again")
    assert done.returncode == 0, done.stderr
    assert expected == {name: (tmp_path / "whole" / name).read_bytes() for name in expected}
    page = (tmp_path / "whole" / "replicate.html").read_text(encoding="utf-8")
    assert "not replicates of the frozen study" in page and "other assumptions, goal_sharing" in page
    assert "conditions shuffled within people" in page and "What each guidance changes" in page


@pytest.mark.slow
def test_results_do_not_depend_on_the_size_of_batches(tmp_path):
    for together in (2, 7):
        smoke(*FEW, f"together={together}", f"hydra.run.dir={tmp_path}/{together}")
    for name in ("outcomes.csv", "studies.csv"):
        assert (tmp_path / "2" / name).read_bytes() == (tmp_path / "7" / name).read_bytes()


def test_a_ray_cluster_gives_the_same_bits(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # or Ray writes a token into the home folder
    few = ["sensitivity.points=0", "together=2"]
    for name, more in (("here", []), ("there", ["ray=local"])):
        smoke("guidance", "replicate", *few, *more, f"hydra.run.dir={tmp_path}/{name}")
    written = [file.relative_to(tmp_path / "here") for file in (tmp_path / "here").glob("**/*.csv")]
    assert len(written) == 4 + len(RESULTS)
    for file in written:
        assert (tmp_path / "here" / file).read_bytes() == (tmp_path / "there" / file).read_bytes(), file


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("participants=2", "participants = 2 must be a whole number of at least 3"),
        ("sensitivity.largest=1", "sensitivity.largest = 1 must be a finite number above 1"),
        ("sensitivity.variants=[V7]", "users.variant = 'V7' must be one of passive, comply_or_resist, goal_sharing"),
        ("sensitivity.parameters=[courage]", "courage is not a parameter of people"),
        ("n=0 sensitivity.points=0", "n = 0 must be at least 1 where sensitivity.points is 0"),
        ("compute=tpu", "compute = tpu must be one of cpu, cuda"),
        ("ray=3", "ray = 3 must be null, local, auto or the address of a cluster"),
        ("resume=nowhere", "resume = nowhere is not the folder of a run that can go on"),
    ],
)
def test_wrong_settings_end_in_one_line_before_any_work(monkeypatch, capsys, tmp_path, argument, message):
    monkeypatch.setattr("guidance.study.replication.run_studies", None)
    monkeypatch.setattr("sys.argv", ["replicate", f"hydra.run.dir={tmp_path}/run", *argument.split()])
    with pytest.raises(SystemExit) as stopped:
        start_command(replicate.__name__)
    shown = capsys.readouterr().err
    assert stopped.value.code == 2 and shown.count("\n") == 1 and message in shown
