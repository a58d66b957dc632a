"""The report on synthetic trials: what is written, what it says and refuses; the figure and the sentences in it."""

import base64
import html
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from scipy import stats as scipy_stats

from airhockey_marl.files import found_below
from guidance.answers import answers
from guidance.figures import COLOURS, confidence_half_width, figure6
from guidance.report import merge, screen_table, write_report
from guidance.stats import CONDITIONS, METRICS, compare_with_paper, published, run_tests, summary

WEIGHTS = {"w_unc_optimal": "ci", "w_unc_user": "fi", "w_sim": "hi"}
SUBJECTIVE = [metric.label for metric in METRICS.values() if metric.kind == "subjective"]


def synthetic_trials(seed: int = 1, users: int = 20) -> pd.DataFrame:
    """Plausible trials with every column: conditions later in the alphabet help more."""
    rng = np.random.default_rng(seed)
    rows = []
    for user in range(users):
        level = rng.normal(size=8)
        for place, (name, condition) in enumerate(CONDITIONS.items()):
            z = 0.15 * place + 0.7 * level + 0.8 * rng.normal(size=8)
            ratings = np.clip(np.round(4 + z[4:]), 1, 7)
            row = {"user": f"S{user + 1:02d}", "condition": name, "position": (place + user) % 9 + 1}
            row |= {"win_rate": np.clip(0.45 + 0.1 * z[0], 0, 1), "mean_smash_speed": 2 + 0.3 * z[1]}
            row |= {"defense_rate": np.clip(0.6 + 0.1 * z[2], 0, 1)}
            row |= {"mean_disagreement": np.nan if name == "nhg" else 2 - 0.3 * z[3]}
            row |= dict(zip(list(METRICS)[4:], ratings, strict=True)) | {"rounds": 8, "duration_s": 130.0}
            for weight, letters in WEIGHTS.items():
                used = condition.letter in letters
                row |= {f"{weight}_mean": rng.uniform() if used else np.nan, f"{weight}_sd": 0.3 if used else np.nan}
            rows.append(row | {"seed": seed})
    return pd.DataFrame(rows)


@pytest.fixture(scope="module")
def trials() -> pd.DataFrame:
    return synthetic_trials()


@pytest.fixture(scope="module")
def written(trials, tmp_path_factory):
    """A whole report: its folder, the tests it returned, its page."""
    folder = tmp_path_factory.mktemp("report")
    manifest = {
        "study_hash": "9f2c" * 16,
        "frozen": False,
        "models": {"optimal": "ab12" * 16},
        "config": {"users": {"n": 20}, "note": "<script>alert(1)</script>"},
    }
    tests = write_report(trials, folder, manifest)
    return folder, tests, (folder / "report.html").read_text(encoding="utf-8")


def text_of(page: str) -> str:
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<style>.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)))


def test_report_writes_its_four_files_whole(written, trials):
    folder, tests, _ = written
    assert sorted(path.name for path in folder.iterdir()) == ["figure6.png", "figure6.svg", "report.html", "tests.csv"]
    assert (folder / "figure6.png").read_bytes().startswith(b"\x89PNG")
    on_disk = pd.read_csv(folder / "tests.csv", keep_default_na=False, na_values={"p": [""], "statistic": [""]})
    assert list(on_disk.columns) == list(tests.columns)
    np.testing.assert_allclose(on_disk["statistic"], tests["statistic"])
    assert (on_disk["significant"] == run_tests(trials)["significant"]).all()


