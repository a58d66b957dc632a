"""The report of a study: the paper's tables and Figure 6 with the paper's numbers beside ours.

`airhockey report runs=outputs/evaluate/...` gathers every trials.csv below the given folders (one run, or the
runs of a sweep over conditions) and writes tests.csv, figure6.png, figure6.svg and report.html. With `beside` another
group stands beside it, such as simulated people beside people, with beside.png and beside.svg.
"""

import base64
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from airhockey_marl.experiment.files import atomic_write, find_files, sha256, write_text
from airhockey_marl.experiment.html import template
from airhockey_marl.experiment.plotting import save_figure
from guidance.statistics.figures import figure6, means_beside
from guidance.statistics.groups import UNTESTED, Group, names_of, of_people, side_by_side
from guidance.statistics.paper import EVIDENCE, EVIDENCE_OF_PEOPLE, count_findings, published_results, reference_points
from guidance.statistics.research_questions import QUESTIONS, answer_questions
from guidance.statistics.tests import (
    ALPHA,
    BEYOND,
    CONDITIONS,
    FAMILIES,
    FEWEST_PARTICIPANTS,
    METRICS,
    check_trials,
    conditions_of,
    missing_games,
)

TRIALS = "trials.csv"
FORMULA = "=+-@"  # what a spreadsheet's formula begins with
PAPERS_LETTERS = [condition.letter for condition in CONDITIONS.values()]
SHORT = ("win rate", "smash", "defense", "disagree", "helpful", "natural", "control", "comfort")


def write_report(
    trials: pd.DataFrame, folder: Path | str, manifest: Mapping[str, Any], beside: Group | None = None
) -> pd.DataFrame:
    """Test the trials and write tests.csv, figure6.png, figure6.svg and report.html into `folder`.

    Every file is replaced whole. report.html holds its style and its figures and loads nothing.

    Args:
        trials: one row per participant and condition, the columns of `trials.csv`; any subset of the conditions.
        folder: created if absent.
        manifest: what the trials came from (hashes of the models, seeds, versions, configuration); shown as it is.
            `frozen`, if False, makes the report say that the run is not the frozen study. `participants`, if
            "people", makes it take the ratings for what people said, and leave out of a test who has not finished.
        beside: another group, to be shown beside these trials, tested alone, in beside.png, beside.svg and a section.

    Returns:
        The tests, see `guidance.statistics.tests.run_tests`.

    Raises:
        ValueError: no trials, or trials that `guidance.statistics.tests.check_trials` refuses.
    """
    if trials.empty:
        raise ValueError("no trials to report")
    folder, group = Path(folder), Group(trials, manifest)
    with atomic_write(folder / "tests.csv") as path:
        group.tests.to_csv(path, index=False)
    svg = save_figure(lambda: figure6(trials, group.withdrawn, group.people), folder, "figure6", dpi=150)
    shown = {} if beside is None else _beside(group, beside, folder)
    write_text(folder / "report.html", _page(group, svg, {"beside": None} | shown))
    return group.tests


def screen_table(trials: pd.DataFrame, people: bool = False) -> str:
    """The means of the eight metrics per condition as aligned text, 97 characters wide, for a terminal."""
    ratings = "7-point ratings" if people else "PROXY of the 7-point ratings"
    means = trials.groupby("condition")[list(METRICS)].mean()
    width, gap = 22, 9
    lines = [f"{'':{width + 4 * gap}} | {ratings:^{4 * gap}}"]
    cells = [("condition", [f"{name:>{gap}}" for name in SHORT])]
    for name, condition in conditions_of(trials).items():
        values = ["–" if np.isnan(value) else f"{value:.2f}" for value in means.loc[name]]
        cells.append((f"({condition.letter}) {condition.label}", [f"{value:>{gap}}" for value in values]))
    lines += [f"{label:{width}}{''.join(row[:4])} | {''.join(row[4:])}" for label, row in cells]
    return "\n".join(lines)


