"""The nine conditions of section 4.2 as compositions of the force equations.

A condition is a tree of the frozen dataclasses below, written down in `conf/condition/<name>.yaml`: nothing here asks
which condition it is. A guidance maps what the hand does and what the models say to a force; it is given tensors with
any leading batch dimensions, so one call serves all users of a condition.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from string import ascii_lowercase
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from guidance.forces.equations import combine, similarity_weight, spring_force, uncertainty_weight

OPTIMAL, USER, ADAPTED = "optimal", "user", "adapted"  # the models: OAHG's, UPHG's without UA, UPHG's with UA


class Prediction(NamedTuple):
    """What a model says at the looked-ahead state: mean and STD (..., 2) of the action."""

    mean: Tensor
    std: Tensor


class GuidanceOutput(NamedTuple):
    """A guidance's answer: the force (..., 2) in N, and the weights (...) that went into it, where it has them."""

    force: Tensor
    w_unc_optimal: Tensor | None = None
    w_unc_user: Tensor | None = None
    w_sim: Tensor | None = None


class Guidance(Protocol):
    """Anything that turns the user's action (..., 2) and the models' targets into a force."""

    def models(self) -> frozenset[str]:
        """Names of the models whose targets it reads."""
        ...

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput: ...


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

    def force(self, action: Tensor, target: Tensor) -> Tensor:
        """Force (..., 2) in N from the action toward the target (..., 2)."""
        for name, value in (("action", action), ("target", target)):
            if not isinstance(value, Tensor):
                raise ValueError(f"{name}: {type(value).__name__}, must be a tensor")
        return spring_force(self.reach * action, self.reach * target, self.stiffness, self.limit)


@dataclass(frozen=True)
class Thresholds:
    """T_low and T_high of uncertainty-based thresholding (UT, Eq. 5), on the squared norm of the STD."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 <= self.low < self.high:
            raise ValueError(f"guidance.thresholds: low = {self.low} must be at least 0 and below high = {self.high}")


@dataclass(frozen=True)
class NoGuidance:
    """NHG: no force."""

    def models(self) -> frozenset[str]:
        return frozenset()

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput:
        return GuidanceOutput(torch.zeros_like(action))


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

    def pull(self, action: Tensor, target: Prediction) -> tuple[Tensor, Tensor | None]:
        """The force (..., 2) toward a target, whichever model it is from, and W_unc (...), or None without UT."""
        force = self.spring.force(action, target.mean)
        if self.uncertainty is None:
            return force, None
        weight = uncertainty_weight(target.std, self.uncertainty.low, self.uncertainty.high)
        return weight.unsqueeze(-1) * force, weight

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput:
        force, weight = self.pull(action, targets[self.model])
        return (
            GuidanceOutput(force, w_unc_optimal=weight)
            if self.model == OPTIMAL
            else GuidanceOutput(force, w_unc_user=weight)
        )


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

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput:
        optimal, user = self.optimal(action, targets), self.user(action, targets)
        force, weight = self.join(optimal.force, user.force)
        return GuidanceOutput(force, optimal.w_unc_optimal, user.w_unc_user, weight)


@dataclass(frozen=True)
class ProductGuidance:
    """Not the paper's: one spring toward the product of the models' Gaussians, the more precise of which says more.

    So one would combine two independent measurements of the same action; per axis,
    mean = (mean_o / std_o^2 + mean_u / std_u^2) / (1 / std_o^2 + 1 / std_u^2).
    """

    optimal: str
    user: str
    spring: Spring

    def models(self) -> frozenset[str]:
        return frozenset({self.optimal, self.user})

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput:
        optimal, user = targets[self.optimal], targets[self.user]
        precision, other = optimal.std.square().reciprocal(), user.std.square().reciprocal()
        mean = (optimal.mean * precision + user.mean * other) / (precision + other)
        return GuidanceOutput(self.spring.force(action, mean))


@dataclass(frozen=True)
class BlendedGuidance:
    """Not the paper's: the two forces in the proportion of their models' confidence.

    CombHG with UT halves the force of the one that knows when the other does not; here the weights W_unc (Eq. 5) say
    how much of the force is whose, and the larger of the two how strong it is:
    F = max(W_o, W_u) (W_o F_o + W_u F_u) / (W_o + W_u).
    """

    optimal: SpringGuidance
    user: SpringGuidance

    def __post_init__(self) -> None:
        for name in ("optimal", "user"):
            if getattr(self, name).uncertainty is None:
                raise ValueError(f"guidance.{name}.uncertainty must be thresholds: it is blended by confidence")

    def models(self) -> frozenset[str]:
        return self.optimal.models() | self.user.models()

    def __call__(self, action: Tensor, targets: Mapping[str, Prediction]) -> GuidanceOutput:
        (optimal, w_optimal), (user, w_user) = (
            part.pull(action, targets[part.model]) for part in (self.optimal, self.user)
        )  # each force is weighed already
        strength = torch.maximum(w_optimal, w_user) / (w_optimal + w_user).clamp(min=1e-12)
        return GuidanceOutput(strength.unsqueeze(-1) * (optimal + user), w_optimal, w_user)


@dataclass(frozen=True)
class Condition:
    """One of the nine: the paper's letter and name, and its guidance. Others have the letters from j on."""

    name: str
    letter: str
    label: str
    guidance: Guidance

    def __post_init__(self) -> None:
        if self.letter not in tuple(ascii_lowercase):
            raise ValueError(f"condition.letter = {self.letter} must be one of a to z")
