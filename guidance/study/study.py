"""The study of section 4: an unscored game without guidance, user adaptation from it, a game per condition, ratings.

Conditions come in counterbalanced order. Each game's random numbers follow from the seed, the user and the condition:
neither the other conditions in a run nor other studies played at the same time change a bit of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from string import ascii_lowercase

import numpy as np
import pandas as pd
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.players.players import Player
from guidance.forces.conditions import Condition, GuidanceOutput
from guidance.simulated_users import Advisors, SimulatedUsers
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.games import Forces, no_force, play_games
from guidance.study.models import Models
from guidance.study.protocol import CALIBRATION_GAME, PAPER_LETTERS, Protocol, counterbalanced_order, spawn_rng_states


@dataclass(frozen=True)
class Cohort:
    """The participants of one study.

    Attributes:
        people: (users,) structured array, see `guidance.simulated_users`.
        seed: every random number of the study follows from it.
    """

    people: np.ndarray
    seed: int


def run_study(people: np.ndarray, *how, seed: int, **more) -> pd.DataFrame:
    """One study, see `run_studies`."""
    return run_studies([Cohort(people, seed)], *how, **more)[0]


def run_studies(
    cohorts: Sequence[Cohort],
    conditions: Sequence[Condition],
    models: Models,
    opponent: Player,
    lookahead_seconds: float,
    protocol: Protocol,
    table: TableSpec,
    variant: str,
    mentors: Advisors,
    rating_scales: dict[str, float],
    progress: Callable[[str, float], None] = lambda what, share: None,
    swapped: bool = False,
    answered: Callable[[GuidanceOutput, np.ndarray], None] = lambda guided, games: None,
) -> list[pd.DataFrame]:
    """Put simulated people through the whole protocol, all studies side by side.

    Args:
        progress: is told what is going on, and the share of it that is done.
        swapped: for UA, everybody's game is taken for somebody else's: a negative control.
        answered: is shown every answer to the games (k,), which are ordered condition by condition, as in `BatchedGuidance`.

    Returns:
        Per study one row per user and condition: the columns of `trials.csv`.
    """
    people = np.concatenate([cohort.people for cohort in cohorts])

    def games_of(games: Sequence[int], forces: Forces, what: str, demonstrations: bool = False):
        minds, serves = (
            np.concatenate([spawn_rng_states(c.seed, range(len(c.people)), game, p) for game in games for c in cohorts])
            for p in (0, 1)
        )
        participants = SimulatedUsers(np.tile(people, len(games)), minds, table, variant, mentors)
        return participants, play_games(
            participants, opponent, forces, protocol, table, serves, demonstrations, partial(progress, what)
        )

    adapted = None
    if any("adapted" in condition.guidance.models() for condition in conditions):
        _, unscored = games_of([CALIBRATION_GAME], no_force, "unscored game", demonstrations=True)
        adapted = models.adapted_to(unscored.demonstrations)
        if swapped:
            adapted = adapted[_neighbors([len(cohort.people) for cohort in cohorts])]

    guide = BatchedGuidance(conditions, len(people), models, adapted, lookahead_seconds)

    def forces(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
        guided = guide(state, action, games)
        answered(guided, games)
        return guided

    participants, games = games_of([ascii_lowercase.index(c.letter) for c in conditions], forces, "games")
    columns = {
        **games.results,
        **participants.ratings(rating_scales),
        "rounds": games.rounds,
        "duration_s": games.seconds,
        **games.weights,
    }
    trials, first = [], 0
    for cohort in cohorts:
        rows = np.arange(first, first + len(cohort.people))
        own = {name: values.reshape(len(conditions), -1)[:, rows] for name, values in columns.items()}
        trials.append(_table_of(cohort, conditions, own))
        first += len(cohort.people)
    return trials


def _neighbors(sizes: Sequence[int]) -> torch.Tensor:
    """For everybody the number of the person before in the same cohort, for its first person the last."""
    firsts = np.cumsum([0, *sizes[:-1]])
    return torch.from_numpy(
        np.concatenate([first + np.roll(np.arange(n), 1) for first, n in zip(firsts, sizes, strict=True)])
    )


def _table_of(cohort: Cohort, conditions: Sequence[Condition], columns: dict[str, np.ndarray]) -> pd.DataFrame:
    """`trials.csv` of a study from columns (conditions, users)."""
    users = len(cohort.people)
    position = counterbalanced_order(users, len(PAPER_LETTERS), cohort.seed)
    beyond = sorted(c.letter for c in conditions if c.letter not in PAPER_LETTERS)  # played after the paper's
    rows = []
    for c, condition in enumerate(conditions):
        for u in range(users):
            row: dict[str, object] = {"user": f"S{u + 1:02d}", "condition": condition.name}
            nth = PAPER_LETTERS.find(condition.letter)
            row["position"] = position[u, nth] if nth >= 0 else len(PAPER_LETTERS) + 1 + beyond.index(condition.letter)
            row |= {name: values[c, u] for name, values in columns.items()}
            if condition.letter == "a":
                row["mean_disagreement"] = np.nan  # there is no force to disagree with (section 5.2)
            rows.append(row | {"seed": cohort.seed})
    return pd.DataFrame(rows)