def test_report_is_reproducible(written, trials, tmp_path):
    folder, _, _ = written
    write_report(trials.sample(frac=1, random_state=0), tmp_path, {})
    for name in ("tests.csv", "figure6.svg"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


def test_page_loads_nothing_and_escapes(written):
    folder, _, page = written
    assert not re.search(r"<(script|link|iframe|object)\b|@import|url\(", page)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(sources) == 1
    assert base64.b64decode(sources[0].partition("base64,")[2]) == (folder / "figure6.svg").read_bytes()
    assert "&lt;script&gt;alert(1)" in page


def test_page_says_how_much_replicates(written):
    _, tests, page = written
    counts, text = summary(compare_with_paper(tests)), text_of(page)
    assert 0 < counts.loc["all", "replicated"] < 38
    assert f"{counts.loc['all', 'replicated']} of the paper’s 38 significant comparisons replicate." in text
    for evidence in ("M", "P", "S", "S0"):
        row = counts.loc[evidence]
        assert f"{row['replicated']} / {row['cells']} {evidence} ·" in text
    assert f"{counts.loc['none', 'wrongly_significant']} / 63 non-findings significant here" in text
    assert f"{counts.loc['all', 'reversed']} findings reversed" in text
    assert page.count("✓ replicated") == counts.loc["all", "replicated"]
    assert page.count("⇄ reversed") == counts.loc["all", "reversed"]


def test_every_rating_is_marked_as_proxy(written):
    _, tests, page = written
    marked = re.findall(rf"({'|'.join(SUBJECTIVE)})(\s*<span class=\"proxy\">PROXY)?", page)
    assert len(marked) >= 4 + 8 + 4 + 4 + 12  # means, Table 2, Table 3, paired t, ANOVA
    assert all(mark for _, mark in marked)
    assert tests.loc[tests["metric"].isin([label.lower() for label in SUBJECTIVE]), "proxy"].all()
    here = re.findall(r"<h4>Here</h4><ul>(.*?)</ul>", page, flags=re.DOTALL)
    words = re.findall(rf"({'|'.join(SUBJECTIVE).lower()})( \(PROXY\))?", " ".join(here))
    assert words and all(mark for _, mark in words)


def test_page_shows_the_numbers(written, trials):
    """Means, the paper's F beside ours, and the weights as section 6.1 averages them."""
    _, tests, page = written
    text = text_of(page)
    nhg = trials.loc[trials["condition"] == "nhg", "win_rate"]
    assert f"(a) NHG {nhg.mean():.2f} ± {nhg.std():.2f} " in text
    anova = tests.query("family == 'CombHG' and metric == 'mean_disagreement' and test == 'rm_anova'").iloc[0]
    assert f"CombHG Mean disagreement 20 {anova['statistic']:.3f} 2, 38 {anova['epsilon']:.3f}" in text
    ranks = "<.001" if anova["rank_p"] < 0.001 else f"{anova['rank_p']:.3f}"[1:]
    assert f"{anova['eta_squared']:.3f} {ranks} 79.038 <.001 0.806" in text
    assert "UPHG Mean smash speed" in text and "– n.s. –" in text
    assert f"W unc of OAHG 40 {trials['w_unc_optimal_mean'].mean():.3f} ± 0.300 0.600 ± 0.390" in text
    assert f"W sim 40 {trials['w_sim_mean'].mean():.3f} ± 0.300 0.515 ± 0.343" in text


def test_effect_sizes_stand_in_the_papers_direction(written):
    """The tests are x - y in the order of the letters; beside "(f) > (d)" stands f - d."""
    _, tests, page = written
    dz = tests.query("family == 'UPHG' and x == 'd' and y == 'f'").set_index("metric")["dz"]
    text = text_of(page).replace("−", "-")
    assert dz["win_rate"] < -0.1 and dz["mean_disagreement"] > 0.1
    assert re.search(rf"Win rate \(f\) > \(d\) P \.009 \S+ ≥ 0\.76 {-dz['win_rate']:.2f} ", text)
    assert re.search(rf"Mean disagreement \(d\) > \(f\) M \.000 \S+ ≥ 1\.04 {dz['mean_disagreement']:.2f} ", text)


def test_page_says_when_a_run_is_not_frozen(written, trials, tmp_path):
    assert "not the frozen study" in written[2]
    write_report(trials, tmp_path, {"frozen": True})
    assert "not the frozen study" not in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("chosen", "untested"),
    [
        (["combhg_ut_ua_sc"], {"within OAHG", "within UPHG", "within CombHG", "types"}),
        (["uphg", "uphg_ua", "uphg_ut_ua"], {"within OAHG", "within CombHG", "types"}),
    ],
)
def test_some_conditions_only(trials, tmp_path, chosen, untested):
    tests = write_report(trials[trials["condition"].isin(chosen)], tmp_path, {})
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert set(re.search(r"Not tested: ([^.]*)\.", text)[1].strip().split(", ")) == untested
    testable = 0 if tests.empty else 8
    tested = summary(compare_with_paper(tests)).loc["all", "tested"]
    assert tested == testable
    expected = f"of the {testable} testable comparisons" if testable else "None of the paper’s 38 significant"
    assert expected in text
    assert "CombHG, set against OAHG, was not tested." in text


def test_too_few_participants(tmp_path):
    assert write_report(synthetic_trials(users=2), tmp_path, {}).empty
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "too few participants (2)" in text
    assert "The run left no manifest." in text


def test_no_trials_are_refused(trials, tmp_path):
    with pytest.raises(ValueError, match="no trials"):
        write_report(trials.iloc[:0], tmp_path, {})
    assert not list(tmp_path.iterdir())


