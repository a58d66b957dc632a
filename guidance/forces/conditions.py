"""The nine conditions of section 4.2 as compositions of the force equations.

`condition_specs` reads what a condition is; `build_condition` composes it of the frozen dataclasses below, and nothing
after that asks which condition it is. A guidance maps the game's state, the hand and the models' predictions to a
force; tensors have any leading batch dimensions, so one call serves all users of a condition.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from airhockey_marl.experiment.registry import as_mapping, construct
from guidance.forces.condition_specs import ADAPTED as ADAPTED_USER
from guidance.forces.condition_specs import GUIDANCES, ConditionSpec
from guidance.forces.equations import combine, similarity_weight, spring_force, uncertainty_weight

OPTIMAL, USER, ADAPTED = "optimal", "user", "adapted"  # the models: OAHG's, UPHG's without UA, UPHG's with UA


class Prediction(NamedTuple):
    """The output of a model at the looked-ahead state: mean and STD (..., 2) of the action.

    The mean is where the spring pulls the present hand to, see `guidance.forces.lookahead`: under the reading
    `consistent` it is less the way that the hand makes by itself meanwhile.
    """

    mean: Tensor
    std: Tensor


class GuidanceOutput(NamedTuple):
    """The force (..., 2) of a guidance in N, and the weights (...) that went into it, where it has them."""

    force: Tensor
    w_unc_optimal: Tensor | None = None
    w_unc_user: Tensor | None = None
    w_sim: Tensor | None = None


class Guidance(Protocol):
    """Anything that turns the game's state, the hand and the models' predictions into a force."""

    def models(self) -> frozenset[str]:
        """Names of the models whose predictions it reads."""
        ...

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        """The force.

        Args:
            state: (..., 12) the game as the user sees it, in m and m/s, see `airhockey_marl.envs.pettingzoo_env`.
            hand: (..., 2) u, where the hand is, in units of action.
            predictions: of each of `models`, by the look-ahead's reading: toward `mean` a spring pulls the hand `u`.
        """
        ...


@dataclass(frozen=True)
class Spring:
    """The spring of Eq. 4 at the hand.

    Attributes:
        stiffness: K, in N per m of hand travel.
        limit: the clip, in N.
        reach: m of hand travel per unit of action.
    """

    stiffness: float
    limit: float
    reach: float

    def __post_init__(self) -> None:
        for name in ("stiffness", "limit", "reach"):
            value = getattr(self, name)
            if not 0 <= value < float("inf") or (name == "reach" and value == 0):
                allowed = "above 0" if name == "reach" else "of at least 0"
                raise ValueError(f"guidance.spring.{name} = {value} must be a finite number {allowed}")

    def force(self, hand: Tensor, target: Tensor) -> Tensor:
        """Force (..., 2) in N from the hand (..., 2) toward the target (..., 2), both in units of action."""
        return spring_force(self.reach * hand, self.reach * target, self.stiffness, self.limit)


@dataclass(frozen=True)
class Thresholds:
    """T_low and T_high of uncertainty-based thresholding (UT, Eq. 5), on the squared norm of the STD."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 <= self.low < self.high:
            raise ValueError(f"guidance.thresholds: low = {self.low} must be at least 0 and below high = {self.high}")


@dataclass(frozen=True)
class GuidanceSettings:
    """What all conditions share: the spring, and the thresholds of UT by model (`conf/guidance`)."""

    spring: Spring
    thresholds: Mapping[str, Thresholds] = field(hash=False)

    @classmethod
    def from_config(cls, config: Any) -> "GuidanceSettings":
        """The settings of the configuration's `guidance`.

        Raises:
            ValueError: a number is out of range, or a setting is unknown or missing; names it.
        """
        place = "guidance.thresholds"
        thresholds = {name: construct(Thresholds, node, f"{place}.{name}") for name, node in config.thresholds.items()}
        for name in (OPTIMAL, USER):
            if name not in thresholds:
                raise ValueError(f"{place}.{name} is missing")
        return cls(construct(Spring, config.spring, "guidance.spring"), thresholds)


