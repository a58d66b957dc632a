"""The report of a league: metrics, figures, and a page whose sentences follow from the numbers."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.evaluation import figures, league_metrics, policy_std
from airhockey_marl.evaluation.league_metrics import (
    DEFENDER,
    REGRESSION_FROM,
    REGRESSION_REFERENCE,
    EvaluationConfig,
    LeagueMetrics,
    generations_of,
)
from airhockey_marl.evaluation.ratings import Proportion, RatingDifference
from airhockey_marl.experiment.files import write_bytes, write_json, write_text
from airhockey_marl.experiment.html import number, template
from airhockey_marl.experiment.plotting import png_bytes
from airhockey_marl.experiment.tensorboard import add_picture
from airhockey_marl.league.league import League

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

TAGS = {  # x is the number of steps of play
    "rating/*": "Elo points above generation 0, of the generations of the payoff matrix and of the scripts",
    "save_rate/*": "share of the striker's shots that are saved, by the last generation and by the defender",
    "std/*": "mean STD of the last generation's actions, in units of action, by situation",
    "report/*": "pictures: payoff (who beats whom), rating, precision, and match, a film",
}
LAYOUT = {
    "League report": {
        "ratings, in Elo points": [r"rating/.*"],
        "STD by situation, in units of action": [r"std/.*"],
        "share of shots saved": [r"save_rate/.*"],
    }
}


def write_report(
    folder: Path,
    league: League,
    matches: pd.DataFrame | None,
    card: Mapping[str, Any],
    config: EvaluationConfig,
    metrics: LeagueMetrics,
) -> None:
    """Write league_report.html and .json, payoff.csv, ratings.csv, the figures and match.gif.

    Files are replaced atomically. The page embeds its style and pictures and loads nothing. Equal arguments give equal
    bytes.

    Args:
        matches: as for `evaluate_league`, whose result is `metrics`.
        card: the model card, shown on the page.
    """
    players = metrics.last, metrics.strongest_script
    film = figures.film(league, players, config.seed, frame_skip=config.frame_skip, arm=config.arm)
    pictures = draw_figures(metrics, matches) | {"match.gif": film}
    for name, content in pictures.items():
        write_bytes(folder / name, content)
    write_text(folder / "payoff.csv", metrics.payoff_table().to_csv(index=False))
    write_text(folder / "ratings.csv", metrics.ratings_table().to_csv(index=False))
    write_json(folder / "league_report.json", {"config": config.as_dict(), **metrics.as_dict()})
    write_text(folder / "league_report.html", page(metrics, pictures, card, config))


def draw_figures(metrics: LeagueMetrics, matches: pd.DataFrame | None) -> dict[str, bytes]:
    """The figures as PNG, by file name."""
    drawings = {
        "payoff.png": figures.payoff_figure(metrics.player_ids, metrics.score),
        "rating.png": figures.rating_figure(metrics.ratings, metrics.training_ratings),
        "precision.png": figures.precision_figure(metrics.std, metrics.std_maps, TableSpec()),
    }
    if metrics.training_ratings is not None:
        drawings["matches.png"] = figures.win_rates_figure(matches)
    if metrics.best_response:
        drawings["best_response.png"] = figures.best_response_figure(metrics.best_response)
    return {name: png_bytes(figure) for name, figure in drawings.items()}


def log_to_tensorboard(writer: SummaryWriter, folder: Path, metrics: LeagueMetrics, step: int) -> None:
    """Log a report that `write_report` has written to `folder`, with the tags of `TAGS`; NaN and inf are left out.

    Args:
        step: of the last generation; those of earlier ones are proportional to their numbers.
    """
    scalars = [
        (f"rating/{row.member}", row.rating, step)
        if isinstance(row.member, str)
        else ("rating/generation", row.rating, round(step * row.member / metrics.last))
        for row in metrics.ratings.itertuples()
    ]
    scalars += [(f"save_rate/{name}", save_rate.value, step) for name, save_rate in metrics.saves.items()]
    scalars += [(f"std/{row.situation.replace(' ', '_')}", row.std, step) for row in metrics.std.itertuples()]
    for tag, value, scalar_step in scalars:
        if np.isfinite(value):
            writer.add_scalar(tag, value, scalar_step)
    for file in ("payoff.png", "rating.png", "precision.png", "match.gif"):
        add_picture(writer, f"report/{file.partition('.')[0]}", (folder / file).read_bytes(), step)


class Claim(NamedTuple):
    """A row of the summary: a claim, the observation with its interval, and the outcome.

    Attributes:
        outcome: "yes", "no", or "open" if the interval allows either.
    """

    claim: str
    observation: str
    outcome: str


def summary(metrics: LeagueMetrics) -> list[Claim]:
    """The claims about a good league, and whether they hold."""
    claims = [
        Claim(
            f"The last generation ({metrics.last}) beats {figures.member_label(opponent)}",
            f"wins {_proportion(win_rate)} of {win_rate.trials} decided rounds",
            outcome(win_rate.low, win_rate.high, 0.5),
        )
        for opponent, win_rate in metrics.win_rates.items()
    ]
    below, significant, total = metrics.regressions.below, metrics.regressions.significant, metrics.regressions.total
    if total:
        claims.append(
            Claim(
                f"No generation after {REGRESSION_FROM} is rated below generation {REGRESSION_REFERENCE}",
                f"{len(below)} of {total} are rated below it, {len(significant)} by more than the 95 % interval",
                "no" if significant else "open" if below else "yes",
            )
        )
    last, script = metrics.saves["last"], metrics.saves[DEFENDER]
    rates = f"saves {_proportion(last)} of {last.trials} shots, the {DEFENDER} {_proportion(script)} of {script.trials}"
    claims.append(
        Claim(
            f"It saves more shots than the scripted {DEFENDER}",
            rates,
            outcome(*last.difference(script)[1:]) if last.trials and script.trials else "open",
        )
    )
    for row in metrics.std[metrics.std["situation"].str.startswith("before")].itertuples():
        claim = f"Its STD is lower {row.situation} than with the puck far away"
        claims.append(Claim(claim, _std_difference(row), outcome(-row.difference_high, -row.difference_low)))
    return claims


def outcome(low: float, high: float, threshold: float = 0.0) -> str:
    """Whether an interval lies above a threshold: "yes", "no" if below, "open" if it contains it or is NaN."""
    return "yes" if low > threshold else "no" if high < threshold else "open"


def page(
    metrics: LeagueMetrics, pictures: Mapping[str, bytes], card: Mapping[str, Any], config: EvaluationConfig
) -> str:
    """The page, from templates/league_report.html; `pictures` by file name."""
    ratings, row_of_last = metrics.ratings.set_index("member"), metrics.player_ids.index(metrics.last)
    generations = ratings.loc[generations_of(metrics.player_ids), "rating"]
    win_rates = {
        opponent: Proportion.from_counts(wins, wins + losses)
        for opponent, (wins, losses, _) in zip(metrics.player_ids, metrics.score[row_of_last], strict=True)
        if opponent != metrics.last
    }
    return template(
        Path(__file__).parent / "templates",
        "league_report.html",
        percent=_percent,
        proportion=_proportion,
        points=_points,
        std_difference=_std_difference,
        p=_p_value,
        label=figures.member_label,
    ).render(
        metrics=metrics,
        last=RatingDifference(*ratings.loc[metrics.last]),
        best=int(generations.astype(float).idxmax()),
        best_rating=float(generations.max()),
        stronger_opponents=[opponent for opponent, win_rate in win_rates.items() if win_rate.high < 0.5],
        draws=metrics.score[..., 2].sum() / metrics.score.sum(),
        save_difference=[100 * value for value in metrics.saves["last"].difference(metrics.saves[DEFENDER])],
        claims=summary(metrics),
        outcome=outcome,
        images={name.partition(".")[0]: base64.b64encode(content).decode() for name, content in pictures.items()},
        std=list(metrics.std.itertuples()),
        league_metrics=league_metrics,
        policy_std=policy_std,
        config=config.as_dict(),
        card=card,
    )


def _percent(value: float, digits: int = 0) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.{digits}f} %"


def _proportion(value: Proportion) -> str:
    """A proportion in percent with its interval; with a decimal if the interval is narrow."""
    digits = 1 if value.high - value.low < 0.02 else 0
    interval = f"[{100 * value.low:.{digits}f}, {100 * value.high:.{digits}f}]"
    return f"{_percent(value.value, digits)} {interval}" if value.trials else "–"


def _std_difference(row: Any) -> str:
    """A row of `policy_std.std_by_situation` compared with that of a puck far away."""
    interval = f"[{number(row.difference_low, 3)}, {number(row.difference_high, 3)}]"
    far = number(row.std - row.difference, 3)
    return f"STD {number(row.std, 3)} against {far}, a difference of {number(row.difference, 3)} {interval}"


def _points(difference: RatingDifference) -> str:
    """A rating difference in words: positive points above or below, and the interval in the same direction."""
    above = difference.value >= 0
    bounds = difference[1:] if above else (-difference.high, -difference.low)
    interval = ", ".join(number(bound, 0) for bound in bounds)
    return f"{number(abs(difference.value), 0)} [{interval}] points {'above' if above else 'below'}"


def _p_value(value: float) -> str:
    """A p-value with its sign, without the zero before the decimal point."""
    return "< .001" if value < 0.001 else "= " + f"{value:.3f}".lstrip("0")
