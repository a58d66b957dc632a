"""Compare algorithms by the leagues they trained: how they play against scripts, their beginnings, and each other.

    python -m airhockey_marl.train -m algorithm=trpo,ppo,sac seed=0,1,2     nine runs, one after another
    airhockey compare runs=outputs/train/<date>/<time>-sweep

Of each run, five generations (the first, the last and the quarters between) play the scripted anchors and their own
generation 0; and the last generations of all runs play each other. All sample their actions, as in training. Writes
comparison.csv, a row per match and side, and comparison.png into its run folder, and prints a table.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import torch
from omegaconf import OmegaConf
from torch import nn

from airhockey_marl.evaluation.matches import MatchResult, play_matches
from airhockey_marl.experiment.command import ProgressBar
from airhockey_marl.experiment.config import read_config
from airhockey_marl.experiment.plotting import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PINK,
    SKY,
    YELLOW,
    label_panel,
    new_figure,
)
from airhockey_marl.league.league import League
from airhockey_marl.players.players import stochastic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEAGUE, CARD, CONFIG = "league.safetensors", "card.json", ".hydra/config.yaml"
SCRIPTS, BEGINNING = ("defender", "striker"), "generation 0"
COUNTS = list(MatchResult._fields)
TABLES = 100  # side by side in a match, where it has as many rounds
STYLES = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PINK, "D"), (YELLOW, "v"), (SKY, "P"))  # color and marker


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        algorithm: the name of the class that trained it, such as TRPO.
        steps: of play in which one generation learned.
        seconds: that the training took, as its card has it.
        frame_skip: for how many ticks its players hold a decision.
    """

    folder: Path
    algorithm: str
    seed: int
    league: League
    steps: int
    seconds: float
    frame_skip: int

    @property
    def last(self) -> int:
        """The number of the last generation."""
        return len(self.league) - 1


def read_run(folder: Path) -> Run:
    """Read a run's folder.

    Raises:
        ValueError: it is not that of a finished training run; says what is amiss.
    """
    for name in (CARD, CONFIG):
        if not (folder / name).is_file():
            raise ValueError(f"runs: {folder} is not a finished training run: it has no {name}")
    try:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
        cfg = read_config(folder / CONFIG)
    except json.JSONDecodeError as error:
        raise ValueError(f"runs: {folder}: {error}") from error
    wanted = ("algorithm.name", "seed", "steps_per_generation", "env.frame_skip")
    settings = [OmegaConf.select(cfg, key) for key in wanted]
    absent = [key for key, value in zip(wanted, settings, strict=True) if value is None]
    if absent or "seconds" not in card:
        raise ValueError(f"runs: {folder} does not tell {', '.join(absent or ['seconds'])}")
    name, seed, steps, frame_skip = settings
    league = League.load(folder / LEAGUE)
    return Run(folder, name.upper(), seed, league, steps, card["seconds"], frame_skip)


def check_runs(runs: Sequence[Run]) -> None:
    """Refuse runs that cannot be compared.

    Raises:
        ValueError: an algorithm has the same seed twice, or decisions are not held alike; says where.
    """
    for one, other in itertools.combinations(runs, 2):
        if (one.algorithm, one.seed) == (other.algorithm, other.seed):
            raise ValueError(f"runs: {one.algorithm} with seed {one.seed} twice, in {one.folder} and {other.folder}")
        if one.frame_skip != other.frame_skip:
            raise ValueError(
                f"runs: decisions last {one.frame_skip} ticks in {one.folder}, {other.frame_skip} in {other.folder}"
            )


