"""The distribution of every parameter of a person. The numbers, their units and sources are in conf/users/default.yaml.

A parameter theta of person k is log-normal and may depend on skill ~ N(0, 1):

    theta_k = median * exp(log_sd * (on_skill * skill_k + sqrt(1 - on_skill^2) * eps_k)), clipped to [low, high].

Playstyle traits are Beta distributed around the mean of an archetype and do not depend on skill. What is a plain number
is the same for everybody.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from airhockey_marl.cli import CONF
from guidance.users.laws import LogNormal, Positive, ScaledBeta, Share, Signed, checked, is_number

TRAITS = ("aggression", "press", "bank", "shadow", "power", "guard_depth")
# What an intention is worth in a situation: a constant, and more per unit of four traits and of an open goal.
WORTHS = (
    "away_wait",
    "away_shadow",
    "away_press",
    "behind_recover",
    "behind_block",
    "near_control",
    "near_control_at_rest",
    "near_smash",
    "near_bank",
    "near_block",
    "near_shadow",
)
WORTH_TERMS = 6


@dataclass(frozen=True)
class Population:
    """The distribution of people; the schema of `population` in `conf/users/*.yaml`, where each field is explained.

    Raises:
        ValueError: a distribution is out of range; names the field, the value and what is allowed.
    """

    # seeing
    sight_delay: LogNormal
    speed_noise: LogNormal
    heading_noise: LogNormal
    bounce_noise: LogNormal
    bounce_insight: Signed
    noise_memory: Share
    degrees_per_metre: Positive
    weber_floor: Positive
    # judging the situation
    still: float
    soon: float
    leaving: float
    out_of_reach: float
    kick: Positive
    leap: Positive
    # deciding
    decision_floor: float
    decision_delay: LogNormal
    delay_noise: float
    choice_temperature: LogNormal
    dwell: LogNormal
    idle: float
    staying: float
    advice: float
    strike_over: float
    worth: Mapping[str, Sequence[float]]
    # placing oneself
    guard_nearest: Positive
    guard_range: float
    stray: float
    follow: Share
    press_at: Positive
    goal_margin: float
    clearance: float
    # striking
    smash_slowest: Positive
    smash_range: float
    control_speed: Positive
    fastest_strike: Positive
    swing: Positive
    at_once: Positive
    soonest_strike: Positive
    soonest_correction: Positive
    strike_slack: float
    effort_to_begin: Positive
    effort_to_go_on: Positive
    aim_spread: float
    aim_past: float
    aim_widest: Share
    # moving
    plan_period: LogNormal
    preferred_acceleration: LogNormal
    quickest_move: Positive
    slowest_move: Positive
    timing_noise: LogNormal
    noise_along: LogNormal
    noise_across: LogNormal
    noise_correlation: Share
    tremor: float
    noise_held: Positive
    carry_through: float
    slow_down: Positive
    # the arm
    muscle_lag: LogNormal
    arm_mass: LogNormal
    device_mass: float
    device_damping: float
    stiffness: LogNormal
    stiffest: Positive
    damping_time: float
    # answering a force
    touch_delay: LogNormal
    proprioceptive_delay: float
    felt_from: float
    aim_size: Positive
    full_conflict: Positive
    stiffening_shape: Positive
    stiffening_scale: float
    stiffening_lag: Positive
    resistance: ScaledBeta
    slacking: ScaledBeta
    sharing: ScaledBeta
    sharing_range: Positive
    believed_stiffness: Positive
    believed_ahead: Positive
    trust_memory: Positive
    trust_at_first: Share
    # rating
    hindsight_after: Positive
    stiffening_cost: float
    surprise_memory: Positive
    rating_gain_log_sd: float
    rating_bias_sd: float
    rating_noise: float
    # style and skill
    skill_mean: Signed
    skill_sd: float
    trait_concentration: Positive
    archetypes: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, checked(item.type, item.name, getattr(self, item.name)))
        for name, means in self.archetypes.items():
            if len(means) != len(TRAITS) or not all(is_number(mean) and 0 < mean < 1 for mean in means):
                raise ValueError(f"users.archetypes.{name} = {means} must be {len(TRAITS)} means between 0 and 1")
        if not self.archetypes:
            raise ValueError("users.archetypes = {} must hold at least one archetype")
        for name in sorted(set(self.worth) ^ set(WORTHS)):
            raise ValueError(f"users.worth.{name} {'must be given' if name in WORTHS else 'is worth of nothing'}")
        for name, terms in self.worth.items():
            if len(terms) != WORTH_TERMS or not all(map(is_number, terms)):
                raise ValueError(f"users.worth.{name} = {terms} must be {WORTH_TERMS} numbers")
        if not self.quickest_move <= self.slowest_move:
            raise ValueError(f"users.quickest_move = {self.quickest_move} must be at most slowest_move")

    @classmethod
    def usual(cls, **changes: Any) -> "Population":
        """The population of `conf/users/default.yaml`, but for `changes`.

        Raises:
            ValueError: a change is out of range.
        """
        return cls(**{**_usual(), **changes})


@cache
def _usual() -> dict[str, Any]:
    conf = OmegaConf.to_container(OmegaConf.load(CONF / "users" / "default.yaml").population)
    return {name: value for name, value in conf.items() if not name.startswith("_")}


# One record a person, SI units. Where a field has the name of one of `Population`, see there.
PERSON = np.dtype(
    [("archetype", np.int64), ("skill", np.float64), ("foreseen_bounces", np.int64), ("stiffening", np.float64)]
    + [(item.name, np.float64) for item in fields(Population) if item.name not in ("worth", "archetypes")]
    + [(name, np.float64) for name in ("rating_gain", "rating_bias", *TRAITS)]
    + [("worth", np.float64, (len(WORTHS), WORTH_TERMS))]
)
