"""The report on synthetic trials: what is written, what it says and refuses; the figure and the sentences in it."""

import base64
import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from scipy import stats as scipy_stats

from airhockey_marl.experiment.files import find_files
from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.figures import COLORS, figure6, means_beside
from guidance.statistics.groups import Group, confidence_half_width, gather, merge, side_by_side
from guidance.statistics.paper import compare_with_paper, count_findings, published_results
from guidance.statistics.report import screen_table, write_report
from guidance.statistics.research_questions import answer_questions
from guidance.statistics.tests import check_trials, run_tests
from tests.processes import start

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
    tests = write_report(trials, folder, manifest).tests
    return folder, tests, (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def no_figures(monkeypatch):
    """Reports without their figures, which take most of the time to write."""
    monkeypatch.setattr("guidance.statistics.report.save_figure", lambda draw, folder, name, dpi: b"<svg/>")


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
    counts, text = count_findings(compare_with_paper(tests)), text_of(page)
    assert 0 < counts.loc["all", "replicated"] < 38
    assert f"{counts.loc['all', 'replicated']} of the paper’s 38 significant comparisons replicate." in text
    for evidence in ("M", "P", "S", "S0"):
        row = counts.loc[evidence]
        assert f"{row['replicated']} / {row['cells']} {evidence} ·" in text
    assert f"{counts.loc['none', 'false_positives']} / 63 non-findings significant here" in text
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


def test_page_says_when_a_run_is_not_frozen(written, trials, tmp_path, no_figures):
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
def test_some_conditions_only(trials, tmp_path, chosen, untested, no_figures):
    tests = write_report(trials[trials["condition"].isin(chosen)], tmp_path, {}).tests
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert set(re.search(r"Not tested: ([^.]*)\.", text)[1].strip().split(", ")) == untested
    testable = 0 if tests.empty else 8
    tested = count_findings(compare_with_paper(tests)).loc["all", "tested"]
    assert tested == testable
    expected = f"of the {testable} testable comparisons" if testable else "None of the paper’s 38 significant"
    assert expected in text
    assert "CombHG, set against OAHG, was not tested." in text


def test_no_trials_are_refused(trials, tmp_path):
    with pytest.raises(ValueError, match="no trials"):
        write_report(trials.iloc[:0], tmp_path, {})
    assert not list(tmp_path.iterdir())


def test_too_few_participants(tmp_path, no_figures):
    assert write_report(synthetic_trials(users=2), tmp_path, {}).tests.empty
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "too few participants (2)" in text
    assert "The run has no manifest." in text


def test_figure_draws_means_and_intervals(trials):
    figure = figure6(Group(trials, {}))
    assert [axes.get_title() for axes in figure.axes] == [
        label + (" (PROXY)" if label in SUBJECTIVE else "") for label in (metric.label for metric in METRICS.values())
    ]
    means = trials.groupby("condition")[list(METRICS)].mean().loc[list(CONDITIONS)]
    for axes, metric in zip(figure.axes, METRICS, strict=True):
        np.testing.assert_allclose([bar.get_height() for bar in axes.containers[0]], means[metric])
        assert [tick.get_text() for tick in axes.get_xticklabels()] == [f"({letter})" for letter in "abcdefghi"]
    colors = [bar.get_facecolor() for bar in figure.axes[0].containers[0]]
    assert colors == [to_rgba(COLORS[condition.type]) for condition in CONDITIONS.values()]
    disagreement = figure.axes[list(METRICS).index("mean_disagreement")]
    assert [text.get_text() for text in disagreement.texts] == ["–"]  # under NHG


def test_figure_without_any_value_has_no_scale(trials):
    figure = figure6(Group(trials[trials["condition"] == "nhg"], {}))
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
    grid = published_results("grid").fillna({"greater": ""}).assign(tested=True)
    found = answer_questions(grid)
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
    grid = published_results("grid").assign(greater="", tested=lambda cells: cells["family"] == "OAHG")
    assert answer_questions(grid)["RQ1"][:2] == [
        "UT in OAHG changes nothing significantly.",
        "UA in UPHG was not tested.",
    ]


def test_screen_table_is_aligned(trials):
    lines = screen_table(Group(trials, {})).splitlines()
    assert len(lines) == 11
    assert {len(line) for line in lines} == {97}
    assert "PROXY" in lines[0]
    nhg = lines[2].replace("|", "").split()
    means = trials[trials["condition"] == "nhg"][list(METRICS)].mean()
    assert nhg[:2] == ["(a)", "NHG"]
    assert nhg[2:] == ["–" if np.isnan(mean) else f"{mean:.2f}" for mean in means]
    assert len(screen_table(Group(trials[trials["condition"] == "uphg"], {})).splitlines()) == 3


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
    assert find_files([folder, str(folder / "trials.csv")], "trials.csv") == [folder / "trials.csv"]


def test_merge_refuses_the_same_game_twice(sweep, trials):
    again = sweep / "again"
    again.mkdir()
    trials[trials["condition"] == "uphg"].head(2).to_csv(again / "trials.csv", index=False)
    with pytest.raises(ValueError, match=r"S01 uphg \(seed 1\), S02 uphg \(seed 1\)$") as refusal:
        merge([sweep])
    assert str(sweep / "condition=uphg[0]" / "trials.csv") in str(refusal.value) and str(again) in str(refusal.value)


def test_merge_refuses_different_studies(sweep):
    manifest = sweep / "condition=uphg[0]" / "manifest.json"
    manifest.write_text(json.dumps({"study_hash": "5678"}))
    with pytest.raises(ValueError, match="different studies") as refusal:
        merge([sweep])
    assert "1234" in str(refusal.value) and "5678" in str(refusal.value)
    manifest.unlink()  # a run without a manifest is tolerated
    assert len(merge([sweep])) == 60


def test_people_of_other_seeds_and_studies_are_other_people(sweep, trials):
    file = sweep / "condition=uphg[0]"
    other = sweep / "other"
    other.mkdir()
    shutil.copy(file / "manifest.json", other)
    pd.read_csv(file / "trials.csv").assign(seed=2).to_csv(other / "trials.csv", index=False)
    assert {"S01 of 1", "S01 of 2"} < set(merge([sweep])["user"])
    (other / "manifest.json").write_text(json.dumps({"study_hash": "567890abcdef"}))
    pd.read_csv(file / "trials.csv").to_csv(other / "trials.csv", index=False)
    with pytest.raises(ValueError, match="different studies"):
        merge([sweep])
    merged = merge([sweep], mixed=True)
    assert {"S01 in 1234", "S01 in 567890ab"} < set(merged["user"]) and len(merged) == 80
    both = gather([file, other], mixed=True)
    assert both.size == 40 and both.manifest["frozen"] is False


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("trials.csv", "", "trials.csv must be a table, and is empty"),
        ("trials.csv", "user,condition\nS01,nhg\n", "lacks the columns win_rate, .*, seed"),
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
    return start("guidance", "report", *arguments, cwd=cwd, env={"AIRHOCKEY_OUTPUTS": str(cwd / "outputs")})


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
    reason = "every participant must have played every condition: S01 lacks uphg"
    assert done.stderr.strip() == f"error: {file} and others: {reason}"


def test_withdrawn_proxies_count_for_nothing(trials, tmp_path, no_figures):
    whole, less = tmp_path / "whole", tmp_path / "less"
    tests = write_report(trials, whole, {"config": {"users": {"withdrawn": []}}}).tests
    write_report(trials, less, {"config": {"users": {"withdrawn": ["comfort", "helpfulness"]}}})
    page = (less / "report.html").read_text()
    assert "Withdrawn:" in page and "Withdrawn:" not in (whole / "report.html").read_text()
    counted, all_counted = (
        count_findings(compare_with_paper(tests, withdrawn)) for withdrawn in (["comfort", "helpfulness"], [])
    )
    proxies = published_results("findings")["metric"].isin(["comfort", "helpfulness"])
    assert all_counted.loc["all", "tested"] - counted.loc["all", "tested"] == proxies.sum() > 0
    assert counted.loc["M"].equals(all_counted.loc["M"])
    answered = page[page.index("<h4>Here</h4>") : page.index("<h4>Paper</h4>")]
    assert "comfort" not in answered and "helpfulness" not in answered


def test_conditions_beyond_the_paper_have_a_section_and_a_bar(trials, tmp_path):
    mine = trials[trials["condition"] == "oahg_ut"].assign(condition="mine", win_rate=lambda t: t["win_rate"] + 0.5)
    everything = pd.concat([trials, mine], ignore_index=True)
    group = write_report(everything, tmp_path, {"conditions": [{"name": "mine", "letter": "j", "label": "<mine>"}]})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    text = text_of(page)
    assert "Beyond the paper (j) <mine> is not a condition of the paper." in text and "<mine>" not in page
    assert "Win rate (j) <mine> > (a) NHG" in text
    assert len(figure6(group).axes[0].patches) == 10
    assert "(j) <mine>" in screen_table(group)
    with pytest.raises(ValueError, match=r"condition\.name = '<mine>' must be a word"):
        write_report(everything.replace({"condition": {"mine": "<mine>"}}), tmp_path, {})


PEOPLE = {
    "study_hash": "77aa" * 16,
    "seed": 7,
    "participants": "people",
    "frozen": False,
    "withdrawals": 1,
    "config": {"participants": 20, "users": {"withdrawn": ["comfort"]}},
}
SIMULATED = {"study_hash": "5e1f" * 16, "config": {"users": {"withdrawn": ["helpfulness"]}}}


def page_of(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_what_people_say_is_a_rating(trials, tmp_path):
    """Not one number differs from those of the same trials of simulated people, and no word says proxy."""
    tests = write_report(trials, tmp_path / "people", PEOPLE).tests
    of_proxies = write_report(trials, tmp_path / "simulated", {}).tests
    assert not tests["proxy"].any() and of_proxies["proxy"].any()
    pd.testing.assert_frame_equal(tests.drop(columns="proxy"), of_proxies.drop(columns="proxy"))
    text = text_of(page_of(tmp_path / "people"))
    before_manifest = text[: text.index("Provenance")]
    for word in ("proxy", "proxies", "simulat", "withdrawn", "tuning", "frozen"):
        assert word not in before_manifest.lower(), word
    assert "20 participants, 180 games, all nine" in text and "their ratings , from 1 to 7" in text
    assert "S · rating" in text and "S0 · rating, against no force" in text
    assert "Interim" not in text and "Unfinished" not in text and "Not tested" not in text
    svg = (tmp_path / "people" / "figure6.svg").read_text()
    assert "PROXY" not in svg and "PROXY" in (tmp_path / "simulated" / "figure6.svg").read_text()
    assert "PROXY" not in screen_table(Group(trials, {"participants": "people"}))
    assert {len(line) for line in screen_table(Group(trials, {"participants": "people"})).splitlines()} == {97}
    withdrawn = count_findings(compare_with_paper(tests, ["comfort"])).loc["all", "tested"]
    assert withdrawn < 38 and "comparisons among" not in text  # all 38 count


def test_manifests_that_say_nothing_or_simulated_are_of_simulated_people(trials, tmp_path, no_figures):
    for name, manifest in (("nothing", {}), ("simulated", {"participants": "simulated"})):
        write_report(trials, tmp_path / name, manifest)
    pages = [page_of(tmp_path / name).partition("Provenance")[0] for name in ("nothing", "simulated")]
    assert pages[0] == pages[1] and "20 simulated participants" in pages[0]
    with pytest.raises(ValueError, match="participants = 'robots' must be people or simulated"):
        write_report(trials, tmp_path, {"participants": "robots"})


@pytest.mark.parametrize("users", [1, 2, 3])
def test_few_people(tmp_path, users):
    tests = write_report(synthetic_trials(users=users), tmp_path, PEOPLE).tests
    text = text_of(page_of(tmp_path))
    assert f"Interim. {users} of the 20 participants" in text
    if users < 3:
        assert tests.empty and f"Not tested: too few participants ({users})" in text
        assert "None of the paper’s 38 significant comparisons could be tested" in text
        assert "With fewer than three participants nothing is tested." in text
    else:
        assert len(tests) == 8 * (1 + 4 + 4 + 7) - 3 and "Not tested" not in text  # disagreement has three types
        assert "For scale, with 3 participants: guidance without any effect" in text


def unfinished(users: int = 5) -> pd.DataFrame:
    """People of whom the last but one has played four conditions, and the last one."""
    trials = synthetic_trials(users=users)
    played = {f"S{users - 1:02d}": list(CONDITIONS)[:4], f"S{users:02d}": ["nhg"]}
    keep = [row.condition in played.get(row.user, CONDITIONS) for row in trials.itertuples()]
    return trials[keep]


def test_people_who_have_not_finished(tmp_path, no_figures):
    trials = unfinished()
    tests = write_report(trials, tmp_path, PEOPLE).tests
    whole = run_tests(synthetic_trials(users=5).query("user in ['S01', 'S02', 'S03']"), people=True)
    for family in ("UPHG", "CombHG", "types"):  # as if the two were not there
        kept, expected = (frame[frame["family"] == family].reset_index(drop=True) for frame in (tests, whole))
        pd.testing.assert_frame_equal(kept, expected)
    assert set(tests.loc[tests["family"] == "OAHG", "n"]) == {4}
    text = text_of(page_of(tmp_path))
    assert "Unfinished: S04 (4 of 9 conditions), S05 (1 of 9 conditions)." in text
    assert "(a) NHG n = 5" in text and "(i) CombHG (UT+UA+SC) n = 3" in text
    nhg = trials.loc[trials["condition"] == "nhg", "win_rate"]
    assert f"(a) NHG n = 5 {nhg.mean():.2f} ± {nhg.std():.2f} " in text
    with pytest.raises(ValueError, match="every participant must have played every condition: S04 lacks"):
        check_trials(trials)


def test_families_that_too_few_people_have_finished_are_named(tmp_path, no_figures):
    tests = write_report(unfinished(4), tmp_path / "all", PEOPLE).tests
    text = text_of(page_of(tmp_path / "all"))
    assert "Not tested: within UPHG, within CombHG, types. Fewer than three" in text
    assert tests.loc[tests["family"] == "OAHG", "p"].notna().all()
    counts = count_findings(compare_with_paper(tests))
    assert counts.loc["all", "tested"] == 1 and "of the 1 testable comparisons" in text
    some = unfinished(4).query("condition in ['nhg', 'oahg', 'oahg_ut']")
    write_report(some, tmp_path / "some", PEOPLE)
    text = text_of(page_of(tmp_path / "some"))
    assert "Not tested: within UPHG, within CombHG, types." in text
    assert "Unfinished: S04 (1 of 3 conditions)" in text


def test_people_and_simulated_people_are_never_merged(sweep):
    file = sweep / "condition=uphg[0]" / "manifest.json"
    file.write_text(json.dumps({"study_hash": "1234", "participants": "people"}))
    with pytest.raises(ValueError, match="people and simulated people cannot be merged"):
        merge([sweep])


@pytest.fixture(scope="module")
def groups() -> tuple[Group, Group]:
    return Group(unfinished(), PEOPLE), Group(synthetic_trials(seed=2), SIMULATED)


def test_two_groups_stand_side_by_side(groups, tmp_path):
    people, simulated = groups
    tests = write_report(people.trials, tmp_path, PEOPLE, simulated).tests
    pd.testing.assert_frame_equal(tests, run_tests(people.trials, people=True))  # as without the other
    page = page_of(tmp_path)
    section = page[page.index("<h2>Side by side</h2>") : page.index("<h2>Where the paper is contradicted</h2>")]
    text = text_of(section)
    assert "5 people beside 20 simulated people : each tested alone, and never pooled." in text.replace(
        "people:", "people :"
    )
    assert "They are of different studies" in text
    assert f"people {PEOPLE['study_hash']} simulated people {SIMULATED['study_hash']}" in text
    for group, name in ((people, "people"), (simulated, "simulated people")):
        scores = group.trials.pivot(index="user", columns="condition", values="win_rate")["oahg"].dropna()
        low, high = scipy_stats.ttest_1samp(scores, scores.mean()).confidence_interval(0.95)
        assert f"{name} {len(scores)} {scores.mean():.2f} ± {(high - low) / 2:.2f} " in text
    assert section.count("<tr") == 2 + 2 + 18 + 2 + 38
    outcomes = simulated.comparison.query("paper == 'significant'")["outcome"]
    mine = people.comparison.query("paper == 'significant'")["outcome"]
    for word, outcome in (("✓ replicated", "replicated"), ("⇄ reversed", "reversed"), ("withdrawn", "withdrawn")):
        assert section.count(word) == outcomes.eq(outcome).sum() + mine.eq(outcome).sum()
    assert outcomes.eq("withdrawn").any() and not mine.eq("withdrawn").any()
    findings = re.findall(r"<tr[^>]*>(.*?)</tr>", section[section.index("38 findings") :], flags=re.DOTALL)[2:]
    proxies = [len(re.findall("PROXY", row)) for row in findings]
    assert proxies == published_results("findings")["kind"].eq("subjective").astype(int).tolist()
    sources = re.findall(r'src="data:image/svg\+xml;base64,([^"]*)"', page)
    assert [base64.b64decode(source) for source in sources] == [
        (tmp_path / name).read_bytes() for name in ("figure6.svg", "beside.svg")
    ]
    assert (tmp_path / "beside.png").read_bytes().startswith(b"\x89PNG")
    assert "5e1f" in page[page.index("Provenance") :]


def test_counts_side_by_side_are_of_findings_that_both_tested(groups):
    people, simulated = groups
    both = side_by_side(people, simulated)
    assert sum(both["counts"].values()) == 38
    assert both["counts"]["untested"] == published_results("findings")["metric"].eq("helpfulness").sum()
    for row in both["findings"]:
        ours, theirs = row["rows"]
        assert ours["id"] == theirs["id"] == row["id"] and {row["paper_greater"], row["less"]} == {row["x"], row["y"]}
        agrees = ours["greater"] == row["paper_greater"]
        assert np.isnan(ours["toward_paper"]) or (ours["toward_paper"] > 0) == agrees
    again = side_by_side(simulated, simulated)["counts"]
    assert again["first"] == again["second"] == 0 < again["both"]


def test_groups_of_a_kind_are_told_apart(trials, tmp_path, no_figures):
    simulated = Group(synthetic_trials(seed=2), {})
    write_report(trials, tmp_path, SIMULATED, simulated)
    text = text_of(page_of(tmp_path))
    assert "20 simulated people here beside 20 simulated people beside" in text
    assert "Whether they are of the same study is not known" in text and "left no study_hash" in text


def test_figure_of_two_groups_draws_both_means(groups):
    people, simulated = groups
    figure = means_beside(people, simulated)
    for axes, metric in zip(figure.axes, METRICS, strict=True):
        lines = [line for line in axes.lines if not str(line.get_label()).startswith("_")]
        assert [line.get_label() for line in lines] == ["people (n = 5)", "simulated people (n = 20)"]
        for line, group in zip(lines, groups, strict=True):
            means = group.trials.groupby("condition")[metric].mean().loc[list(CONDITIONS)]
            np.testing.assert_allclose(line.get_ydata(), means)
        assert ("PROXY of simulated people" in axes.get_ylabel()) == (METRICS[metric].kind == "subjective")


def test_conditions_of_one_group_only_have_one_letter_in_both(trials):
    mine = trials[trials["condition"] == "oahg_ut"].assign(condition="mine")
    yours = trials[trials["condition"] == "oahg_ut"].assign(condition="yours")
    groups = [Group(pd.concat([trials, own], ignore_index=True), {}) for own in (mine, yours)]
    rows = {row["label"]: row for row in side_by_side(*groups)["means"]}
    assert (rows["mine"]["letter"], rows["yours"]["letter"]) == ("j", "k")
    assert [cell["n"] for cell in rows["yours"]["cells"]] == [0, 20]
    figure = means_beside(*groups)
    assert len(figure.axes[0].get_xticks()) == 11


@pytest.fixture
def studies(tmp_path):
    """A study with people who have not finished, and a simulated one."""
    for name, trials, manifest in (
        ("people", unfinished(), PEOPLE),
        ("simulated", synthetic_trials(seed=2), SIMULATED),
    ):
        (tmp_path / name).mkdir()
        trials.to_csv(tmp_path / name / "trials.csv", index=False)
        (tmp_path / name / "manifest.json").write_text(json.dumps(manifest))
    return tmp_path


def test_command_sets_two_groups_side_by_side(studies):
    done = report_command("runs=people", "beside=simulated", "out=result", cwd=studies)
    assert done.returncode == 0, done.stderr
    assert "7-point ratings" in done.stdout and "PROXY" not in done.stdout
    assert re.search(r"^beside: \d+ replicate \(\d+ tested\), \d+ reversed$", done.stdout, flags=re.MULTILINE)
    assert {path.name for path in (studies / "result").iterdir()} == {
        f"{name}.{kind}" for name in ("figure6", "beside") for kind in ("png", "svg")
    } | {"report.html", "tests.csv"}


@pytest.mark.parametrize(
    ("beside", "message"),
    [
        ("people", "beside = people has the same games as runs = people: people/trials.csv"),
        ("copy", "beside = copy has the same games as runs = people: copy/trials.csv"),
        ("nowhere", "beside: runs = nowhere: there is no trials.csv at or below it"),
    ],
)
def test_command_refuses_to_set_games_beside_themselves(studies, beside, message):
    shutil.copytree(studies / "people", studies / "copy")
    done = report_command("runs=people", f"beside={beside}", "out=result", cwd=studies)
    assert done.returncode == 2 and not (studies / "result").exists()
    assert done.stderr.strip() == f"error: {message}"


DECLARED = {
    "conditions": [
        {"name": "nhg", "letter": "a", "label": "NHG", "color": None, "against": []},
        {"name": "mine", "letter": "q", "label": "My own", "color": "#123456", "against": ["b", "c"]},
    ]
}


@pytest.fixture(scope="module")
def declared_trials(trials) -> pd.DataFrame:
    own = trials[trials["condition"] == "oahg_ut"].assign(condition="mine", win_rate=lambda t: t["win_rate"] + 0.01)
    return pd.concat([trials, own], ignore_index=True)


def test_declared_conditions_keep_letter_label_and_color(declared_trials, tmp_path):
    write_report(declared_trials, tmp_path, DECLARED)
    text = text_of(page_of(tmp_path))
    assert "(q) My own is not a condition of the paper." in text and "mine" not in text[: text.index("Provenance")]
    group = Group(declared_trials, DECLARED)
    assert "(q) My own" in screen_table(group)
    bars = figure6(group).axes[0].containers[0]
    assert [bar.get_facecolor() for bar in bars][-1] == to_rgba("#123456")


def test_planned_comparisons_show_every_row(declared_trials, tmp_path, no_figures):
    tests = write_report(declared_trials, tmp_path, DECLARED).tests
    planned = tests[tests["test"] == "planned"]
    assert set(planned["family"]) == {"mine"} and len(planned) == 2 * 8
    pair = planned.query("x == 'b' and metric == 'win_rate'").iloc[0]
    x, y = (
        declared_trials.query(f"condition == '{name}'").sort_values("user")["win_rate"] for name in ("oahg", "mine")
    )
    expected = scipy_stats.ttest_rel(x.to_numpy(), y.to_numpy())
    assert (pair["statistic"], pair["p"]) == pytest.approx((expected.statistic, expected.pvalue))
    assert pair["p_corrected"] == pytest.approx(min(1, 2 * expected.pvalue))
    page = page_of(tmp_path)
    section = page[page.index("<h3>Planned comparisons</h3>") : page.index("<h2>The order of the conditions")]
    assert section.count("<tr") == 1 + 2 * 8 and "(b) OAHG (vanilla) − (q) My own" in section
    alone = run_tests(declared_trials[declared_trials["condition"].isin(CONDITIONS)])
    rest = tests[~tests["family"].isin(["beyond", "mine"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(rest, alone)


@pytest.mark.parametrize(
    ("key", "value"), [("letter", "jj"), ("label", 3), ("color", "red"), ("against", "b"), ("name", "")]
)
def test_manifests_with_invalid_conditions_are_refused(declared_trials, tmp_path, key, value):
    manifest = {"conditions": [DECLARED["conditions"][1] | {key: value}]}
    if key == "against":
        manifest["conditions"][0]["against"] = [value, 1]
    with pytest.raises(ValueError, match=rf"manifest: conditions: .*{key} = "):
        write_report(declared_trials, tmp_path, manifest)