def test_figure_draws_means_and_intervals(trials):
    figure = figure6(trials)
    assert [axes.get_title() for axes in figure.axes] == [
        label + (" (PROXY)" if label in SUBJECTIVE else "") for label in (metric.label for metric in METRICS.values())
    ]
    means = trials.groupby("condition")[list(METRICS)].mean().loc[list(CONDITIONS)]
    for axes, metric in zip(figure.axes, METRICS, strict=True):
        np.testing.assert_allclose([bar.get_height() for bar in axes.containers[0]], means[metric])
        assert [tick.get_text() for tick in axes.get_xticklabels()] == [f"({letter})" for letter in "abcdefghi"]
    colours = [bar.get_facecolor() for bar in figure.axes[0].containers[0]]
    assert colours == [to_rgba(COLOURS[condition.guidance]) for condition in CONDITIONS.values()]
    disagreement = figure.axes[list(METRICS).index("mean_disagreement")]
    assert [text.get_text() for text in disagreement.texts] == ["–"]  # under NHG


def test_figure_without_any_value_has_no_scale(trials):
    figure = figure6(trials[trials["condition"] == "nhg"])
    scaled = [len(axes.get_yticks()) > 0 for axes in figure.axes]
    assert scaled == [metric != "mean_disagreement" for metric in METRICS]


def test_interval_is_students(trials):
    scores = trials.pivot(index="user", columns="condition", values="win_rate")
    half = confidence_half_width(scores)
    nhg = scores["nhg"]
    low, high = scipy_stats.ttest_1samp(nhg, 0).confidence_interval(0.95)
    assert (nhg.mean() - half["nhg"], nhg.mean() + half["nhg"]) == pytest.approx((low, high))
    assert confidence_half_width(scores.iloc[:1]).isna().all()


def test_answers_of_the_paper():
    """From the paper's own pairs the sentences say what its section 6.1 says."""
    grid = published("grid").fillna({"greater": ""}).assign(tested=True)
    found = answers(grid)
    assert found["RQ1"][:2] == [
        "UT in OAHG lowers mean disagreement.",
        "UA in UPHG raises helpfulness (PROXY) and controllability (PROXY).",
    ]
    assert found["RQ2"] == [
        "OAHG raises win rate and defense rate.",
        "UPHG raises win rate.",
        "CombHG raises win rate and mean smash speed.",
    ]
    assert found["RQ3"] == [
        "UPHG, set against OAHG, raises naturalness (PROXY), controllability (PROXY) and comfort (PROXY)."
    ]
    assert found["RQ4"][1] == "CombHG, set against UPHG, lowers mean disagreement."


def test_answers_without_findings():
    grid = published("grid").assign(greater="", tested=lambda cells: cells["family"] == "OAHG")
    assert answers(grid)["RQ1"][:2] == ["UT in OAHG changes nothing significantly.", "UA in UPHG was not tested."]


def test_screen_table_is_aligned(trials):
    lines = screen_table(trials).splitlines()
    assert len(lines) == 11
    assert {len(line) for line in lines} == {97}
    assert "PROXY" in lines[0]
    nhg = lines[2].replace("|", "").split()
    means = trials[trials["condition"] == "nhg"][list(METRICS)].mean()
    assert nhg[:2] == ["(a)", "NHG"]
    assert nhg[2:] == ["–" if np.isnan(mean) else f"{mean:.2f}" for mean in means]
    assert len(screen_table(trials[trials["condition"] == "uphg"]).splitlines()) == 3


@pytest.fixture
def sweep(trials, tmp_path):
    """A sweep over three conditions: a folder with trials.csv and manifest.json for each."""
    for name in ("uphg", "uphg_ua", "uphg_ut_ua"):
        folder = tmp_path / "sweep" / f"condition={name}[0]"
        folder.mkdir(parents=True)
        trials[trials["condition"] == name].to_csv(folder / "trials.csv", index=False)
        (folder / "manifest.json").write_text(json.dumps({"study_hash": "1234", "condition": name}))
    return tmp_path / "sweep"


@pytest.mark.parametrize("places", [["{0}"], ["{0}/*"], ["{0}", "{0}/*"], ["{0}/condition=uphg[[]0]", "{0}/*u*a*"]])
def test_merge_gathers_a_sweep(sweep, trials, places):
    merged = merge([place.format(sweep) for place in places])
    expected = trials[trials["condition"].str.startswith("uphg")]
    key = ["condition", "user"]
    pd.testing.assert_frame_equal(
        merged.sort_values(key, ignore_index=True), expected.sort_values(key, ignore_index=True), check_dtype=False
    )


