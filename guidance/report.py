"""The report of a study: the paper's tables and Figure 6 with the paper's numbers beside ours.

`python -m guidance.report runs=outputs/evaluate/...` gathers every trials.csv below the given folders (one run, or the
runs of a sweep over conditions) and writes tests.csv, figure6.png, figure6.svg and report.html.
"""

import base64
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from airhockey_marl.cli import InputError, command
from airhockey_marl.files import found_below, replacing, sha256, write_text
from airhockey_marl.page import template
from guidance.answers import QUESTIONS, answers
from guidance.figures import figure6, save_figure
from guidance.stats import (
    ALPHA,
    BEYOND,
    CONDITIONS,
    EVIDENCE,
    FAMILIES,
    METRICS,
    check_trials,
    compare_with_paper,
    conditions_of,
    published,
    reference_points,
    run_tests,
    summary,
)

TRIALS = "trials.csv"
PAPERS_LETTERS = [condition.letter for condition in CONDITIONS.values()]
SHORT = ("win rate", "smash", "defense", "disagree", "helpful", "natural", "control", "comfort")


def write_report(trials: pd.DataFrame, folder: Path | str, manifest: Mapping[str, Any]) -> pd.DataFrame:
    """Test the trials and write tests.csv, figure6.png, figure6.svg and report.html into `folder`.

    Every file is replaced whole. report.html holds its style and its figure and loads nothing.

    Args:
        trials: one row per participant and condition, the columns of `trials.csv`; any subset of the conditions.
        folder: created if absent.
        manifest: what the trials came from (hashes of the models, seeds, versions, configuration); shown as it is.
            `frozen`, if False, makes the report say that the run is not the frozen study.

    Returns:
        The tests, see `guidance.stats.run_tests`.

    Raises:
        ValueError: no trials, or trials that `guidance.stats.check_trials` refuses.
    """
    if trials.empty:
        raise ValueError("no trials to report")
    folder = Path(folder)
    tests = run_tests(trials)
    with replacing(folder / "tests.csv") as path:
        tests.to_csv(path, index=False)
    svg = save_figure(lambda: figure6(trials, _withdrawn(manifest)), folder, "figure6", dpi=150)
    write_text(folder / "report.html", _page(trials, tests, svg, manifest))
    return tests


def screen_table(trials: pd.DataFrame) -> str:
    """The means of the eight metrics per condition as aligned text, 97 characters wide, for a terminal."""
    means = trials.groupby("condition")[list(METRICS)].mean()
    width, gap = 22, 9
    lines = [f"{'':{width + 4 * gap}} | {'PROXY of the 7-point ratings':^{4 * gap}}"]
    cells = [("condition", [f"{name:>{gap}}" for name in SHORT])]
    for name, condition in conditions_of(trials).items():
        values = ["–" if np.isnan(value) else f"{value:.2f}" for value in means.loc[name]]
        cells.append((f"({condition.letter}) {condition.label}", [f"{value:>{gap}}" for value in values]))
    lines += [f"{label:{width}}{''.join(row[:4])} | {''.join(row[4:])}" for label, row in cells]
    return "\n".join(lines)


def merge(folders: Iterable[str | Path]) -> pd.DataFrame:
    """Concatenate every trials.csv at or below the given files, folders or glob patterns.

    Raises:
        ValueError: nothing found, an unreadable or empty file, a participant's game in a condition that occurs twice
            with the same seed, or runs whose manifest.json tell of different studies (`study_hash`).
    """
    files = found_below(folders, TRIALS)
    studies: dict[str, list[str]] = {}
    for file in files:
        if "study_hash" in (manifest := _manifest(file)):
            studies.setdefault(manifest["study_hash"], []).append(str(file.parent))
    if len(studies) > 1:
        named = "; ".join(f"{study}: {', '.join(places)}" for study, places in studies.items())
        raise ValueError(f"these runs are of different studies and cannot be merged: {named}")
    trials = pd.concat([_read(file) for file in files], ignore_index=True)
    key = ["user", "condition", "seed"]
    if (repeated := trials[trials.duplicated(key)][key].drop_duplicates()).size:
        named = ", ".join(f"{row.user} {row.condition} (seed {row.seed})" for row in repeated.itertuples())
        raise ValueError(f"the same game more than once: {named}")
    return trials


def _read(file: Path) -> pd.DataFrame:
    try:
        trials = pd.read_csv(file, dtype={"user": "str", "condition": "str"})
    except ValueError as error:  # pandas' parser errors are ValueErrors, and do not name the file
        raise ValueError(f"{file}: {error}") from error
    if absent := [column for column in ("user", "condition", "seed", *METRICS) if column not in trials]:
        raise ValueError(f"{file} lacks the columns {', '.join(absent)}")
    if trials.empty:
        raise ValueError(f"{file} holds no games")
    return trials


def _manifest(trials_file: Path) -> dict[str, Any]:
    file = trials_file.with_name("manifest.json")
    if not file.is_file():
        return {}
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error


