"""The tick table of one participant's game: state, predictions, force and action of every tick.

Films and replays are made from it, and user adaptation learns from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.experiment.files import find_files, load_json
from guidance.display.scene import STATE
from guidance.forces.conditions import ADAPTED, OPTIMAL, USER, Condition, Guidance, GuidanceOutput, Prediction
from guidance.forces.lookahead import Lookahead
from guidance.haptics.hand import HapticHand
from guidance.sessions.game import load_games, read_ticks
from guidance.simulated_users import SimulatedUsers
from guidance.simulated_users.arm import HAND_REACH
from guidance.simulated_users.intention import Intention
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.games import GameRunner, GameStep
from guidance.study.models import Models
from guidance.study.setup import StudySetup

ACTION = ["action_x", "action_y"]
COLUMNS = MappingProxyType(load_json(Path(__file__).parent / "bids_files" / "columns.json"))
"""Description and unit of every column; all but goal and action are of the beginning of the tick."""


@dataclass
class PredictionTap:
    """A guidance that records its last predictions, also of models that the force does not depend on."""

    guidance: Guidance
    queries: frozenset[str]
    targets: Mapping[str, Prediction] = field(default_factory=dict)

    def models(self) -> frozenset[str]:
        return self.guidance.models() | self.queries

    def __call__(self, state: Tensor, hand: Tensor, predictions: Mapping[str, Prediction]) -> GuidanceOutput:
        self.targets = predictions
        return self.guidance(state, hand, predictions)

    @property
    def optimal(self) -> Prediction:
        """The last prediction of the optimal action model, (1, 2) each."""
        return self.targets[OPTIMAL]

    @property
    def predicted(self) -> Prediction:
        """The last prediction of the user model, of the adapted one if there is one."""
        return self.targets[ADAPTED if ADAPTED in self.targets else USER]


def scene_facts(condition: Condition, player: str, opponent: str, adapted: bool) -> dict[str, Any]:
    """JSON description of a game for its film, see `guidance.display.film.FilmInfo`."""
    used = sorted({"optimal" if model == OPTIMAL else "predicted" for model in condition.guidance.models()})
    return {"title": condition.label, "player": player, "opponent": opponent, "used": used, "adapted": adapted}


def tapped_guidance(
    condition: Condition, models: Models, adapted: TensorDict | None, lookahead: Lookahead
) -> tuple[BatchedGuidance, PredictionTap]:
    """The `BatchedGuidance` of one person under one condition, and the tap of its predictions.

    Args:
        adapted: the person's own parameters of the user model, batch size (1,), or None.
    """
    tap = PredictionTap(condition.guidance, frozenset({OPTIMAL, USER if adapted is None else ADAPTED}))
    return BatchedGuidance([tap], 1, models, adapted, lookahead), tap


class TickLog:
    """Records the ticks of one person's game.

    Args:
        tick_seconds: s.
        hand: recorded for its force and grip; None if the guidance acts on the hand directly.

    Attributes:
        rows: one per tick since the last `take`, see `COLUMNS`.
        time, round, won, lost, scored: the state of the game.
    """

    def __init__(self, tap: PredictionTap, tick_seconds: float, hand: HapticHand | None = None) -> None:
        self.tap, self.tick_seconds, self.hand, self.rows = tap, tick_seconds, hand, []
        self.time, self.round, self.won, self.lost, self.scored = 0.0, 1, 0, 0, False

    def __call__(self, tick: GameStep, scored: bool, ended: bool) -> dict[str, float]:
        """Record a tick, whether it is scored and whether the round ended with it; returns its row."""
        if scored and not self.scored:
            self.time, self.round, self.won, self.lost, self.scored = 0.0, 1, 0, 0, True
        goal = int(tick.goals[0])
        self.time += self.tick_seconds
        self.won, self.lost = self.won + (goal > 0), self.lost + (goal < 0)
        row: dict[str, float] = {"time_s": round(self.time, 6), "scored": int(scored), "round": self.round}
        row |= {"won": self.won, "lost": self.lost, "goal": goal}
        row |= {"held": 1 if self.hand is None else int(self.hand.is_held)}
        optimal, predicted = self.tap.optimal, self.tap.predicted
        pairs = {"hand": HAND_REACH * tick.before[0], "optimal": optimal.mean[0], "optimal_std": optimal.std[0]}
        pairs |= {"predicted": predicted.mean[0], "predicted_std": predicted.std[0]}
        force = tick.guidance.force[0]
        pairs |= {"force": force, "felt": force if self.hand is None else self.hand.force, "action": tick.action[0]}
        row |= {
            f"{name}_{axis}": float(value)
            for name, pair in pairs.items()
            for axis, value in zip("xy", pair, strict=True)
        }
        row |= dict(zip(STATE, tick.state[0].tolist(), strict=True))
        weights = zip(("w_unc_optimal", "w_unc_predicted", "w_sim"), tick.guidance[1:], strict=True)
        row |= {name: float("nan") if weight is None else float(weight[0]) for name, weight in weights}
        self.rows.append({name: row[name] for name in COLUMNS})
        self.round += ended
        return self.rows[-1]

    def take(self) -> list[dict[str, float]]:
        """Return the rows since the last call, and forget them."""
        rows, self.rows = self.rows, []
        return rows


def demonstration(ticks: pd.DataFrame) -> tuple[Tensor, Tensor]:
    """Observations (ticks, 12) and actions (ticks, 2), float32, of the scored play: the input of user adaptation."""
    scored = ticks[ticks["scored"] == 1]
    return tuple(torch.from_numpy(scored[names].to_numpy(dtype=np.float32, copy=True)) for names in (STATE, ACTION))


def load_recorded_part(
    run: Path, game: str | None, start: float, seconds: float
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The ticks of a part of a recorded game, and the facts for its film, see `scene_facts`.

    Args:
        run: a game's table (`..._beh.tsv`), the folder of a run of `airhockey play`, or one person's folder of
            `airhockey lab`.
        game: name of the game in the folder; None for the last.
        start: s, the game's time at which the part begins.
        seconds: s, length of the part.

    Raises:
        ValueError: there is no such game, or it has no ticks in that time.
    """
    if run.is_file():
        file = run.with_suffix(".tsv")
        facts = load_json(run.with_suffix(".json"))["Facts"]
    else:
        folders = sorted({file.parent for file in find_files([run], "*_beh.json")})
        if len(folders) > 1:
            raise ValueError(f"run = {run} has the games of several people: name the folder of one")
        games = load_games(folders[0])
        if not games:
            raise ValueError(f"run = {run} has no complete game; an interrupted one is shown by the name of its .tsv")
        if game is not None and game not in games:
            raise ValueError(f"game = {game} must be one of {', '.join(games)}")
        chosen = games[list(games)[-1] if game is None else game]
        file, facts = chosen.file, chosen.facts
    ticks = read_ticks(file, COLUMNS)
    ticks = ticks[ticks["scored"] == 1]  # time begins anew after the familiarization
    ticks = ticks[(ticks["time_s"] > start) & (ticks["time_s"] <= start + seconds)].reset_index(drop=True)
    if ticks.empty:
        raise ValueError(f"start = {start}: {file} has nothing then")
    return ticks, facts


@torch.no_grad()
def record_game(
    users: SimulatedUsers, setup: StudySetup, adapted: TensorDict | None, serves: np.ndarray, seconds: float
) -> pd.DataFrame:
    """Play one person's game under the one condition of a setup, a round after each goal.

    Args:
        adapted: their own parameters of the user model, batch size (1,), if the condition has UA.
        serves: (1,) uint64, the table's random numbers.

    Returns:
        A row per tick, see `COLUMNS`, with the desired position of the hand (wanted_x and
        _y, in m of the hand) and the intention.
    """
    (condition,) = setup.conditions
    guidance, tap = tapped_guidance(condition, setup.models, adapted, setup.lookahead)
    runner, log = GameRunner(users, setup.opponent, setup.table, serves), TickLog(tap, setup.table.tick)
    runner.new_games()
    for _ in range(max(1, round(seconds / setup.table.tick))):
        (wanted_x, wanted_y), intention = users.goal[0], Intention(users.intention[0]).name
        tick = runner.tick(guidance)
        scored = tick.goals != 0
        log(tick, True, scored[0]).update(wanted_x=wanted_x, wanted_y=wanted_y, intention=intention)
        if scored[0]:
            runner.new_rounds(scored)
    return pd.DataFrame(log.rows)
