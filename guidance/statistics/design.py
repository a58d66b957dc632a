"""The design of the user study: conditions, metrics, and the families of conditions that are compared."""

import re
from collections.abc import Iterable, Mapping
from string import ascii_lowercase
from typing import Any, NamedTuple

import pandas as pd

from guidance.forces.condition_specs import OTHER, paper_specs

ALPHA = 0.05
FEWEST_PARTICIPANTS = 3  # two participants leave a single degree of freedom for a difference
BEYOND = OTHER  # the type of conditions that are not the paper's, and the family that compares them with the types


class Condition(NamedTuple):
    """A condition as reports show it.

    Attributes:
        letter: a to i for the paper's nine (section 4.2).
        label: its name, such as "OAHG (UT)".
        guidance: its type of guidance, NHG, OAHG, UPHG, CombHG or `BEYOND`.
        color: of its bar, as #rrggbb; None for that of its type.
        against: letters of conditions that it is compared with, beside the types.
    """

    letter: str
    label: str
    guidance: str
    color: str | None = None
    against: tuple[str, ...] = ()


class Metric(NamedTuple):
    """A metric of the user study (section 4.3)."""

    label: str
    kind: str  # objective | subjective
    unit: str


CONDITIONS = {spec.name: Condition(spec.letter, spec.label, spec.type) for spec in paper_specs().values()}
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


def declared_conditions(entries: Iterable[Mapping[str, Any]]) -> dict[str, Condition]:
    """The conditions beyond the paper's by name, from the `conditions` of manifests.

    Raises:
        ValueError: a letter, label, color or `against` is not valid; names the condition and the key.
    """
    conditions = {}
    for entry in entries:
        name, letter, label = (entry.get(key) for key in ("name", "letter", "label"))
        if name in CONDITIONS:
            continue
        color, against = entry.get("color"), entry.get("against") or ()
        letters = tuple(ascii_lowercase)
        valid = {
            "name": isinstance(name, str) and name != "",
            "letter": letter in letters,
            "label": isinstance(label, str) and label != "",
            "color": color is None or (isinstance(color, str) and re.fullmatch("#[0-9a-fA-F]{6}", color) is not None),
            "against": isinstance(against, list | tuple) and all(other in letters for other in against),
        }
        if wrong := [key for key, is_valid in valid.items() if not is_valid]:
            raise ValueError(f"manifest: conditions: {name}: {wrong[0]} = {entry.get(wrong[0])!r} is not valid")
        conditions[name] = Condition(letter, label, BEYOND, color, tuple(against))
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


def conditions_of(trials: pd.DataFrame, declared: Mapping[str, Condition] | None = None) -> dict[str, Condition]:
    """The conditions in the trials by name: the paper's in its order, then any others by their letters.

    Args:
        declared: conditions beyond the paper's, see `declared_conditions`. One that is not among them is labeled with
            its name; it gets the first free letter from j on, as does one whose letter is another condition's.
    """
    present, declared = list(dict.fromkeys(trials["condition"])), declared or {}
    conditions = {name: condition for name, condition in CONDITIONS.items() if name in present}
    others = [name for name in present if name not in CONDITIONS]
    taken = {condition.letter for condition in CONDITIONS.values()}
    if len(others) > len(ascii_lowercase) - len(taken):
        raise ValueError(
            f"{len(others)} conditions that are not the paper's, must be at most {len(ascii_lowercase) - len(taken)}"
        )
    own: dict[str, Condition] = {}
    for name in sorted(others, key=lambda name: name not in declared):  # the declared ones keep their letters
        condition = declared.get(name, Condition("", name, BEYOND))
        if not condition.letter or condition.letter in taken:
            condition = condition._replace(letter=next(c for c in ascii_lowercase if c not in taken))
        taken.add(condition.letter)
        own[name] = condition
    return conditions | dict(sorted(own.items(), key=lambda item: item[1].letter))