def merge(folders: Iterable[str | Path], mixed: bool = False) -> pd.DataFrame:
    """Concatenate every trials.csv at or below the given files, folders or glob patterns.

    Simulated people of other seeds or studies are other people: where there are several, `user` says which, as in
    "S01 of 2022", or "S01 of 2022 in 1a2b3c4d" by the first digits of the study's hash.

    Args:
        mixed: allow runs of different studies.

    Raises:
        ValueError: nothing found, an unreadable or empty file, a participant's game in a condition that occurs twice
            with the same seed, or runs whose manifest.json tell of different studies (`study_hash`) unless `mixed`, or
            some of people and some not.
    """
    files = find_files(folders, TRIALS)
    studies: dict[str, list[str]] = {}
    manifests = [_manifest(file) for file in files]
    for file, manifest in zip(files, manifests, strict=True):
        if "study_hash" in manifest:
            studies.setdefault(manifest["study_hash"], []).append(str(file.parent))
    if len(studies) > 1 and not mixed:
        named = "; ".join(f"{study}: {', '.join(places)}" for study, places in studies.items())
        raise ValueError(f"these runs are of different studies and cannot be merged, unless mixed=true: {named}")
    if len(kinds := {of_people(manifest) for manifest in manifests}) > 1:
        raise ValueError("people and simulated people cannot be merged: name one of them as beside")
    tables = [
        _read(file).assign(study=manifest.get("study_hash", ""), place=str(file))
        for file, manifest in zip(files, manifests, strict=True)
    ]
    trials = pd.concat(tables, ignore_index=True)
    key = ["user", "condition", "seed", *(["study"] if mixed else [])]
    if (repeated := trials[trials.duplicated(key, keep=False)]).size:
        games = (
            repeated.groupby(key, sort=False)["place"].agg(lambda places: " and ".join(sorted(places))).reset_index()
        )
        named = ", ".join(f"{row.user} {row.condition} (seed {row.seed})" for row in games.itertuples())
        raise ValueError(f"the same game more than once, in {'; '.join(games['place'].unique())}: {named}")
    if kinds == {False}:
        if trials["seed"].nunique() > 1:
            trials["user"] += " of " + trials["seed"].astype("str")
        if trials["study"].nunique() > 1:
            trials["user"] += " in " + trials["study"].str[:8]
    return trials.drop(columns=["study", "place"])


def _read(file: Path) -> pd.DataFrame:
    try:
        trials = pd.read_csv(file, dtype={"user": "str", "condition": "str"})
    except ValueError as error:  # pandas' parser errors are ValueErrors, and do not name the file
        raise ValueError(f"{file}: {error}") from error
    if absent := [column for column in ("user", "condition", "seed", *METRICS) if column not in trials]:
        raise ValueError(f"{file} lacks the columns {', '.join(absent)}")
    if trials.empty:
        raise ValueError(f"{file} holds no games")
    for name in ("user", "condition"):  # programs that open tables take some texts for formulas, and run them
        for text in trials[name].dropna().unique():
            if text[:1] in FORMULA or not text.isprintable():
                raise ValueError(f"{file}: {name} = {text[:40]!r} must be a name, and begin with none of {FORMULA}")
    return trials


def _manifest(trials_file: Path) -> dict[str, Any]:
    file = trials_file.with_name("manifest.json")
    if not file.is_file():
        return {}
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error


def _beside(here: Group, beside: Group, folder: Path) -> dict[str, Any]:
    """Draw two groups side by side; what the template needs for their section."""
    names = names_of([here, beside])
    trials = dict(zip(names, (here.trials, beside.trials), strict=True))
    people = [name for name, group in zip(names, (here, beside), strict=True) if group.people]
    svg = save_figure(lambda: means_beside(trials, people), folder, "beside", dpi=130)
    return {
        "beside": side_by_side(here, beside),
        "beside_figure": base64.b64encode(svg).decode("ascii"),
        "beside_manifest": beside.manifest,
    }


def _page(group: Group, svg: bytes, beside: Mapping[str, Any]) -> str:
    """Fill the template: here what is shown is chosen, there how it looks."""
    trials, tests, manifest, withdrawn, people = (
        group.trials,
        group.tests,
        group.manifest,
        group.withdrawn,
        group.people,
    )
    comparison = group.comparison.copy()
    comparison["less"] = [_other(row.x, row.y, row.greater) for row in comparison.itertuples()]
    comparison["paper_less"] = [_other(row.x, row.y, row.paper_greater) for row in comparison.itertuples()]
    comparison["dz_toward_paper"] = comparison["dz"] * np.where(comparison["x"] == comparison["paper_greater"], 1, -1)
    findings = comparison[comparison["paper"] == "significant"]
    tested = ~comparison["outcome"].isin(UNTESTED)
    counts = comparison["significant"] & tested
    ours = comparison.assign(tested=tested, greater=comparison["greater"].where(counts, ""))
    paper = comparison.assign(tested=True, greater=comparison["paper_greater"])
    enough = group.size >= FEWEST_PARTICIPANTS
    by_chance, rerun = (reference_points(group.size) if enough else (None, None)) if people else reference_points()
    in_family = tests.groupby("family", sort=False)["n"].max()

    return template(Path(__file__).parent / "templates", "report.html", p=_p).render(
        people=people,
        participants=group.size,
        planned=group.planned,
        unfinished=_unfinished(trials),
        too_few=in_family[in_family < FEWEST_PARTICIPANTS].to_dict() if people else {},
        games=len(trials),
        conditions=CONDITIONS,
        labels={c.letter: c.label for c in (CONDITIONS | conditions_of(trials)).values()},
        types={"a": "NHG", "c": "OAHG", "f": "UPHG", "i": "CombHG"},
        metrics=METRICS,
        evidence=EVIDENCE_OF_PEOPLE if people else EVIDENCE,
        withdrawn=withdrawn,
        absent=[name for name in CONDITIONS if name not in conditions_of(trials)],
        untested_families=[family for family in FAMILIES if family not in set(tests["family"])],
        counts=count_findings(comparison).to_dict("index"),
        by_chance=by_chance,
        rerun=rerun,
        figure=base64.b64encode(svg).decode("ascii"),
        means=_means(trials),
        table2=findings[findings["table"] == 2].to_dict("records"),
        table3=findings[findings["table"] == 3].to_dict("records"),
        reversals=findings[findings["outcome"] == "reversed"].to_dict("records"),
        wrong=comparison[comparison["outcome"] == "false_positives"].to_dict("records"),
        paired=_paired_rows(tests, comparison),
        anovas=_anova_rows(tests[tests["family"] != BEYOND]),
        own=[condition for condition in conditions_of(trials).values() if condition.guidance == BEYOND],
        beyond=_beyond_rows(tests),
        by_ranks=int((findings["rank_p"].lt(ALPHA) & _same_sign(findings) & ~findings["metric"].isin(withdrawn)).sum()),
        weights=_weights(trials),
        questions=QUESTIONS,
        answers=answer_questions(ours, people),
        paper_answers=answer_questions(paper),
        manifest=manifest,
        **beside,
    )


