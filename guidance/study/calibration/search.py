"""The pilot's choice by successive halving (Jamieson & Talwalkar 2016).

All candidates are played by a few people, the better ones by more, and the last few by many others, whom the choice has
not seen before: their mean is the one that is reported.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import write_text
from guidance.forces.lookahead import PHYSICS, PRINTED
from guidance.study.calibration.candidates import Candidate, Cell, make_candidates, objective
from guidance.study.calibration.pilot import Pilot, steady_cells
from guidance.study.models import Models
from guidance.study.prediction import errors_ahead, everybody_by_everybody, for_whom
from guidance.user_model.data import Demonstrations


class Tables:
    """Tables of a run in its folder: one that is there is read instead of made again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, name: str, make: Callable[[], pd.DataFrame]) -> pd.DataFrame:
        """The table of this name."""
        if not (self.folder / f"{name}.csv").is_file():
            self.write(name, make())
        return self.read(name)

    def read(self, name: str) -> pd.DataFrame:
        """A table that is there."""
        return pd.read_csv(self.folder / f"{name}.csv")

    def write(self, name: str, table: pd.DataFrame) -> None:
        """Write or replace a table."""
        write_text(self.folder / f"{name}.csv", table.to_csv(index=False))


def choose_guidance(
    pilot: Pilot,
    hands: np.ndarray,
    unseen: Callable[[], Demonstrations],
    options: Mapping[str, Any],
    tables: Tables,
    progress: Callable[[str, float], None],
) -> Candidate:
    """The candidate with the largest objective; writes `predictors`, `holding`, `games` and `candidates` to `tables`.

    Args:
        hands: (n,) people who must be able to hold the hand still under a candidate.
        unseen: plays the games on which the predictors are compared.
        options: `pilot` of conf/calibrate.yaml.

    Raises:
        InputError: no candidate is left.
    """
    search, ahead = options["search"], pilot.ahead
    errors = tables.get("predictors", lambda: predictor_errors(pilot.predictors, unseen(), search["lookahead"]))
    choices = {**search, "predictor": ahead}
    candidates = make_candidates(choices, errors, ahead, options["horizon"])
    holding = tables.get("holding", lambda: _holding(replace(pilot, people=hands), candidates, options["holding"]))
    steady = steady_cells(holding, options["holding"]["wander"], options["holding"]["of_people"])
    candidates = [candidate for candidate in candidates if steady.issuperset(candidate.cells(ahead))]
    if not candidates:
        raise InputError("pilot.search: no candidate has an allowed predictor and lets the hand be held still")
    rounds = options["people"], options["left"], options["together"]
    standings = successive_halving(pilot, candidates, *rounds, tables, progress)
    tables.write("candidates", standings)
    last = standings[standings["round"] == standings["round"].max()]
    return Candidate(*last.iloc[0][[*Candidate._fields]].to_dict().values())


def _holding(pilot: Pilot, candidates: Sequence[Candidate], options: Mapping[str, float]) -> pd.DataFrame:
    """See `Pilot.holding`, of the cells of all candidates."""
    cells = {cell for candidate in candidates for cell in candidate.cells(pilot.ahead)}
    adapted = pilot.adapted(pilot.unscored_games(range(len(pilot.people))))
    return pilot.holding(sorted(cells), adapted, options["seconds"])


def predictor_errors(
    predictors: Mapping[str, Models], data: Demonstrations, lookaheads: Sequence[float]
) -> pd.DataFrame:
    """Errors of user prediction models at the horizons at which they may be used, on people they were not trained on.

    Args:
        data: at least two games of each person; the last is predicted, UA has the first.
        lookaheads: values of T_lookahead, s.

    Returns:
        A row per predictor, reading by which the state is moved on, and horizon `ahead_s` of at least its own: `rmse`
        after UA with the ends `low` and `high` of its 95 % interval over people, `without_ua` that of the model for
        people in general, `extrapolation` that of the paddle's velocity; and at its own horizon `ua`, by how much the
        model of another person errs more, `ua_low` and `ua_high`. In units of action.
    """
    table, rows = TableSpec(), []
    horizons = sorted({*lookaheads, *(models.ahead for models in predictors.values())})
    for name, models in predictors.items():
        own = for_whom(everybody_by_everybody(models, data, table))["advantage"]
        for reading in (PRINTED, PHYSICS):
            used = [seconds for seconds in horizons if seconds >= models.ahead]
            errors = {
                (row["predictor"], row["ahead_s"]): row["rmse"]
                for row in errors_ahead(models, data, used, table, reading)
            }
            for seconds in used:
                after = errors["after_ua", seconds]
                row = {"predictor": name, "reading": reading, "ahead_s": seconds, "rmse": after["mean"]}
                row |= {key: after[key] for key in ("low", "high")}
                row |= {"without_ua": errors["supervised", seconds]["mean"]}
                row |= {"extrapolation": errors["extrapolation", seconds]["mean"]}
                if seconds == models.ahead:
                    row |= {"ua": own["mean"], "ua_low": own["low"], "ua_high": own["high"]}
                rows.append(row)
    return pd.DataFrame(rows)


def successive_halving(
    pilot: Pilot,
    candidates: Sequence[Candidate],
    people: Sequence[int],
    left: Sequence[int],
    together: int,
    tables: Tables,
    progress: Callable[[str, float], None],
) -> pd.DataFrame:
    """Play the rounds of the search; games that are in the table `games` of `tables` are not played again.

    Args:
        people: who are added in each round; the people of the last round are the only ones that count in it.
        left: candidates that are left after each round but the last.
        together: games that are played side by side.

    Returns:
        `objective` of the candidates of every round, and their `round` from 1.
    """
    games = tables.get("games", lambda: pd.DataFrame(columns=[*Cell._fields, "person", "win_rate"]))
    standings, ends = [], list(accumulate(people))
    for number, (added, end) in enumerate(zip(people, ends, strict=True), start=1):
        persons = range(end - added, end)
        cells = {cell for candidate in candidates for cell in candidate.cells(pilot.ahead)}
        games = _play_missing(pilot, cells, persons, games, together, tables, partial(progress, f"round {number}"))
        count = games["person"].isin(persons) if number == len(people) else games["person"] < end
        standing = objective(candidates, games[count], pilot.ahead)
        standings.append(standing.assign(round=number))
        if number < len(people):
            best = standing[[*Candidate._fields]].head(left[number - 1])
            candidates = [Candidate(*row) for row in best.itertuples(index=False)]
    return pd.concat(standings, ignore_index=True)


def _play_missing(
    pilot: Pilot,
    cells: set[Cell],
    persons: range,
    games: pd.DataFrame,
    together: int,
    tables: Tables,
    progress: Callable[[float], None],
) -> pd.DataFrame:
    """All games so far, with those of `persons` in `cells`."""
    present = games[games["person"].isin(persons)].groupby([*Cell._fields]).size()
    missing = sorted(cells - {Cell(*key) for key in present.index})
    adapted = pilot.adapted(pilot.unscored_games(persons)) if missing else {}
    batch = max(1, together // len(persons))
    for first in range(0, len(missing), batch):
        played = pilot.play(missing[first : first + batch], persons, adapted)
        games = pd.concat([games, played], ignore_index=True) if len(games) else played  # an empty table has no dtypes
        tables.write("games", games)
        progress(min(1.0, (first + batch) / len(missing)))
    return games
