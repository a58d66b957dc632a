"""The design of the user study: conditions, metrics, and the families of conditions that are compared."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from string import ascii_lowercase
from typing import Any, NamedTuple

import pandas as pd

from guidance.forces.condition_specs import OTHER, PAPER_LETTERS, ConditionSpec, paper_specs

ALPHA = 0.05
FEWEST_PARTICIPANTS = 3  # two participants leave a single degree of freedom for a difference
BEYOND = OTHER  # the type of conditions that are not the paper's, and the family that compares them with the types


class Metric(NamedTuple):
    """A metric of the user study (section 4.3)."""

    label: str
    kind: str  # objective | subjective
    unit: str


CONDITIONS = dict(paper_specs())
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


def declared_conditions(entries: Iterable[Mapping[str, Any]]) -> dict[str, ConditionSpec]:
    """The conditions beyond the paper's by name, from the `conditions` of manifests.

    Raises:
        ValueError: a letter, label, color or `against` is not valid; names the key.
    """
    conditions = {}
    for entry in entries:
        if entry.get("name") in CONDITIONS:
            continue
        color = entry.get("color")
        try:
            keys = {key: entry.get(key) for key in ("name", "letter", "label")}
            conditions[entry.get("name")] = ConditionSpec(**keys, color=color, against=entry.get("against") or ())
        except (TypeError, ValueError) as error:
            raise ValueError(f"manifest: conditions: {error}") from error
        if color is not None and not (isinstance(color, str) and re.fullmatch("#[0-9a-fA-F]{6}", color)):
            raise ValueError(f"manifest: conditions: {entry['name']}: color = {color!r} is not valid")
    return conditions


def declared_metrics(entries: Iterable[Mapping[str, Any]]) -> dict[str, Metric]:
    """The metrics beside the paper's eight by name, from the `metrics` of manifests.

    Raises:
        ValueError: a name, label or unit is not a text; names it.
    """
    metrics = {}
    for entry in entries:
        if wrong := [key for key in ("name", "label", "unit") if not isinstance(entry.get(key), str)]:
            raise ValueError(f"manifest: metrics: {wrong[0]} = {entry.get(wrong[0])!r} must be a text")
        metrics[entry["name"]] = Metric(entry["label"], "objective", entry["unit"])
    return metrics


def conditions_of(
    trials: pd.DataFrame, declared: Mapping[str, ConditionSpec] | None = None
) -> dict[str, ConditionSpec]:
    """The conditions in the trials by name: the paper's in its order, then any others by their letters.

    Args:
        declared: conditions beyond the paper's, see `declared_conditions`. One that is not among them is labeled with
            its name; it gets the first free letter from j on, as does one whose letter is another condition's.
    """
    names, declared = list(dict.fromkeys(trials["condition"])), declared or {}
    others = [name for name in names if name not in CONDITIONS]
    free = [letter for letter in ascii_lowercase if letter not in PAPER_LETTERS]
    if len(others) > len(free):
        raise ValueError(f"{len(others)} conditions that are not the paper's, must be at most {len(free)}")
    own = []
    for name in sorted(others, key=lambda name: name not in declared):  # the declared ones keep their letters
        spec = declared.get(name) or ConditionSpec(name, free[0], label=name)
        own.append(spec if spec.letter in free else replace(spec, letter=free[0]))
        free.remove(own[-1].letter)
    own.sort(key=lambda spec: spec.letter)
    return {name: spec for name, spec in CONDITIONS.items() if name in names} | {spec.name: spec for spec in own}