def _unfinished(trials: pd.DataFrame) -> dict[str, int]:
    """Whoever has not played all conditions, and how many they have."""
    games = trials["user"].value_counts()
    return {user: int(games[user]) for user in missing_games(trials)}


def _other(x: str, y: str, letter: str) -> str:
    return {x: y, y: x}.get(letter, "")


def _means(trials: pd.DataFrame) -> list[dict[Any, Any]]:
    by_condition, n = (
        trials.groupby("condition")[list(METRICS)].agg(["mean", "std"]),
        trials["condition"].value_counts(),
    )
    return [
        {"condition": condition, "n": n[name], **by_condition.loc[name]}
        for name, condition in conditions_of(trials).items()
    ]


def _paired_rows(tests: pd.DataFrame, comparison: pd.DataFrame) -> list[dict[str, Any]]:
    """The paired t-tests within OAHG beside what the paper found."""
    paper = comparison.set_index(["family", "metric", "x", "y"])[["paper", "p_paper"]]
    return tests[tests["test"] == "paired_t"].join(paper, on=["family", "metric", "x", "y"]).to_dict("records")


def _anova_rows(tests: pd.DataFrame) -> list[dict[str, Any]]:
    """The ANOVAs beside the paper's; the paper prints no F where it found nothing significant."""
    paper = published_results("anova").set_index(["family", "metric"]).drop(columns=["df1", "df2"]).add_suffix("_paper")
    anovas = tests[tests["test"] == "rm_anova"].join(paper, on=["family", "metric"])
    return anovas.fillna({"p_reported_paper": ""}).to_dict("records")


def _beyond_rows(tests: pd.DataFrame) -> list[dict[str, Any]]:
    """The significant pairs with a condition that is not the paper's."""
    own = ~tests["x"].isin(PAPERS_LETTERS) | ~tests["y"].isin(PAPERS_LETTERS)
    rows = tests[(tests["family"] == BEYOND) & (tests["test"] == "posthoc") & own & tests["significant"]]
    return [row | {"less": _other(row["x"], row["y"], row["greater"])} for row in rows.to_dict("records")]


def _same_sign(findings: pd.DataFrame) -> pd.Series:
    return findings["greater"].eq(findings["paper_greater"])


def _weights(trials: pd.DataFrame) -> list[dict[str, Any]]:
    """Mean and SD of each weight within a game, averaged over the games that used it (section 6.1), and the paper's."""
    rows = published_results("weights").to_dict("records")
    for row in rows:
        mean, sd = (trials[f"{row['weight']}_{statistic}"] for statistic in ("mean", "sd"))
        row |= {"games": mean.count(), "our_mean": mean.mean(), "our_sd": sd.mean()}
    return rows


def _p(value: float) -> str:
    """A p as the paper prints it, without the zero before the point."""
    if pd.isna(value):
        return "–"
    return "<.001" if value < 0.001 else "1" if value >= 0.9995 else f"{value:.3f}"[1:]


def gather(places: Iterable[str | Path], mixed: bool = False) -> Group:
    """The trials at or below these places, see `merge`, with their manifests and the hashes of their files.

    Raises:
        ValueError: what `merge` and `guidance.statistics.tests.check_trials` refuse.
    """
    files = find_files(places, TRIALS)
    manifests = {str(file.parent): _manifest(file) for file in files}
    manifest = next(iter(manifests.values())) if len(files) == 1 else {"runs": manifests}
    if len({one.get("study_hash") for one in manifests.values()}) > 1:
        manifest |= {"frozen": False}  # of several studies, no more than one can be the frozen one
    group = Group(merge(files, mixed), manifest | {"trials_sha256": {str(file): sha256(file) for file in files}})
    check_trials(group.trials, group.people)
    return group


def _places(runs: Any) -> list[str]:
    return [runs] if isinstance(runs, str) else list(runs)


def _files(group: Group) -> dict[str, str]:
    return group.manifest["trials_sha256"]
