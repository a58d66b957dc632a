"""Comparison of algorithms by the leagues that they trained; `commands.compare` says which matches are played."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch
from omegaconf import OmegaConf
from torch import nn

from airhockey_marl.evaluation.matches import RESULT_COLUMNS, MatchResult, match_options, play_matches
from airhockey_marl.experiment.config import read_config
from airhockey_marl.experiment.files import load_json
from airhockey_marl.experiment.html import number
from airhockey_marl.experiment.plotting import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PINK,
    SKY,
    YELLOW,
    label_panel,
    legend_below,
    new_figure,
)
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.league.league import League
from airhockey_marl.players.players import stochastic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEAGUE_FILE, CARD_FILE, CONFIG_FILE = "league.safetensors", "card.json", ".hydra/config.yaml"
SCRIPTS, GENERATION_0 = ("defender", "striker"), "generation 0"
MAX_TABLES = 100  # side by side in a match; more rounds are played one after another
STYLES = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PINK, "D"), (YELLOW, "v"), (SKY, "P"))  # color and marker


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        algorithm: the name, such as TRPO.
        steps: of training per generation.
        seconds: of the whole training, from its card.
        options: how matches are played, see `matches.match_options`.
    """

    folder: Path
    algorithm: str
    seed: int
    league: League
    steps: int
    seconds: float
    options: Mapping[str, Any]

    @property
    def last(self) -> int:
        return len(self.league) - 1


def read_run(folder: Path) -> Run:
    """Read the folder of a finished training run; a ValueError names a file or setting that is missing or broken."""
    for name in (CARD_FILE, CONFIG_FILE):
        if not (folder / name).is_file():
            raise ValueError(f"runs: {folder} is not a finished training run: it has no {name}")
    card, cfg = load_json(folder / CARD_FILE), read_config(folder / CONFIG_FILE)
    keys = ("algorithm.name", "seed", "steps_per_generation", "env.frame_skip")
    settings = [OmegaConf.select(cfg, key) for key in keys]
    missing = [key for key, value in zip(keys, settings, strict=True) if value is None]
    if missing or "seconds" not in card:
        raise ValueError(f"runs: {folder} has no {', '.join(missing or ['seconds'])}")
    name, seed, steps, _ = settings
    league = League.load(folder / LEAGUE_FILE)
    return Run(folder, name.upper(), seed, league, steps, card["seconds"], match_options(cfg.env))


def check_runs(runs: Sequence[Run]) -> None:
    """Raise a ValueError if an algorithm has the same seed twice, or runs differ in the options of their matches."""
    for one, other in itertools.combinations(runs, 2):
        if (one.algorithm, one.seed) == (other.algorithm, other.seed):
            raise ValueError(f"runs: {one.algorithm} with seed {one.seed} twice, in {one.folder} and {other.folder}")
        for name, value in one.options.items():
            if value != (another := other.options[name]):
                raise ValueError(
                    f"runs: env.{name} = {value} in {one.folder}, {another} in {other.folder}, must be equal"
                )


