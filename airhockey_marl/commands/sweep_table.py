"""Tabulate a sweep: the settings that it varied beside the scores of its runs.

    airhockey train -m hidden=[32,32],[64,64],[64,64,64] generations=20
    airhockey meta_train -m hidden=[40,40],[80,80],[80,80,80,80]
    airhockey sweep_table runs=outputs/meta_train/<date>/<time>-sweep by=after_ua_loss

Reads the card.json of every run below `runs`: settings that differ between runs, and scores; seeds are averaged.
Writes sweep_table.csv, a row per run, into its run folder, and prints the table.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors
from airhockey_marl.experiment.config import InputError, flatten_settings
from airhockey_marl.experiment.files import find_files, load_json, write_text
from airhockey_marl.experiment.run_folder import output_folder

CARD = "card.json"


def main(cfg: DictConfig) -> None:
    with report_input_errors():
        rows, varied, scores = tabulate(read_cards(cfg.runs))
        if cfg.by is not None and cfg.by not in scores:
            raise InputError(f"by = {cfg.by} must be one of {', '.join(scores)}")
    file = output_folder(cfg) / "sweep_table.csv"
    write_text(file, rows.to_csv(index=False))
    table = over_seeds(rows, varied, scores, cfg.by or scores[0])
    print(table.to_string(index=False, float_format="{:.4g}".format))
    print(f"\ntable of all runs: {file}")


def read_cards(places: str | Iterable[str]) -> dict[Path, dict[str, Any]]:
    """The card of every finished run at or below the places, by its folder."""
    cards = {file.parent: load_json(file) for file in find_files(places, CARD)}
    for folder, card in cards.items():
        if not isinstance(card.get("config"), dict):
            raise ValueError(f"{folder / CARD} is not the card of a run: it has no config")
    return cards


def tabulate(cards: Mapping[Path, Mapping[str, Any]]) -> tuple[pd.DataFrame, list[str], list[str]]:
    """A row per run, the settings that differ between runs, and the scores: the numbers in a card's other tables."""
    settings = pd.DataFrame([flatten_settings(card["config"]) for card in cards.values()])
    varied = [name for name in settings if name != "resume" and settings[name].nunique(dropna=False) > 1]
    results = pd.DataFrame(
        dict(
            item for key, table in card.items() if key != "config" and isinstance(table, dict) for item in table.items()
        )
        | {"seconds": card.get("seconds")}
        for card in cards.values()
    ).select_dtypes("number")
    scores = [name for name in results if results[name].nunique(dropna=False) > 1 or len(results) == 1]
    scores = [name for name in scores if results[name].notna().any()]
    if scores in ([], ["seconds"]):
        raise ValueError("runs: their cards have no scores")
    runs = pd.Series([str(folder) for folder in cards], name="run")
    return pd.concat([settings[varied], results[scores], runs], axis=1), varied, scores


def over_seeds(rows: pd.DataFrame, varied: list[str], scores: list[str], by: str) -> pd.DataFrame:
    """Means of the runs that differ in nothing but the seed, from the least `by` to the largest."""
    groups = [name for name in varied if name != "seed"]
    if not groups:
        return rows[[*varied, *scores]].sort_values(by)
    means = rows.groupby(groups, dropna=False)[scores].mean()
    means.insert(0, "runs", rows.groupby(groups, dropna=False).size())
    return means.sort_values(by).reset_index()
