"""The tables of a study for other programs: what their columns mean, and those beside `trials.csv`."""

import json
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from typing import Any, NamedTuple

import pandas as pd

from airhockey_marl.experiment.validation.tables import Column
from guidance.forces.condition_specs import ConditionSpec
from guidance.statistics.design import METRICS
from guidance.study.metrics import COUNTS

SHARE, RATING = Column(low=0.0, high=1.0, missing=True), Column(low=1.0, high=7.0, missing=True)
SIZE, NUMBER = Column(low=0.0, missing=True), Column(missing=True, optional=True)
COUNT = Column(low=0.0, whole=True, missing=True, optional=True)


class Variable(NamedTuple):
    """A column: what its cells must be, what they mean, and their unit ("" of texts, "1" of shares and numbers)."""

    column: Column
    meaning: str
    unit: str = "1"


WEIGHTS = {
    "w_unc_optimal": "weight of the force by the optimal action model's confidence (Eq. 5)",
    "w_unc_user": "weight of the force by the user model's confidence (Eq. 5)",
    "w_sim": "weight of the force by the similarity of both (Eq. 7)",
}
VARIABLES = {
    "user": Variable(Column(text=True), "label of the participant", ""),
    "condition": Variable(Column(text=True), "condition of the game", ""),
    "position": Variable(replace(COUNT, low=1.0), "place of the game in the participant's order, from 1"),
    "win_rate": Variable(SHARE, "rounds_won / (rounds_won + rounds_lost) of counts.csv"),
    "mean_smash_speed": Variable(SIZE, "mean speed of the user's puck as it crosses the half-way line", "m/s"),
    "defense_rate": Variable(SHARE, "shots_stopped / shots_faced of counts.csv"),
    "mean_disagreement": Variable(SIZE, "mean force against the motion of the hand; undefined without a force", "N"),
    **{
        name: Variable(RATING, f"rating of {name}", "points")
        for name, metric in METRICS.items()
        if metric.kind == "subjective"
    },
    "rounds": Variable(COUNT, "rounds of the game"),
    "duration_s": Variable(NUMBER, "time played, without the familiarization", "s"),
    **{
        f"{name}_{part}": Variable(NUMBER, f"{words} of the {meaning}, over the game")
        for name, meaning in WEIGHTS.items()
        for part, words in (("mean", "mean"), ("sd", "standard deviation"))
    },
    "seed": Variable(Column(whole=True), "from which all random numbers of the study follow"),
    "rounds_won": Variable(COUNT, "rounds that the participant won"),
    "rounds_lost": Variable(COUNT, "rounds that the opponent won"),
    "rounds_undecided": Variable(COUNT, "rounds that ended without a goal"),
    "shots_faced": Variable(COUNT, "shots at the participant's goal that were stopped or scored"),
    "shots_stopped": Variable(COUNT, "of these, those that the participant stopped"),
    "smashes": Variable(COUNT, "times that the user's puck crossed the half-way line, see mean_smash_speed"),
}
TRIAL_COLUMNS = {name: variable.column for name, variable in VARIABLES.items() if name not in COUNTS}
NUMBERS = [name for name in TRIAL_COLUMNS if name not in ("user", "condition", "seed")]


def tables_beside(
    trials: pd.DataFrame,
    counts: pd.DataFrame,
    conditions: Mapping[str, ConditionSpec],
    manifest: Mapping[str, Any],
) -> dict[str, str]:
    """The texts of the files beside `trials.csv`, by name.

    Args:
        trials: the columns of `trials.csv`.
        counts: `user`, `condition` and `guidance.study.metrics.COUNTS`.
        conditions: of the trials, by name.
        manifest: of the study, see `guidance.study.setup.manifest`.

    Returns:
        `trials_wide.csv`, a row per participant with a column `<metric>_<condition>` per number; `counts.csv`; and the
        codebooks `trials.json` and `counts.json`.
    """
    people = manifest.get("participants") == "people"
    extra = {entry["name"]: entry for entry in manifest.get("metrics", ())}
    facts = {key: manifest[key] for key in ("study_hash", "frozen", "seed", "versions") if key in manifest}
    config = manifest.get("config", {})
    study = {"participants": "people" if people else "simulated people", "n": trials["user"].nunique(), **facts}
    study |= {"protocol": config.get("study"), "withdrawn": [] if people else config.get("users", {}).get("withdrawn")}
    names = [name for name in (*NUMBERS, *extra) if name in trials]
    games = trials.set_index(["user", "condition"])
    wide = pd.concat(
        [games[name].unstack(sort=False)[list(conditions)].add_prefix(f"{name}_") for name in names], axis=1
    )

    def codebook(table: pd.DataFrame, row: str) -> str:
        columns = {name: _entry(name, table[name], conditions, extra, people) for name in table}
        return json.dumps({"study": study, "row": row, "columns": columns}, indent=2, default=str) + "\n"

    return {
        "trials_wide.csv": wide.to_csv(index_label="user"),
        "counts.csv": counts.to_csv(index=False),
        "trials.json": codebook(
            trials, "a game of a participant under a condition; trials_wide.csv has them as <column>_<condition>"
        ),
        "counts.json": codebook(counts, "a game of a participant under a condition"),
    }


def _entry(
    name: str,
    values: pd.Series,
    conditions: Mapping[str, ConditionSpec],
    extra: Mapping[str, Mapping[str, str]],
    people: bool,
) -> dict[str, Any]:
    """A column's entry in a codebook."""
    if name not in VARIABLES:
        entry = extra.get(name, {})
        return {"description": entry.get("label", name), "unit": entry.get("unit", ""), "type": "number"}
    column, meaning, unit = VARIABLES[name]
    if column is RATING and not people:
        meaning = f"PROXY of the {meaning}, computed from forces and intentions: nobody was asked"
    entry = {"description": meaning, "unit": unit}
    if column.is_text:
        levels = {c.name: f"({c.letter}) {c.label}" for c in conditions.values()} if name == "condition" else {}
        return entry | {"type": "text"} | ({"levels": levels} if levels else {})
    bounds = {"minimum": column.low, "maximum": column.high}
    entry |= {"type": "whole number" if column.whole else "number"}
    return (
        entry | {key: bound for key, bound in bounds.items() if isfinite(bound)} | {"missing": int(values.isna().sum())}
    )