def _page(trials: pd.DataFrame, tests: pd.DataFrame, svg: bytes, manifest: Mapping[str, Any]) -> str:
    """Fill the template: here what is shown is chosen, there how it looks."""
    withdrawn = _withdrawn(manifest)
    comparison = compare_with_paper(tests, withdrawn)
    comparison["less"] = [_other(row.x, row.y, row.greater) for row in comparison.itertuples()]
    comparison["paper_less"] = [_other(row.x, row.y, row.paper_greater) for row in comparison.itertuples()]
    comparison["dz_toward_paper"] = comparison["dz"] * np.where(comparison["x"] == comparison["paper_greater"], 1, -1)
    findings = comparison[comparison["paper"] == "significant"]
    tested = ~comparison["outcome"].isin(("not_tested", "withdrawn"))
    counts = comparison["significant"] & tested
    ours = comparison.assign(tested=tested, greater=comparison["greater"].where(counts, ""))
    paper = comparison.assign(tested=True, greater=comparison["paper_greater"])
    by_chance, rerun = reference_points()

    return template(Path(__file__).parent, p=_p).render(
        participants=trials["user"].nunique(),
        games=len(trials),
        conditions=CONDITIONS,
        labels={c.letter: c.label for c in (CONDITIONS | conditions_of(trials)).values()},
        types={"a": "NHG", "c": "OAHG", "f": "UPHG", "i": "CombHG"},
        metrics=METRICS,
        evidence=EVIDENCE,
        withdrawn=withdrawn,
        absent=[name for name in CONDITIONS if name not in conditions_of(trials)],
        untested_families=[family for family in FAMILIES if family not in set(tests["family"])],
        counts=summary(comparison).to_dict("index"),
        by_chance=by_chance,
        rerun=rerun,
        figure=base64.b64encode(svg).decode("ascii"),
        means=_means(trials),
        table2=findings[findings["table"] == 2].to_dict("records"),
        table3=findings[findings["table"] == 3].to_dict("records"),
        reversals=findings[findings["outcome"] == "reversed"].to_dict("records"),
        wrong=comparison[comparison["outcome"] == "wrongly_significant"].to_dict("records"),
        paired=_paired_rows(tests, comparison),
        anovas=_anova_rows(tests[tests["family"] != BEYOND]),
        own=[condition for condition in conditions_of(trials).values() if condition.guidance == BEYOND],
        beyond=_beyond_rows(tests),
        by_ranks=int((findings["rank_p"].lt(ALPHA) & _same_sign(findings) & ~findings["metric"].isin(withdrawn)).sum()),
        weights=_weights(trials),
        questions=QUESTIONS,
        answers=answers(ours),
        paper_answers=answers(paper),
        manifest=manifest,
    )


def _withdrawn(manifest: Mapping[str, Any]) -> list[str]:
    """The metrics that the study's configuration withdraws; of merged runs, which are of one study, any will do."""
    manifest = next(iter(manifest["runs"].values()), {}) if "runs" in manifest else manifest
    return list(manifest.get("config", {}).get("users", {}).get("withdrawn", []))


def _other(x: str, y: str, letter: str) -> str:
    return {x: y, y: x}.get(letter, "")


def _means(trials: pd.DataFrame) -> list[dict[Any, Any]]:
    by_condition = trials.groupby("condition")[list(METRICS)].agg(["mean", "std"])
    return [{"condition": condition, **by_condition.loc[name]} for name, condition in conditions_of(trials).items()]


def _paired_rows(tests: pd.DataFrame, comparison: pd.DataFrame) -> list[dict[str, Any]]:
    """The paired t-tests within OAHG beside what the paper found."""
    paper = comparison.set_index(["family", "metric", "x", "y"])[["paper", "p_paper"]]
    return tests[tests["test"] == "paired_t"].join(paper, on=["family", "metric", "x", "y"]).to_dict("records")


def _anova_rows(tests: pd.DataFrame) -> list[dict[str, Any]]:
    """The ANOVAs beside the paper's; the paper prints no F where it found nothing significant."""
    paper = published("anova").set_index(["family", "metric"]).drop(columns=["df1", "df2"]).add_suffix("_paper")
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
    rows = published("weights").to_dict("records")
    for row in rows:
        mean, sd = (trials[f"{row['weight']}_{statistic}"] for statistic in ("mean", "sd"))
        row |= {"games": mean.count(), "our_mean": mean.mean(), "our_sd": sd.mean()}
    return rows


def _p(value: float) -> str:
    """A p as the paper prints it, without the zero before the point."""
    if pd.isna(value):
        return "–"
    return "<.001" if value < 0.001 else "1" if value >= 0.9995 else f"{value:.3f}"[1:]


@command("report")
def main(cfg: DictConfig) -> None:
    """Gather the runs, write their report, and say on the screen where it is."""
    runs = [cfg.runs] if isinstance(cfg.runs, str) else list(cfg.runs)
    folder = Path(cfg.out or HydraConfig.get().runtime.output_dir)
    try:
        files = found_below(runs, TRIALS)
        trials = merge(files)
        check_trials(trials)
        manifests = {str(file.parent): _manifest(file) for file in files}
    except ValueError as error:
        raise InputError(str(error)) from error
    manifest = next(iter(manifests.values())) if len(files) == 1 else {"runs": manifests}
    tests = write_report(trials, folder, manifest | {"trials_sha256": {str(file): sha256(file) for file in files}})
    print(screen_table(trials))
    counts = summary(compare_with_paper(tests, _withdrawn(manifest)))
    everything, others = counts.loc["all"], counts.loc["none"]
    print(f"\n{everything.replicated} of the paper's 38 findings replicate ({everything.tested} tested),", end=" ")
    print(f"{everything.reversed} reversed; {others.wrongly_significant} of its 63 non-findings are significant here")
    print(f"report: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
