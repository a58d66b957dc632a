"""Loading part of a recorded game, to show it again."""

from pathlib import Path
from typing import Any

import pandas as pd

from airhockey_marl.experiment.files import find_files, load_json
from guidance.sessions.game import load_games
from guidance.study.tick_log import read_ticks


def load_recorded_part(
    run: Path, game: str | None, start: float, seconds: float
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The ticks of a part of a recorded game, and the facts for its film, see `guidance.study.tick_log.scene_facts`.

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
    ticks = read_ticks(file)
    ticks = ticks[ticks["scored"] == 1]  # time begins anew after the familiarization
    ticks = ticks[(ticks["time_s"] > start) & (ticks["time_s"] <= start + seconds)].reset_index(drop=True)
    if ticks.empty:
        raise ValueError(f"start = {start}: {file} has nothing then")
    return ticks, facts
