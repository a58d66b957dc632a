"""A row per tick of one person's game: what they saw, what the models said, how they were pushed, what they did.

Films are drawn from such a table, replays are played from it, and user adaptation learns from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from guidance.conditions import ADAPTED, OPTIMAL, USER, Condition, Guidance, Guided, Target
from guidance.games import Tick
from guidance.guide import Guide
from guidance.models import Models
from guidance.users.arm import HAND_REACH

STATE = [f"{body}_{part}" for body in ("own", "other", "puck") for part in ("x", "y", "vx", "vy")]
ACTION = ["action_x", "action_y"]
COLUMNS = MappingProxyType(
    {
        "time_s": "time at the end of the tick since the game, or its familiarisation, began, in s",
        "scored": "1 in the game itself, 0 in the familiarisation before it",
        "round": "number of the round, from 1",
        "won": "rounds that the person has won, with this tick",
        "lost": "rounds that the opponent has won, with this tick",
        "goal": "1 if the person scored in this tick, -1 if the opponent did, else 0",
        "hand_x": "where the hand was, from the centre of its workspace toward the opponent, in m",
        "hand_y": "where the hand was, to the left, in m",
        **{name: "own paddle, other paddle, puck, in m and m/s from the centre of the table" for name in STATE},
        "optimal_x": "what the optimal action model says of the looked-ahead state: mean, in units of action",
        "optimal_y": "see optimal_x",
        "optimal_std_x": "its STD",
        "optimal_std_y": "its STD",
        "predicted_x": "what the user model says of it, the person's own where there is one: mean",
        "predicted_y": "see predicted_x",
        "predicted_std_x": "its STD",
        "predicted_std_y": "its STD",
        "w_unc_optimal": "W_unc of the optimal action model (Eq. 5); not a number where the guidance has none",
        "w_unc_predicted": "W_unc of the user model (Eq. 5)",
        "w_sim": "W_sim (Eq. 7)",
        "force_x": "the guidance's force on the hand, held for the tick, in N",
        "force_y": "see force_x",
        "action_x": "where the hand was at the end of the tick, over its reach: the action",
        "action_y": "see action_x",
    }
)
"""What the columns mean; all but those about the goal and the action are of the beginning of the tick."""


@dataclass
class Overheard:
    """A guidance whose targets can be looked at: it keeps the last ones, and asks models that it may not need."""

    guidance: Guidance
    asked: frozenset[str]
    targets: Mapping[str, Target] = field(default_factory=dict)

    def models(self) -> frozenset[str]:
        return self.guidance.models() | self.asked

    def __call__(self, action: Tensor, targets: Mapping[str, Target]) -> Guided:
        self.targets = targets
        return self.guidance(action, targets)

    @property
    def optimal(self) -> Target:
        """What the optimal action model said last, (1, 2) each."""
        return self.targets[OPTIMAL]

    @property
    def predicted(self) -> Target:
        """What the user model said last, the adapted one if it was asked."""
        return self.targets[ADAPTED if ADAPTED in self.targets else USER]


def overheard_guide(
    condition: Condition, models: Models, adapted: TensorDict | None, lookahead_seconds: float
) -> tuple[Guide, Overheard]:
    """The `Guide` of one person under one condition, and where its targets can be looked at.

    Args:
        adapted: their own parameters of the user model, batch size (1,), if they have any.
    """
    overheard = Overheard(condition.guidance, frozenset({OPTIMAL, USER if adapted is None else ADAPTED}))
    return Guide([replace(condition, guidance=overheard)], 1, models, adapted, lookahead_seconds), overheard


class TickLog:
    """Writes down the ticks of one person's game.

    Args:
        tick_seconds: s.

    Attributes:
        rows: one per tick, see `COLUMNS`.
    """

    def __init__(self, overheard: Overheard, tick_seconds: float) -> None:
        self.overheard, self.tick_seconds, self.rows = overheard, tick_seconds, []
        self.time, self.round, self.won, self.lost, self.scored = 0.0, 1, 0, 0, False

    def __call__(self, tick: Tick, scored: bool, ended: bool) -> dict[str, float]:
        """Write down a tick of a game that counts or not, and whether the round ended with it; returns its row."""
        if scored and not self.scored:
            self.time, self.round, self.won, self.lost, self.scored = 0.0, 1, 0, 0, True
        goal = int(tick.goals[0])
        self.time += self.tick_seconds
        self.won, self.lost = self.won + (goal > 0), self.lost + (goal < 0)
        row: dict[str, float] = {"time_s": round(self.time, 6), "scored": int(scored), "round": self.round}
        row |= {"won": self.won, "lost": self.lost, "goal": goal}
        optimal, predicted = self.overheard.optimal, self.overheard.predicted
        pairs = {"hand": HAND_REACH * tick.before[0], "optimal": optimal.mean[0], "optimal_std": optimal.std[0]}
        pairs |= {"predicted": predicted.mean[0], "predicted_std": predicted.std[0]}
        pairs |= {"force": tick.guided.force[0], "action": tick.action[0]}
        row |= {
            f"{name}_{axis}": float(value)
            for name, pair in pairs.items()
            for axis, value in zip("xy", pair, strict=True)
        }
        row |= dict(zip(STATE, tick.state[0].tolist(), strict=True))
        weights = zip(("w_unc_optimal", "w_unc_predicted", "w_sim"), tick.guided[1:], strict=True)
        row |= {name: float("nan") if weight is None else float(weight[0]) for name, weight in weights}
        self.rows.append({name: row[name] for name in COLUMNS})
        self.round += ended
        return self.rows[-1]

    def table(self) -> pd.DataFrame:
        """The rows so far."""
        return pd.DataFrame(self.rows, columns=list(COLUMNS))


def demonstration(ticks: pd.DataFrame) -> tuple[Tensor, Tensor]:
    """What user adaptation learns from: observations (ticks, 12) and actions (ticks, 2), float32, of what counted."""
    counted = ticks[ticks["scored"] == 1]
    return tuple(torch.from_numpy(counted[names].to_numpy(dtype=np.float32)) for names in (STATE, ACTION))
