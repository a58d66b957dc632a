"""The user study (section 4): calibration game, user adaptation, and a game and ratings per condition.

Conditions come in counterbalanced order. People who adapt play them one after the other, each with what was learned in
those before; without adaptation no game depends on another, and all are played at once. The random numbers of a game
follow from the seed, the user and the condition, so its results are bit-identical whichever other studies are played in
the same run, and without adaptation whichever other conditions are.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from string import ascii_lowercase
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

from guidance.forces.condition_specs import PAPER_LETTERS
from guidance.forces.conditions import ADAPTED, Condition, GuidanceOutput
from guidance.simulated_users import SimulatedUsers
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.games import Forces, Games, no_force, play_games
from guidance.study.metrics import COUNTS
from guidance.study.protocol import CALIBRATION_GAME, counterbalanced_order, user_and_table_states
from guidance.study.setup import StudySetup


@dataclass(frozen=True)
class Cohort:
    """The participants of one study.

    Attributes:
        people: (users,) structured array, see `guidance.simulated_users`.
        seed: every random number of the study follows from it.
    """

    people: np.ndarray
    seed: int


class StudyTables(NamedTuple):
    """The tables of one study, with a row per user and condition: the columns of `trials.csv` and of `counts.csv`."""

    trials: pd.DataFrame
    counts: pd.DataFrame


def run_study(people: np.ndarray, setup: StudySetup, *, seed: int, **kwargs) -> StudyTables:
    """One study, see `run_studies`."""
    return run_studies([Cohort(people, seed)], setup, **kwargs)[0]


def run_studies(
    cohorts: Sequence[Cohort],
    setup: StudySetup,
    progress: Callable[[str, float], None] = lambda stage, share: None,
    shuffled_adaptation: bool = False,
    on_forces: Callable[[GuidanceOutput, np.ndarray], None] = lambda output, games: None,
) -> list[StudyTables]:
    """Play several studies side by side with simulated people.

    Args:
        progress: called with the name of a stage and the share of it that is done.
        shuffled_adaptation: adapt each user model to another participant's calibration game (a negative control of UA).
        on_forces: called every tick with the guidance of the games (k,), ordered as in `BatchedGuidance`.

    """
    conditions, people = setup.conditions, np.concatenate([cohort.people for cohort in cohorts])
    play = partial(_play, cohorts, setup, progress=progress)
    adapted = None
    if any(ADAPTED in condition.guidance.models() for condition in conditions):
        _, games = play([CALIBRATION_GAME], no_force, stage="unscored game", keep_demonstrations=True)
        adapted = setup.models.adapted_to(games.demonstrations)
        if shuffled_adaptation:
            adapted = adapted[_neighbors([len(cohort.people) for cohort in cohorts])]
    guidances = [condition.guidance for condition in conditions]
    guidance = BatchedGuidance(guidances, len(people), setup.models, adapted, setup.lookahead)

    def forces(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
        output = guidance(state, action, games)
        on_forces(output, games)
        return output

    numbers = [ascii_lowercase.index(condition.letter) for condition in conditions]
    order = np.concatenate([playing_order(cohort, conditions) for cohort in cohorts]) if setup.adaptation else None
    participants, games = play(numbers, forces, stage="games", order=order)
    extra = {name: games.results.pop(name) for name in setup.extra_metrics}  # after the paper's columns
    columns = {
        **games.results,
        **participants.ratings(setup.rating_scales),
        "rounds": games.rounds,
        "duration_s": games.seconds,
        **games.weights,
        **extra,
        **games.counts,
    }
    columns = {name: values.reshape(len(conditions), -1) for name, values in columns.items()}
    edges = np.cumsum([0, *(len(cohort.people) for cohort in cohorts)])
    return [
        _tables(cohort, conditions, {name: values[:, first:last] for name, values in columns.items()})
        for cohort, first, last in zip(cohorts, edges[:-1], edges[1:], strict=True)
    ]


def _play(
    cohorts: Sequence[Cohort],
    setup: StudySetup,
    numbers: Sequence[int],
    forces: Forces,
    stage: str,
    progress: Callable[[str, float], None],
    keep_demonstrations: bool = False,
    order: np.ndarray | None = None,
) -> tuple[SimulatedUsers, Games]:
    """Play the games of these numbers with everybody, and return the participants too.

    Args:
        order: (users, games) int64, the places in `numbers` of each user's first game, of the second, and so on; each
            begins with what was learned in the one before. All games at once if None.
    """
    streams = [user_and_table_states(c.seed, range(len(c.people)), number) for number in numbers for c in cohorts]
    user_states, table_states = (np.concatenate(part) for part in zip(*streams, strict=True))
    people = np.concatenate([cohort.people for cohort in cohorts])
    participants = setup.simulated_users(np.tile(people, len(numbers)), user_states)
    games = play_games(
        participants,
        setup.opponent,
        forces,
        setup.protocol,
        setup.table,
        table_states,
        keep_demonstrations,
        partial(progress, stage),
        extra_metrics=setup.extra_metrics,
        waves=None if order is None else _one_after_the_other(participants, order),
    )
    return participants, games


def _one_after_the_other(participants: SimulatedUsers, order: np.ndarray) -> Iterator[np.ndarray]:
    """The games of everybody's first condition, of the second, and so on, and carry over to them what was learned.

    Args:
        participants: game c * users + u is played by user u.
        order: see `_play`.
    """
    users = np.arange(len(order))
    games = order.T * len(order) + users  # (conditions, users)
    for place, wave in enumerate(games):
        if place:
            participants.carry_over(wave, participants, games[place - 1])
        yield np.sort(wave)


def _neighbors(sizes: Sequence[int]) -> torch.Tensor:
    """For each person the index of the previous one in the same cohort; for its first person, of the last."""
    firsts = np.cumsum([0, *sizes[:-1]])
    return torch.from_numpy(
        np.concatenate([first + np.roll(np.arange(n), 1) for first, n in zip(firsts, sizes, strict=True)])
    )


def _tables(cohort: Cohort, conditions: Sequence[Condition], columns: dict[str, np.ndarray]) -> StudyTables:
    """The tables of a study from columns (conditions, users)."""
    position = positions(cohort, conditions)
    rows = []
    for c, condition in enumerate(conditions):
        for u in range(len(cohort.people)):
            row: dict[str, object] = {"user": f"S{u + 1:02d}", "condition": condition.name}
            row["position"] = position[u, c]
            row |= {name: values[c, u] for name, values in columns.items()}
            if condition.letter == "a":
                row["mean_disagreement"] = np.nan  # undefined without a force (section 5.2)
            rows.append(row | {"seed": cohort.seed})
    table = pd.DataFrame(rows)
    return StudyTables(table.drop(columns=list(COUNTS)), table[["user", "condition", *COUNTS]])


def positions(cohort: Cohort, conditions: Sequence[Condition]) -> np.ndarray:
    """(users, conditions): the position, from 1, of each condition in each user's order of the paper's nine.

    Those beyond the paper's come after them, by letter.
    """
    users, nine = len(cohort.people), len(PAPER_LETTERS)
    paper = counterbalanced_order(users, nine, cohort.seed)
    beyond = sorted(c.letter for c in conditions if c.letter not in PAPER_LETTERS)
    columns = [
        paper[:, PAPER_LETTERS.index(c.letter)]
        if c.letter in PAPER_LETTERS
        else np.full(users, nine + 1 + beyond.index(c.letter))
        for c in conditions
    ]
    return np.stack(columns, axis=1)


def playing_order(cohort: Cohort, conditions: Sequence[Condition]) -> np.ndarray:
    """(users, conditions): the places in `conditions` of each user's first condition, of the second, and so on."""
    return np.argsort(positions(cohort, conditions), axis=1)