def compare(runs: Sequence[Run], rounds: int, seed: int) -> pd.DataFrame:
    """Play all matches.

    Args:
        runs: what `check_runs` has passed.
        rounds: of each match.

    Returns:
        A row per match and run in it: algorithm, seed, generation, steps (of its training until then), opponent
        (a script, "generation 0" of the same run, or an algorithm, whose last generation it is), opponent_seed (of
        an algorithm), won, lost, undecided (rounds), seconds (of the whole run's training).
    """
    rows, progress = [], ProgressBar()

    def note(run: Run, generation: int, opponent: str, opponent_seed: int | None, counts: Sequence[int]) -> None:
        who = {"algorithm": run.algorithm, "seed": run.seed, "generation": generation, "steps": generation * run.steps}
        whom = {"opponent": opponent, "opponent_seed": opponent_seed}
        rows.append({**who, **whom, **dict(zip(COUNTS, counts, strict=True)), "seconds": run.seconds})

    for done, run in enumerate(runs):
        generations = sorted({run.last * quarter // 4 for quarter in range(5)})
        matches = list(itertools.product(generations, [*SCRIPTS, 0]))
        left, right = (run.league.lineup(members) for members in zip(*matches, strict=True))
        scores = play(left, right, len(matches), rounds, seed, run.frame_skip)
        for (generation, opponent), counts in zip(matches, scores, strict=True):
            note(run, generation, opponent or BEGINNING, None, counts)
        progress("against scripts and beginnings", (done + 1) / len(runs))
    pairs = list(itertools.combinations(runs, 2))
    for done, (one, other) in enumerate(pairs):
        left, right = (run.league.player(run.last) for run in (one, other))
        [(won, lost, undecided)] = play(left, right, 1, rounds, seed, one.frame_skip)
        note(one, one.last, other.algorithm, other.seed, (won, lost, undecided))
        note(other, other.last, one.algorithm, one.seed, (lost, won, undecided))
        progress("against each other", (done + 1) / len(pairs))
    progress.close()
    return pd.DataFrame(rows).astype({"opponent_seed": "Int64"})


def play(left: nn.Module, right: nn.Module, matches: int, rounds: int, seed: int, frame_skip: int) -> list[MatchResult]:
    """Matches side by side, of `rounds` rounds each, between policies that sample their actions.

    Args:
        left, right: observations to (mean, STD); line-ups of as many members as there are matches, or for one match
            two models.

    Returns:
        For each match, how the left one fared.
    """
    generator = torch.Generator().manual_seed(seed)
    each = -(-rounds // TABLES)
    players = (stochastic(policy, generator) for policy in (left, right))
    return play_matches(*players, matches, -(-rounds // each), each, seed, frame_skip=frame_skip)


def win_rates(results: pd.DataFrame) -> pd.DataFrame:
    """Shares of decided rounds that were won, by algorithm, seed, generation, steps and opponent of any seed."""
    counts = results.groupby(["algorithm", "seed", "generation", "steps", "opponent"], as_index=False)[COUNTS].sum()
    return counts.assign(win_rate=counts["won"] / (counts["won"] + counts["lost"]))


def screen_table(results: pd.DataFrame) -> str:
    """The last generations' win rates, mean ± SD over seeds, as aligned text for a terminal."""
    algorithms = sorted(results["algorithm"].unique())
    rates = win_rates(results)
    last = rates[rates["generation"] == rates.groupby(["algorithm", "seed"])["generation"].transform("max")]
    runs = results.groupby(["algorithm", "seed"]).agg({"steps": "max", "seconds": "first"})
    speeds = runs["steps"] / runs["seconds"]
    opponents = [*SCRIPTS, BEGINNING, *algorithms]
    cells = [["win rate against", "seeds", *opponents, "frames/s"]]
    for algorithm in algorithms:
        own = last[last["algorithm"] == algorithm]
        row = [own.loc[own["opponent"] == opponent, "win_rate"] for opponent in opponents]
        texts = [
            "–" if opponent == algorithm else _spread(rate, 2) for opponent, rate in zip(opponents, row, strict=True)
        ]
        cells.append([algorithm, str(own["seed"].nunique()), *texts, _spread(speeds[algorithm], 0)])
    widths = [max(len(row[column]) for row in cells) for column in range(len(cells[0]))]
    lines = ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells]
    return "\n".join(lines)


def _spread(values: pd.Series, digits: int) -> str:
    """Mean ± SD; the mean alone of a single value, a dash without any."""
    values = values.dropna()
    if values.empty:
        return "–"
    spread = f" ± {values.std():.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{spread}"


def comparison_figure(results: pd.DataFrame) -> Figure:
    """Win rates against the scripts and generation 0 during training: thin lines are seeds, thick lines their mean."""
    from matplotlib.lines import Line2D

    figure = new_figure(12, 4.2)
    panels = figure.subplots(1, len(SCRIPTS) + 1, sharey=True)
    algorithms, rates = sorted(results["algorithm"].unique()), win_rates(results)
    styles = dict(zip(algorithms, itertools.cycle(STYLES), strict=False))
    for axes, opponent in zip(panels, [*SCRIPTS, BEGINNING], strict=True):
        for algorithm, (color, mark) in styles.items():
            own = rates[(rates["algorithm"] == algorithm) & (rates["opponent"] == opponent)]
            for _, seed in own.groupby("seed"):
                axes.plot(seed["steps"] / 1e6, seed["win_rate"], color=color, linewidth=0.8, alpha=0.5)
            mean = own.groupby("steps")["win_rate"].mean()
            axes.plot(mean.index / 1e6, mean, color=color, linewidth=2.2, marker=mark, markersize=5)
        axes.axhline(0.5, color=GRAY, linewidth=0.8, linestyle=":")
        axes.set_ylim(-0.02, 1.02)
        label = "share of decided rounds won" if axes is panels[0] else ""
        label_panel(axes, f"against {opponent}", "steps of play in millions", label)
    seeds = results.groupby("algorithm")["seed"].nunique()
    labels = [f"{name} ({seeds[name]} seed{'s'[: seeds[name] - 1]})" for name in algorithms]
    legend = [
        Line2D([], [], color=color, marker=mark, linewidth=2.2, label=label)
        for (color, mark), label in zip(styles.values(), labels, strict=True)
    ]
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False, fontsize=9)
    return figure
