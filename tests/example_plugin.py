"""A plug-in, as somebody else would write it: one of each kind."""

from dataclasses import dataclass

import numpy as np
import torch

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.league.opponent_sampling import OPPONENT_SAMPLERS
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS, ScriptedPlayer
from guidance.forces.condition_specs import register_condition
from guidance.forces.conditions import OPTIMAL, GuidanceOutput
from guidance.haptics.devices.pointer import Mouse
from guidance.haptics.open_device import DEVICES, OpenDevice
from guidance.haptics.servo import InProcessServo
from guidance.study.metrics import EXTRA_METRICS


@register_condition("half", letter="m", label="OAHG (half as strong)", color="#8855AA", against=["b"])
class HalfGuidance:
    def __init__(self, settings):
        self.spring = settings.spring

    def models(self):
        return frozenset({OPTIMAL})

    def __call__(self, state, hand, predictions):
        return GuidanceOutput(0.5 * self.spring.force(hand, predictions[OPTIMAL].mean))


@OPPONENT_SAMPLERS.register("oldest")
@dataclass(frozen=True)
class Oldest:
    """Always generation 0, or the last scripted player."""

    scripted: bool = False

    def probabilities(self, statistics):
        return np.eye(len(statistics.win_rates))[-1 if self.scripted else 0]


def _stay(observation, actions, table):
    actions[:] = (-0.9, 0.0)


SCRIPTED_PLAYERS.register("wall")(ScriptedPlayer(_stay, 0.02))


@ALGORITHMS.register("hill_climbing")
@dataclass(frozen=True)
class HillClimbing:
    """Random steps, kept if the batch after them brought more goals."""

    step: float = 0.02

    def learner(self, policy, gamma):
        return HillClimber(self, policy)


class HillClimber:
    def __init__(self, settings, policy):
        self.step, self.policy, self.best = settings.step, policy, -float("inf")

    def update(self, batch):
        goals = batch["next", "reward"].sum().item()
        self.best = max(self.best, goals)
        with torch.no_grad():
            for parameter in self.policy.parameters():
                parameter += self.step * torch.randn_like(parameter)
        return {"goals": goals, "std": 0.5}

    def modules(self):
        return {}


@EXTRA_METRICS.register("hand_path")
class HandPath:
    """Distance that the hand travels, in units of action per second of play."""

    label, unit = "Hand path", "1/s"

    def __init__(self, games, table):
        self.distance, self.ticks, self.tick = np.zeros(games), np.zeros(games), table.tick

    def add(self, step):
        moved = np.linalg.norm(step.action - step.before, axis=-1)
        self.distance[step.games] += moved[step.games]
        self.ticks[step.games] += 1

    def values(self):
        return self.distance / (self.ticks * self.tick)


@DEVICES.register("pen")
@dataclass(frozen=True)
class PenConfig:
    """A pen on a tablet, which is not there: the hand rests at the center.

    Attributes:
        max_speed: m/s.
    """

    max_speed: float = 1.0

    def open(self, limits, person):
        return OpenDevice(InProcessServo(Mouse(max_speed=self.max_speed), limits))
