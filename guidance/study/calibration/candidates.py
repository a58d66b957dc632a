"""The candidates of the pilot, what they are compared by, and the rule for predictors.

The paper implements each type of guidance "to achieve its best performance for a given application" (section 1). The
objective is the mean share of rounds won under OAHG and under UPHG (UA). It involves no difference between two of the
nine conditions and no rating. A candidate is a pair of cells, one of each guidance; many candidates share a cell, which
is played once.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import pandas as pd

from guidance.forces.conditions import ADAPTED, OPTIMAL
from guidance.forces.lookahead import CONSISTENT, PHYSICS, PRINTED


class Cell(NamedTuple):
    """A base guidance with those of its settings that make a difference to its force.

    Attributes:
        model: `OPTIMAL` of OAHG, or `ADAPTED` of UPHG (UA).
        source: the name of its league, or of its predictor.
        reading, lookahead: those of `Lookahead`; the printed reading and 0 s where they make no difference.
        stiffness, limit: those of the spring, N/m and N.
    """

    model: str
    source: str
    reading: str
    lookahead: float
    stiffness: float
    limit: float

    @property
    def models(self) -> tuple[str, str, str, float]:
        """What cells have in common that one `BatchedGuidance` evaluates."""
        return self[:4]


class Candidate(NamedTuple):
    """One choice of all settings; `lookahead` in s, `stiffness` in N/m, `limit` in N."""

    league: str
    predictor: str
    reading: str
    lookahead: float
    stiffness: float
    limit: float

    def cells(self, ahead: Mapping[str, float]) -> tuple[Cell, Cell]:
        """Its OAHG and its UPHG (UA); `ahead` is the horizon of each predictor in s."""
        spring = self.stiffness, self.limit
        horizon = ahead[self.predictor]
        return (
            Cell(OPTIMAL, self.league, *_effective(self.reading, self.lookahead, 0.0), *spring),
            Cell(ADAPTED, self.predictor, *_effective(self.reading, self.lookahead, horizon), *spring),
        )


def _effective(reading: str, seconds: float, ahead: float) -> tuple[str, float]:
    """The look-ahead of a model with the horizon `ahead`, as `Cell` has it."""
    if seconds > ahead:
        return reading, seconds
    moves_hand = reading == CONSISTENT and ahead > 0
    return (reading if moves_hand else PRINTED), 0.0


def make_candidates(
    search: Mapping[str, Iterable], errors: pd.DataFrame, ahead: Mapping[str, float], shortest: float
) -> list[Candidate]:
    """The combinations of the values in `search`, one of each that are alike, whose predictor may be used so.

    A predictor is used at the longer one of T_lookahead and its own horizon, and must have the smallest error there.

    Args:
        search: for each field of `Candidate` its values.
        errors: rows with `predictor`, `reading`, `ahead_s` and `rmse`, see `search.predictor_errors`.
        ahead: horizon of each predictor, s.
        shortest: s, of the horizons; toward the action of the present moment there is nothing to guide.
    """
    best = errors.sort_values("rmse").drop_duplicates(["reading", "ahead_s"])
    best = best.set_index(["reading", "ahead_s"])["predictor"]
    by_cells: dict[tuple[Cell, Cell], Candidate] = {}
    for candidate in map(Candidate._make, product(*(search[name] for name in Candidate._fields))):
        horizon = max(candidate.lookahead, ahead[candidate.predictor])
        state = PRINTED if candidate.reading == PRINTED else PHYSICS
        if horizon >= shortest and best[state, horizon] == candidate.predictor:
            by_cells.setdefault(candidate.cells(ahead), candidate)
    return list(by_cells.values())


def objective(candidates: Sequence[Candidate], games: pd.DataFrame, ahead: Mapping[str, float]) -> pd.DataFrame:
    """The objective of each candidate: (OAHG + UPHG) / 2 of the shares of rounds won by the people who played both.

    Args:
        games: rows with the fields of `Cell`, `person` and `win_rate`.

    Returns:
        A row per candidate with its fields, `objective` and its standard error `se` over people, the `oahg` and `uphg`
        that it is made of, and the number of `games`; the best first. Games without a decided round do not count.
    """
    table = games.set_index([*Cell._fields, "person"])["win_rate"].unstack("person")
    rows = []
    for candidate in candidates:
        optimal, user = (table.loc[cell] for cell in candidate.cells(ahead))
        both = ((optimal + user) / 2).dropna()
        rows.append([*candidate, both.mean(), both.sem(), optimal.mean(), user.mean(), 2 * len(both)])
    columns = [*Candidate._fields, "objective", "se", "oahg", "uphg", "games"]
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values("objective", ascending=False, kind="stable", ignore_index=True)
