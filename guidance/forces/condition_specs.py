"""Conditions as they are written down: the nine of section 4.2 in `conf/condition`, and any others.

A condition of the paper is a row of its Table 1: whether it has the optimal action model (OAHG) and which user model
(UPHG), and which of UT, UA and SC it uses. Any other condition names a registered guidance instead. This module only
reads; `guidance.forces.conditions` makes forces of it.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import yaml

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.registry import Registry, construct, did_you_mean

PAPER_LETTERS = "abcdefghi"
GENERAL, ADAPTED = "general", "adapted"  # user models: of people in general, and of this user (UA)
TYPES = ("NHG", "OAHG", "UPHG", "CombHG")
OTHER = "beyond"  # the type of a condition that is not the paper's

GUIDANCES: Registry[Callable] = Registry(
    "guidance", {name: "guidance.forces.beyond" for name in ("product", "blended", "approach_gated")}
)
CONDITIONS: Registry["ConditionSpec"] = Registry("condition", group="condition")  # of plug-ins


@dataclass(frozen=True)
class ConditionSpec:
    """A condition as its yaml has it.

    Attributes:
        name: of the yaml, and of the rows of `trials.csv`.
        letter: a to i for the paper's, j to z for others; the random numbers of its games follow from it.
        label: what reports and windows show.
        optimal: it uses the optimal action model (OAHG).
        user: the user model that it uses (UPHG), `general` or `adapted` (UA); None for none.
        ut: forces are weighed by the model's confidence (UT, Eq. 5).
        sc: the combination is weighed by the agreement of the two forces (SC, Eq. 7).
        guidance: a registered guidance, in place of the five keys above.
        settings: of that guidance.
        color: of its bar in figures, as #rrggbb; None for the one of its type.
        against: letters of the conditions that it is compared with, beside the four types of the paper.
    """

    name: str
    letter: str
    label: str
    optimal: bool = False
    user: str | None = None
    ut: bool = False
    sc: bool = False
    guidance: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    color: str | None = None
    against: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ValueError(f"condition.name = {self.name!r} must be a word of letters, digits and _")
        if self.letter not in tuple(ascii_lowercase):
            raise ValueError(f"condition.letter = {self.letter!r} must be one of a to z")
        if not isinstance(self.label, str) or not self.label:
            raise ValueError(f"condition.label = {self.label!r} must be a text")
        for name in ("optimal", "ut", "sc"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"condition.{name} = {getattr(self, name)!r} must be true or false")
        if self.user not in (None, GENERAL, ADAPTED):
            raise ValueError(f"condition.user = {self.user!r} must be null, {GENERAL} or {ADAPTED}")
        if self.sc and not (self.optimal and self.user):
            raise ValueError("condition.sc = true needs optimal: true and a user model: two forces to compare")
        if self.guidance is not None and (self.optimal or self.user or self.ut or self.sc):
            raise ValueError(f"condition.guidance = {self.guidance} stands in place of optimal, user, ut and sc")
        if self.guidance is not None and self.letter in PAPER_LETTERS:
            raise ValueError(f"condition.letter = {self.letter} is of the paper; others have a letter from j to z")
        if isinstance(self.against, str) or not all(letter in tuple(ascii_lowercase) for letter in self.against):
            raise ValueError(f"condition.against = {self.against!r} must be a list of letters")
        object.__setattr__(self, "against", tuple(self.against))

    @property
    def type(self) -> str:
        """One of `TYPES`, or `OTHER`."""
        if self.letter not in PAPER_LETTERS:
            return OTHER
        return TYPES[self.optimal + 2 * (self.user is not None)]


def register_condition(
    name: str, letter: str, label: str, color: str | None = None, against: Iterable[str] = ()
) -> Callable[[Callable], Callable]:
    """A decorator for a guidance, that registers it and a condition of the same name which uses it.

    The guidance is a class or function that is called with a `GuidanceSettings`, see `guidance.forces.conditions`.
    """

    def add(factory: Callable) -> Callable:
        CONDITIONS.register(name)(
            ConditionSpec(name, letter, label, guidance=name, color=color, against=tuple(against))
        )
        return GUIDANCES.register(name)(factory)

    return add


def read_spec(path: Path) -> ConditionSpec:
    """Read a condition's yaml.

    Raises:
        ValueError: it is no yaml, or no condition; names the file, the key and what is allowed.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return construct(ConditionSpec, content, "condition")
    except (yaml.YAMLError, OSError, ValueError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


@cache
def paper_specs() -> Mapping[str, ConditionSpec]:
    """The paper's nine by name, in the order of their letters.

    Raises:
        ValueError: one is not valid, or one of the nine is not there.
    """
    specs, errors = [], []
    for path in sorted((CONF / "condition").glob("*.yaml")):
        try:
            specs.append(read_spec(path))
        except ValueError as error:  # it matters only if it is one of the nine
            errors.append(str(error))
    specs = sorted((spec for spec in specs if spec.letter in PAPER_LETTERS), key=lambda spec: spec.letter)
    if (letters := "".join(spec.letter for spec in specs)) != PAPER_LETTERS:
        reason = "; ".join(errors) or f"{CONF / 'condition'} has the letters {letters}"
        raise ValueError(f"{reason}; there must be one condition for each of the letters a to i")
    return {spec.name: spec for spec in specs}


def other_specs(warn: Callable[[str], None]) -> Mapping[str, ConditionSpec]:
    """The conditions that are not the paper's by name, of `conf/condition/**` and of plug-ins, by their letters.

    Args:
        warn: is told of a file that is not valid, which is left out.
    """
    specs = list(CONDITIONS.values())
    for path in sorted((CONF / "condition").glob("**/*.yaml")):
        try:
            specs.append(read_spec(path))
        except ValueError as error:
            warn(f"left out: {error}")
    others = sorted((spec for spec in specs if spec.letter not in PAPER_LETTERS), key=lambda spec: spec.letter)
    return {spec.name: spec for spec in others}


def select_specs(condition: Any, beyond: Any, warn: Callable[[str], None]) -> list[ConditionSpec]:
    """The conditions that a configuration asks for, in the order of their letters.

    Args:
        condition: one, as its yaml has it; None for the paper's nine.
        beyond: beside the nine, the names of others; true for all of them.
        warn: see `other_specs`.

    Raises:
        ValueError: one is not valid or unknown, or two have the same letter.
    """
    if condition is not None:
        return [construct(ConditionSpec, condition, "condition")]
    specs = list(paper_specs().values())
    if beyond:
        others = other_specs(warn)
        names = list(others) if beyond is True else [beyond] if isinstance(beyond, str) else list(beyond)
        for name in names:
            if name not in others:
                raise ValueError(f"beyond: {name!r} must be one of {', '.join(others)}{did_you_mean(name, others)}")
        specs += [spec for name, spec in others.items() if name in names]
    taken: dict[str, str] = {}
    for spec in specs:
        if spec.letter in taken:
            raise ValueError(f"condition.letter = {spec.letter} is that of {taken[spec.letter]} and of {spec.name}")
        taken[spec.letter] = spec.name
    return specs
