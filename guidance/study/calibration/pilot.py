"""The pilot's games: the base guidances with many settings side by side, played by people who are in no study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict

from airhockey_marl.envs.physics import LEFT, PUCK
from airhockey_marl.envs.world import World
from guidance.forces.conditions import ADAPTED, OPTIMAL, GuidanceOutput, Spring, SpringGuidance
from guidance.forces.lookahead import Lookahead
from guidance.simulated_users.intention import Intention
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.calibration.candidates import Cell
from guidance.study.games import Forces, no_force, play_games
from guidance.study.models import Models
from guidance.study.protocol import CALIBRATION_GAME, Protocol, user_and_table_states
from guidance.study.setup import PlaySetup

PILOT_TRIAL = 4000  # in the seeds, where a study has the number of its condition
STILL = np.array([0.25, 0.0, 0.0, 0.0])  # a puck that rests in the opponent's half, in lengths of the table


@dataclass(frozen=True)
class Pilot:
    """Plays cells with pilot people.

    Attributes:
        people: (n,) in the order in which they come.
        setup: their opponent, table and response to a force.
        leagues: the optimal action models by name, as `Models`.
        predictors: the user prediction models by name, as `Models`.
        reach: m of hand travel per unit of action.
        protocol: the course of a game.
        seed: every random number of the pilot follows from it.
    """

    people: np.ndarray
    setup: PlaySetup
    leagues: Mapping[str, Models]
    predictors: Mapping[str, Models]
    reach: float
    protocol: Protocol
    seed: int

    @property
    def ahead(self) -> dict[str, float]:
        """The horizon of each predictor, s."""
        return {name: models.ahead for name, models in self.predictors.items()}

    def models(self, league: str, predictor: str) -> Models:
        """The models of a candidate."""
        own = self.predictors[predictor]
        return replace(own, optimal=self.leagues[league].optimal)

    def unscored_games(self, persons: range) -> list:
        """What each of these people show in the unscored game, for `adapted`."""
        users, tables = user_and_table_states(self.seed, persons, CALIBRATION_GAME)
        participants = self.setup.simulated_users(self.people[persons], users)
        table = self.setup.table
        games = play_games(participants, self.setup.opponent, no_force, self.protocol, table, tables, True)
        return games.demonstrations

    def adapted(self, demonstrations: list) -> dict[str, TensorDict]:
        """Each predictor, adapted to the people of these games."""
        return {name: models.adapted_to(demonstrations) for name, models in self.predictors.items()}

    def play(self, cells: Sequence[Cell], persons: range, adapted: Mapping[str, TensorDict]) -> pd.DataFrame:
        """One game of each person in each cell: rows with the cell's fields, `person` and `win_rate`.

        A person meets the same serves in all cells, and comes to each as to the first.
        """
        n, order = len(persons), sorted(cells)
        users, tables = (np.tile(part, len(order)) for part in user_and_table_states(self.seed, persons, PILOT_TRIAL))
        participants = self.setup.simulated_users(np.tile(self.people[persons], len(order)), users)
        forces = self.forces(order, n, adapted)
        games = play_games(participants, self.setup.opponent, forces, self.protocol, self.setup.table, tables)
        return _rows(order, persons).assign(win_rate=games.results["win_rate"])

    def forces(self, cells: Sequence[Cell], people: int, adapted: Mapping[str, TensorDict]) -> Forces:
        """The forces of the games of all `people` in each of the cells, which are in ascending order."""
        parts, first = [], 0
        for key in dict.fromkeys(cell.models for cell in cells):
            model, source, reading, lookahead = key
            springs = [Spring(cell.stiffness, cell.limit, self.reach) for cell in cells if cell.models == key]
            models = (self.leagues if model == OPTIMAL else self.predictors)[source]
            guidances = [SpringGuidance(model, spring) for spring in springs]
            own = adapted[source] if model == ADAPTED else None
            guidance = BatchedGuidance(guidances, people, models, own, Lookahead(lookahead, reading))
            parts.append((guidance, slice(first, first + len(springs) * people)))
            first += len(springs) * people

        def forces(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
            edges = np.searchsorted(games, [part.start for _, part in parts] + [first])
            outputs = [
                guidance(state[part], action[part], games[low:high] - part.start).force
                for (guidance, part), low, high in zip(parts, edges[:-1], edges[1:], strict=True)
                if low < high
            ]
            return GuidanceOutput(torch.cat(outputs))

        return forces

    def holding(self, cells: Sequence[Cell], adapted: Mapping[str, TensorDict], seconds: float) -> pd.DataFrame:
        """How still each of the people holds the hand in each cell: rows with the cell's fields, `person`, `wander`.

        They are told to wait while the puck rests in the opponent's half. `wander` is the root mean square distance of
        the hand from its mean position in the second half of `seconds`, m: small unless spring and arm sustain an
        oscillation.
        """
        n, order, table = len(self.people), sorted(cells), self.setup.table
        users, _ = user_and_table_states(self.seed, range(n), PILOT_TRIAL)
        participants = self.setup.simulated_users(np.tile(self.people, len(order)), np.tile(users, len(order)))
        participants.instruct(Intention.WAIT)
        tables, forces, games = World(n * len(order), table), self.forces(order, n, adapted), np.arange(n * len(order))
        state, actions = np.empty((len(games), 12)), np.full((len(games), 2, 2), np.nan)
        tables.new_rounds()
        ticks, hands = round(seconds / table.tick), []
        for _ in range(ticks):
            tables.bodies[:, PUCK], tables.timers[:] = table.length * STILL, 0.0
            tables.observe(LEFT, state)
            force = forces(state, participants.action.copy(), games).force.numpy()
            actions[:, LEFT] = participants.step(state, force, games)
            tables.step(actions)
            hands.append(participants.hand)
        late = np.stack(hands[ticks // 2 :])
        wander = np.sqrt(((late - late.mean(axis=0)) ** 2).sum(axis=-1).mean(axis=0))
        return _rows(order, range(n)).assign(wander=wander)


def _rows(cells: Sequence[Cell], persons: range) -> pd.DataFrame:
    """A row per cell and person, cell by cell, with the cell's fields and `person`."""
    return pd.DataFrame([(*cell, person) for cell in cells for person in persons], columns=[*Cell._fields, "person"])


def steady_cells(holding: pd.DataFrame, wander: float, of_people: float) -> set[Cell]:
    """The cells in which at least the share `of_people` of the people wander by at most `wander` m, see `holding`."""
    shares = holding.assign(steady=holding["wander"] <= wander).groupby([*Cell._fields], sort=False)["steady"].mean()
    return {Cell(*key) for key, share in shares.items() if share >= of_people}
