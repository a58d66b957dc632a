"""Guidances that are not the paper's: each is registered by its name, which a condition's yaml gives as `guidance`.

A guidance of your own is such a class in a module of yours, see "Design a guidance" in conf/README.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from guidance.forces.condition_specs import GUIDANCES
from guidance.forces.conditions import (
    ADAPTED,
    OPTIMAL,
    USER,
    GuidanceOutput,
    GuidanceSettings,
    Prediction,
    SpringGuidance,
)

PUCK_VX = 10  # of the state: the puck's velocity along the table, below 0 toward one's own goal


@GUIDANCES.register("product")
@dataclass(frozen=True)
class ProductGuidance:
    """One spring toward the product of the two models' Gaussians, to which the more precise one contributes more.

    So one would combine two independent measurements of the same action; per axis,
    mean = (mean_o / std_o^2 + mean_u / std_u^2) / (1 / std_o^2 + 1 / std_u^2).
    """

    settings: GuidanceSettings

    def models(self) -> frozenset[str]:
        return frozenset({OPTIMAL, ADAPTED})

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        optimal, user = predictions[OPTIMAL], predictions[ADAPTED]
        precision, other = optimal.std.square().reciprocal(), user.std.square().reciprocal()
        mean = (optimal.mean * precision + user.mean * other) / (precision + other)
        return GuidanceOutput(self.settings.spring.force(hand, mean))


@GUIDANCES.register("blended")
@dataclass(frozen=True)
class BlendedGuidance:
    """The two forces in the proportion of their models' confidence.

    CombHG with UT halves the force of the confident model when the other is not; here the weights W_unc (Eq. 5) say
    how much of the force is whose, and the larger of the two how strong it is:
    F = max(W_o, W_u) (W_o F_o + W_u F_u) / (W_o + W_u).
    """

    settings: GuidanceSettings

    def models(self) -> frozenset[str]:
        return frozenset({OPTIMAL, ADAPTED})

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        spring, thresholds = self.settings.spring, self.settings.thresholds
        # each force is weighed already
        optimal, w_optimal = SpringGuidance(OPTIMAL, spring, thresholds[OPTIMAL]).pull(hand, predictions[OPTIMAL])
        user, w_user = SpringGuidance(ADAPTED, spring, thresholds[USER]).pull(hand, predictions[ADAPTED])
        assert w_optimal is not None and w_user is not None  # both have thresholds
        strength = torch.maximum(w_optimal, w_user) / (w_optimal + w_user).clamp(min=1e-12)
        return GuidanceOutput(strength.unsqueeze(-1) * (optimal + user), w_optimal, w_user)


@GUIDANCES.register("approach_gated")
@dataclass(frozen=True)
class ApproachGatedGuidance:
    """OAHG only while the puck comes toward one's own goal: help in defense, freedom in attack.

    Attributes:
        slowest: m/s toward one's own goal; a slower puck is not coming.
    """

    settings: GuidanceSettings
    slowest: float = 0.0

    def models(self) -> frozenset[str]:
        return frozenset({OPTIMAL})

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        force = self.settings.spring.force(hand, predictions[OPTIMAL].mean)
        coming = state[..., PUCK_VX] < -self.slowest
        return GuidanceOutput(force * coming.unsqueeze(-1))