@dataclass(frozen=True)
class NoGuidance:
    """NHG: no force."""

    def models(self) -> frozenset[str]:
        return frozenset()

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        return GuidanceOutput(torch.zeros_like(hand))


@dataclass(frozen=True)
class SpringGuidance:
    """OAHG or UPHG: a spring toward one model's action (Eq. 4), weighed by its confidence with UT (Eq. 5).

    Attributes:
        model: `optimal` makes it OAHG; `user` and `adapted` make it UPHG, without and with UA.
        uncertainty: the thresholds of UT, or None for the vanilla guidance.
    """

    model: str
    spring: Spring
    uncertainty: Thresholds | None = None

    def __post_init__(self) -> None:
        if self.model not in (OPTIMAL, USER, ADAPTED):
            raise ValueError(f"guidance.model = {self.model!r} must be '{OPTIMAL}', '{USER}' or '{ADAPTED}'")

    def models(self) -> frozenset[str]:
        return frozenset({self.model})

    def pull(self, hand: Tensor, prediction: Prediction) -> tuple[Tensor, Tensor | None]:
        """The force (..., 2) toward a prediction, whichever model it is from, and W_unc (...), or None without UT."""
        force = self.spring.force(hand, prediction.mean)
        if self.uncertainty is None:
            return force, None
        weight = uncertainty_weight(prediction.std, self.uncertainty.low, self.uncertainty.high)
        return weight.unsqueeze(-1) * force, weight

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        force, weight = self.pull(hand, predictions[self.model])
        if self.model == OPTIMAL:
            return GuidanceOutput(force, w_unc_optimal=weight)
        return GuidanceOutput(force, w_unc_user=weight)


@dataclass(frozen=True)
class CombinedGuidance:
    """CombHG: the mean of OAHG's and UPHG's forces (Eq. 6), weighed by their agreement with SC (Eq. 7)."""

    optimal: SpringGuidance
    user: SpringGuidance
    similarity: bool

    def models(self) -> frozenset[str]:
        return self.optimal.models() | self.user.models()

    def join(self, optimal: Tensor, user: Tensor) -> tuple[Tensor, Tensor | None]:
        """The combination (..., 2) of the two forces, and W_sim (...), or None without SC."""
        force = combine(optimal, user)
        if not self.similarity:
            return force, None
        weight = similarity_weight(optimal, user)
        return weight.unsqueeze(-1) * force, weight

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        optimal, user = self.optimal(state, hand, predictions), self.user(state, hand, predictions)
        force, weight = self.join(optimal.force, user.force)
        return GuidanceOutput(force, optimal.w_unc_optimal, user.w_unc_user, weight)


@dataclass(frozen=True)
class Condition:
    """A condition that can be played: what it is, and its guidance."""

    spec: ConditionSpec
    guidance: Guidance

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def letter(self) -> str:
        return self.spec.letter

    @property
    def label(self) -> str:
        return self.spec.label


def build_condition(spec: ConditionSpec, settings: GuidanceSettings) -> Condition:
    """Compose the guidance of a condition.

    Raises:
        ValueError: it names a guidance that is not registered, or settings that this one does not take.
    """
    if spec.guidance is not None:
        node = {"name": spec.guidance, **as_mapping(spec.settings, "condition.settings")}
        return Condition(spec, GUIDANCES.build(node, "condition.guidance", settings))

    def toward(model: str, thresholds: str) -> SpringGuidance:
        return SpringGuidance(model, settings.spring, settings.thresholds[thresholds] if spec.ut else None)

    optimal = toward(OPTIMAL, OPTIMAL) if spec.optimal else None
    user = None if spec.user is None else toward(ADAPTED if spec.user == ADAPTED_USER else USER, USER)
    if optimal is not None and user is not None:
        return Condition(spec, CombinedGuidance(optimal, user, spec.sc))
    return Condition(spec, optimal or user or NoGuidance())
