"""A complete game of one person: its table with a row per tick, and its description with results and ratings."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from airhockey_marl.experiment.files import load_json
from airhockey_marl.experiment.validation.tables import Column, read_table
from guidance.forces.conditions import GuidanceOutput
from guidance.sessions.json_files import save_json
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.design import METRICS

UNSCORED = "unscored"  # name of the game without guidance for user adaptation
OBJECTIVE = tuple(name for name, metric in METRICS.items() if metric.kind == "objective")
RESULTS = (
    *OBJECTIVE,
    "rounds",
    "duration_s",
    *(f"{w}_{part}" for w in GuidanceOutput._fields[1:] for part in ("mean", "sd")),
)
MISSING = "n/a"  # as in BIDS
PARTIAL, BEHAVIOR = "_desc-partial_beh", "_beh"  # endings of the names of a game's files


@dataclass(frozen=True)
class Game:
    """A complete game.

    Attributes:
        name: of its condition, or `UNSCORED`.
        position: in the person's order, from 1; 0 is the unscored game.
        results: name in `RESULTS` -> value; NaN where undefined.
        counts: name in `guidance.study.metrics.COUNTS` -> number; empty in records of early versions.
        ratings: name in `guidance.simulated_users.ratings.RATINGS` -> 1 to 7; None before the rating.
        interview: the experimenter's note on what the person said about the game.
        facts: further information from the start and the end of the game.
        description: the file with all of these.
    """

    name: str
    position: int
    results: dict[str, float]
    counts: dict[str, int]
    ratings: dict[str, int] | None
    interview: str
    facts: dict[str, Any]
    description: Path

    @classmethod
    def load(cls, description: Path) -> "Game":
        """Load the game of a final `..._beh.json`.

        Raises:
            ValueError: `Recording.finish` did not write it, or its table is missing; the message names the file.
        """
        content = load_json(description)
        try:
            results = {name: content["Results"][name] for name in RESULTS}
            ratings = content["Ratings"] and {name: content["Ratings"][name] for name in RATINGS}
            name, position, interview = content["Condition"], content["Position"], content["Interview"]
            facts, counts = content["Facts"], dict(content.get("Counts", {}))
        except (KeyError, TypeError) as error:
            raise ValueError(f"{description} does not describe a game: it lacks {error}") from error
        results = {result: math.nan if value is None else value for result, value in results.items()}
        game = cls(name, position, results, counts, ratings, interview, facts, description)
        if not game.file.is_file():
            raise ValueError(f"{description} describes a table that is not there")
        return game

    @property
    def file(self) -> Path:
        """The table of its ticks."""
        final = self.description.with_suffix(".tsv")
        partial = final.with_name(final.name.removesuffix(BEHAVIOR + ".tsv") + PARTIAL + ".tsv")
        return partial if partial.is_file() else final  # it is renamed soon, see `recover_games`

    def rate(self, ratings: Mapping[str, int], interview: str) -> "Game":
        """Save ratings with the game, and return it with them. The same ratings may be saved again with an interview.

        Raises:
            ValueError: the unscored game, or a game that has other ratings.
            OSError: they could not be saved.
        """
        if self.name == UNSCORED:
            raise ValueError(f"ratings of {self.name}: this game is not rated")
        ratings = {name: int(ratings[name]) for name in RATINGS}
        if self.ratings is not None and (self.ratings != ratings or self.interview not in ("", interview)):
            raise ValueError(f"ratings of {self.name}: there are some already, {self.ratings}")
        save_json(self.description, load_json(self.description) | {"Ratings": ratings, "Interview": interview})
        return Game.load(self.description)


def read_ticks(file: Path, columns: Iterable[str] = ()) -> pd.DataFrame:
    """The table of a game, a row per tick; floats are bit-identical to the recorded ones.

    Raises:
        ValueError: the file is missing, lacks one of the `columns`, or has no number in one; the message names it.
    """
    return read_table(file, dict.fromkeys(columns, Column(missing=True)), float_precision="round_trip")


def load_games(folder: Path) -> dict[str, Game]:
    """The complete games in a folder after `recover_games`: name -> game, ordered by position."""
    files = (file for file in folder.glob(f"*{BEHAVIOR}.json") if "_desc-" not in file.name)
    games = sorted(map(Game.load, files), key=lambda game: game.position)
    return {game.name: game for game in games}


def game_file(stem: Path, ending: str, suffix: str) -> Path:
    """The path of a game's file; `ending` is `PARTIAL`, `BEHAVIOR` or that of an interrupted game."""
    return stem.with_name(stem.name + ending + suffix)