def test_merge_takes_existing_names_literally(sweep):
    folder = sweep / "condition=uphg[0]"
    assert found_below([folder, str(folder / "trials.csv")], "trials.csv") == [folder / "trials.csv"]


def test_merge_refuses_the_same_game_twice(sweep, trials):
    again = sweep / "again"
    again.mkdir()
    trials[trials["condition"] == "uphg"].head(2).to_csv(again / "trials.csv", index=False)
    with pytest.raises(ValueError, match=r"S01 uphg \(seed 1\), S02 uphg \(seed 1\)$"):
        merge([sweep])


def test_merge_refuses_different_studies(sweep):
    manifest = sweep / "condition=uphg[0]" / "manifest.json"
    manifest.write_text(json.dumps({"study_hash": "5678"}))
    with pytest.raises(ValueError, match="different studies") as refusal:
        merge([sweep])
    assert "1234" in str(refusal.value) and "5678" in str(refusal.value)
    manifest.unlink()  # a run without a manifest is tolerated
    assert len(merge([sweep])) == 60


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("trials.csv", "", "trials.csv: No columns"),
        ("trials.csv", "user,condition\nS01,nhg\n", "lacks the columns seed, win_rate"),
        ("trials.csv", ",".join(["user", "condition", "seed", *METRICS]), "trials.csv holds no games"),
        ("manifest.json", "{", "manifest.json is not JSON"),
    ],
)
def test_merge_refuses_broken_files(sweep, name, content, message):
    (sweep / "condition=uphg[0]" / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        merge([sweep])


def test_merge_refuses_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"no trials\.csv at or below"):
        merge([tmp_path])


def report_command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    """Start the command as from a shell in `cwd`, away from the source tree."""
    command = [sys.executable, "-m", "guidance.report", *arguments]
    root = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": str(root), "AIRHOCKEY_OUTPUTS": str(cwd / "outputs")}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_command_merges_and_reports(sweep, tmp_path):
    done = report_command(f"runs={sweep}", "out=result", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "(d) UPHG (vanilla)" in done.stdout and "of the paper's 38 findings replicate (8 tested)" in done.stdout
    page = (tmp_path / "result" / "report.html").read_text(encoding="utf-8")
    assert "study_hash" in page and "trials_sha256" in page
    assert len(pd.read_csv(tmp_path / "result" / "tests.csv")) == 8 * (1 + 3)


def test_command_names_what_is_wrong(sweep, tmp_path):
    file = sweep / "condition=uphg[0]" / "trials.csv"
    pd.read_csv(file).iloc[1:].to_csv(file, index=False)
    done = report_command(f"runs={sweep}", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip() == "error: every participant must have played every condition: S01 lacks uphg"


def test_withdrawn_proxies_count_for_nothing(trials, tmp_path):
    whole, less = tmp_path / "whole", tmp_path / "less"
    tests = write_report(trials, whole, {"config": {"users": {"withdrawn": []}}})
    write_report(trials, less, {"config": {"users": {"withdrawn": ["comfort", "helpfulness"]}}})
    page = (less / "report.html").read_text()
    assert "Withdrawn:" in page and "Withdrawn:" not in (whole / "report.html").read_text()
    counted, all_counted = (
        summary(compare_with_paper(tests, withdrawn)) for withdrawn in (["comfort", "helpfulness"], [])
    )
    proxies = published("findings")["metric"].isin(["comfort", "helpfulness"])
    assert all_counted.loc["all", "tested"] - counted.loc["all", "tested"] == proxies.sum() > 0
    assert counted.loc["M"].equals(all_counted.loc["M"])
    answered = page[page.index("<h4>Here</h4>") : page.index("<h4>Paper</h4>")]
    assert "comfort" not in answered and "helpfulness" not in answered


def test_conditions_beyond_the_paper_have_a_section_and_a_bar(trials, tmp_path):
    mine = trials[trials["condition"] == "oahg_ut"].assign(condition="<mine>", win_rate=lambda t: t["win_rate"] + 0.5)
    everything = pd.concat([trials, mine], ignore_index=True)
    write_report(everything, tmp_path, {})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    text = text_of(page)
    assert "Beyond the paper (j) <mine> is not a condition of the paper." in text and "<mine>" not in page
    assert "Win rate (j) <mine> > (a) NHG" in text
    assert len(figure6(everything).axes[0].patches) == 10
    assert "(j) <mine>" in screen_table(everything)