def compare(runs: Sequence[Run], rounds: int, seed: int) -> pd.DataFrame:
    """Play all matches, of `rounds` rounds each, between runs that `check_runs` has accepted.

    Returns:
        A row per match and run in it: algorithm, seed, generation, steps (of training until this generation), opponent
        (a script, "generation 0" of the same run, or an algorithm, whose last generation it is), opponent_seed (of
        an algorithm), won, lost, undecided (rounds), seconds (of the whole run's training).
    """
    rows, progress = [], ProgressBar()

    def add_row(run: Run, generation: int, opponent: str, opponent_seed: int | None, result: MatchResult) -> None:
        player = {"algorithm": run.algorithm, "seed": run.seed, "generation": generation}
        match = {"steps": generation * run.steps, "opponent": opponent, "opponent_seed": opponent_seed}
        rows.append({**player, **match, **result.as_row(), "seconds": run.seconds})

    for done, run in enumerate(runs, 1):
        generations = sorted({run.last * quarter // 4 for quarter in range(5)})
        matches = list(itertools.product(generations, [*SCRIPTS, 0]))
        left, right = (run.league.opponent_batch(player_ids) for player_ids in zip(*matches, strict=True))
        results = play(left, right, len(matches), rounds, seed, run.options)
        for (generation, opponent), result in zip(matches, results, strict=True):
            add_row(run, generation, opponent or GENERATION_0, None, result)
        progress("against scripts and generation 0", done / len(runs))
    pairs = list(itertools.combinations(runs, 2))
    for done, (one, other) in enumerate(pairs, 1):
        left, right = (run.league.player(run.last) for run in (one, other))
        [result] = play(left, right, 1, rounds, seed, one.options)
        add_row(one, one.last, other.algorithm, other.seed, result)
        add_row(other, other.last, one.algorithm, one.seed, MatchResult(result.losses, result.wins, result.draws))
        progress("against each other", done / len(pairs))
    progress.close()
    return pd.DataFrame(rows).astype({"opponent_seed": "Int64"})


def play(
    left: nn.Module, right: nn.Module, matches: int, rounds: int, seed: int, options: Mapping[str, Any]
) -> list[MatchResult]:
    """Results of the left players of matches side by side, of `rounds` rounds each; all sample their actions.

    Either side is a batch of as many players as there are matches, or one policy.
    """
    generator = torch.Generator().manual_seed(seed)
    rounds_per_table = -(-rounds // MAX_TABLES)
    tables = -(-rounds // rounds_per_table)
    players = (stochastic(policy, generator) for policy in (left, right))
    return play_matches(*players, matches, tables, rounds_per_table, seed, **options)


def win_rates(results: pd.DataFrame) -> pd.DataFrame:
    """Win rates among the decided rounds by algorithm, seed, generation, steps and opponent (of any seed)."""
    keys = ["algorithm", "seed", "generation", "steps", "opponent"]
    counts = results.groupby(keys, as_index=False)[list(RESULT_COLUMNS)].sum()
    return counts.assign(win_rate=counts["won"] / (counts["won"] + counts["lost"]))


def screen_table(results: pd.DataFrame) -> str:
    """The last generations' win rates, mean ± SD over seeds, as an aligned text table."""
    algorithms = sorted(results["algorithm"].unique())
    rates = win_rates(results)
    last = rates[rates["generation"] == rates.groupby(["algorithm", "seed"])["generation"].transform("max")]
    runs = results.groupby(["algorithm", "seed"]).agg({"steps": "max", "seconds": "first"})
    others = last[last["algorithm"] != last["opponent"]].groupby(["algorithm", "opponent"])["win_rate"]
    table = others.agg(_spread, digits=2).unstack().reindex(algorithms, columns=[*SCRIPTS, GENERATION_0, *algorithms])
    table.insert(0, "seeds", last.groupby("algorithm")["seed"].nunique())
    table["frames/s"] = (runs["steps"] / runs["seconds"]).groupby("algorithm").agg(_spread, digits=0)
    return table.fillna("–").rename_axis("win rate against").reset_index().to_string(index=False)


def _spread(values: pd.Series, digits: int) -> str:
    """Mean ± SD; without SD for a single value, a dash for none."""
    values = values.dropna()
    if values.empty:
        return "–"
    spread = f" ± {number(values.std(), digits)}" if len(values) > 1 else ""
    return f"{number(values.mean(), digits)}{spread}"


def comparison_figure(results: pd.DataFrame) -> Figure:
    """Win rates against the scripts and generation 0 during training: thin lines are seeds, thick lines their mean."""
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(12, 4.2)
    panels = figure.subplots(1, len(SCRIPTS) + 1, sharey=True)
    algorithms, rates = sorted(results["algorithm"].unique()), win_rates(results)
    styles = dict(zip(algorithms, itertools.cycle(STYLES), strict=False))
    seeds = results.groupby("algorithm")["seed"].nunique()
    for axes, opponent in zip(panels, [*SCRIPTS, GENERATION_0], strict=True):
        for algorithm, (color, mark) in styles.items():
            own = rates[(rates["algorithm"] == algorithm) & (rates["opponent"] == opponent)]
            for _, seed in own.groupby("seed"):
                axes.plot(seed["steps"] / 1e6, seed["win_rate"], color=color, linewidth=0.8, alpha=0.5)
            mean = own.groupby("steps")["win_rate"].mean()
            label = f"{algorithm} ({seeds[algorithm]} seed{'s'[: seeds[algorithm] - 1]})" if axes is panels[0] else None
            style = {"color": color, "linewidth": 2.2, "marker": mark, "markersize": 5}
            axes.plot(mean.index / 1e6, mean, **style, label=label)
        axes.axhline(0.5, color=GRAY, linewidth=0.8, linestyle=":")
        axes.set_ylim(-0.02, 1.02)
        label = "share of decided rounds won" if axes is panels[0] else ""
        axes.xaxis.set_major_locator(MaxNLocator(4))
        label_panel(axes, f"against {opponent}", "steps of play in millions", label)
    legend_below(figure, panels[0].get_legend_handles_labels()[0])
    return figure
