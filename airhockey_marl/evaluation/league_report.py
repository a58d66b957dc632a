"""The report of a league: who beats whom, ratings, saves, and whether the STD means anything; figures and a page.

`write_report` has a league measured, and writes. What the page says follows from the numbers, whichever way they fall.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.evaluation import figures
from airhockey_marl.evaluation.league_metrics import (
    ATTACKER,
    BELOW,
    KEEPER,
    LATER_THAN,
    EvaluationBudget,
    LeagueMetrics,
    evaluate_league,
)
from airhockey_marl.evaluation.matches import FRAME_SKIP, MatchResult
from airhockey_marl.evaluation.policy_std import FAR, SAVE_SECONDS, STRIKE_SECONDS
from airhockey_marl.evaluation.ratings import Proportion, RatingDifference
from airhockey_marl.experiment.files import atomic_write, write_json, write_text
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
    },
}


def write_report(
    folder: Path | str,
    league: League,
    matches: pd.DataFrame | None,
    card: Mapping[str, Any],
    effort: EvaluationBudget,
    seed: int,
    best_response: Sequence[tuple[int, MatchResult]] | None = None,
    frame_skip: int = FRAME_SKIP,
    progress: Callable[[str, float], None] | None = None,
) -> LeagueMetrics:
    """Measure a league and write league_report.html and .json, payoff.csv, ratings.csv, the figures and match.gif.

    Every file is replaced whole; the page holds its style and its pictures and loads nothing. The same arguments give
    the same bytes.

    Args:
        folder: created if absent.
        matches: those kept during training, see `ratings.MATCHES`; None if there are none.
        card: what the league says of itself; shown as it is.
        best_response: rounds won against the last generation by somebody who learned nothing but that, after so many
            steps; None if it was not tried.
        frame_skip: for which a decision is held, as it was in training.
        progress: told the phase and the share of it that is done.

    Raises:
        ValueError: see `check`.
    """
    folder = Path(folder)
    found = evaluate_league(league, matches, effort, seed, best_response, frame_skip, progress)
    film = figures.film(league, (found.last, found.strongest), seed, frame_skip=frame_skip)
    pictures = draw(found, matches) | {"match.gif": film}
    for name, content in pictures.items():
        with atomic_write(folder / name) as path:
            path.write_bytes(content)
    for name, table in (("payoff.csv", found.payoff_table()), ("ratings.csv", found.ratings_table())):
        with atomic_write(folder / name) as path:
            table.to_csv(path, index=False)
    write_json(folder / "league_report.json", {"seed": seed, "effort": asdict(effort), **found.as_dict()})
    write_text(folder / "league_report.html", page(found, pictures, card, effort, seed))
    return found


def draw(found: LeagueMetrics, matches: pd.DataFrame | None) -> dict[str, bytes]:
    """The figures as PNG, by file name."""
    drawn = {
        "payoff.png": figures.payoff_figure(found.members, found.score),
        "rating.png": figures.rating_figure(found.ratings, found.kept),
        "precision.png": figures.precision_figure(found.std, found.maps, TableSpec()),
    }
    if found.kept is not None:
        drawn["matches.png"] = figures.matches_figure(matches)
    if found.best_response:
        drawn["best_response.png"] = figures.best_response_figure(found.best_response)
    return {name: png_bytes(figure) for name, figure in drawn.items()}


def log_to_tensorboard(writer: SummaryWriter, folder: Path | str, found: LeagueMetrics, step: int) -> None:
    """Log a report that `write_report` has written to `folder`, with the tags of `TAGS`; NaN are left out.

    Args:
        step: of the last generation; those of earlier ones are proportional to their numbers.
    """
    scalars = [
        (f"rating/{row.member}", row.rating, step)
        if isinstance(row.member, str)
        else ("rating/generation", row.rating, round(step * row.member / found.last))
        for row in found.ratings.itertuples()
    ]
    scalars += [(f"save_rate/{name}", share.value, step) for name, share in found.saves.items()]
    scalars += [(f"std/{row.situation.replace(' ', '_')}", row.std, step) for row in found.std.itertuples()]
    for name, value, when in scalars:
        if np.isfinite(value):
            writer.add_scalar(name, value, when)
    for file in ("payoff.png", "rating.png", "precision.png", "match.gif"):
        add_picture(writer, f"report/{file.partition('.')[0]}", (Path(folder) / file).read_bytes(), step)


class Line(NamedTuple):
    """A line of the summary: what was asked, what was observed with its interval, and which way it fell.

    Attributes:
        outcome: "yes", "no", or "open" if the interval allows either.
    """

    question: str
    observed: str
    outcome: str


def summary(found: LeagueMetrics) -> list[Line]:
    """What a league must show, in a few lines."""
    lines = [
        Line(
            f"The last generation ({found.last}) beats {figures.member_label(member)}",
            f"wins {_share(share)} of {share.trials} decided rounds",
            outcome(share.low, share.high, 0.5),
        )
        for member, share in found.against.items()
    ]
    fallen = found.fallen
    if fallen.of:
        observed = (
            f"{len(fallen.below)} of {fallen.of} rated below it, {len(fallen.clear)} by more than a 95 % interval"
        )
        fell = "no" if fallen.clear else "open" if fallen.below else "yes"
        lines.append(Line(f"No generation after {LATER_THAN} is rated below generation {BELOW}", observed, fell))
    own, script = found.saves["last"], found.saves[KEEPER]
    difference = own.minus(script)
    lines.append(
        Line(
            f"It saves more than the scripted {KEEPER}",
            f"saves {_share(own)} of {own.trials} shots, the {KEEPER} {_share(script)} of {script.trials}",
            outcome(*difference[1:]) if own.trials and script.trials else "open",
        )
    )
    for row in found.std[found.std["situation"].str.startswith("before")].itertuples():
        question = f"It is surer {row.situation} than while the puck is far away"
        lines.append(Line(question, _against_far(row), outcome(-row.difference_high, -row.difference_low)))
    return lines


def outcome(low: float, high: float, middle: float = 0.0) -> str:
    """Whether an interval lies above the middle: "yes", "no" if below, "open" if the middle is in it or nothing is."""
    return "yes" if low > middle else "no" if high < middle else "open"


def page(
    found: LeagueMetrics, pictures: Mapping[str, bytes], card: Mapping[str, Any], effort: EvaluationBudget, seed: int
) -> str:
    """Fill the template: here what is shown is chosen, there how it looks and what is said of it.

    Args:
        pictures: by file name.
    """
    rated, place = found.ratings.set_index("member"), found.members.index(found.last)
    learned = found.ratings[[not isinstance(member, str) for member in found.members]]
    in_matrix = {
        member: Proportion.of(won, won + lost)
        for member, (won, lost, _) in zip(found.members, found.score[place], strict=True)
        if member != found.last
    }
    return template(
        Path(__file__).parent / "templates",
        "league_report.html",
        percent=_percent,
        share=_share,
        points=_points,
        against_far=_against_far,
        p=_p,
        named=figures.member_label,
    ).render(
        found=found,
        last=RatingDifference(*rated.loc[found.last]),
        best=int(learned["member"][learned["rating"].idxmax()]),
        best_rating=float(learned["rating"].max()),
        losing_to=[member for member, share in in_matrix.items() if share.high < 0.5],
        undecided=found.score[..., 2].sum() / found.score.sum(),
        save_difference=[100 * end for end in found.saves["last"].minus(found.saves[KEEPER])],
        lines=summary(found),
        outcome=outcome,
        images={name.partition(".")[0]: base64.b64encode(content).decode() for name, content in pictures.items()},
        std=list(found.std.itertuples()),
        attacker=ATTACKER,
        keeper=KEEPER,
        later_than=LATER_THAN,
        below=BELOW,
        save_seconds=SAVE_SECONDS,
        strike_seconds=STRIKE_SECONDS,
        far=FAR,
        effort=asdict(effort),
        seed=seed,
        card=card,
    )


def _percent(value: float, digits: int = 0) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.{digits}f} %"


def _share(share: Proportion) -> str:
    """A share as percents with its interval; in tenths if that is narrow."""
    digits = 1 if share.high - share.low < 0.02 else 0
    ends = f"[{100 * share.low:.{digits}f}, {100 * share.high:.{digits}f}]"
    return f"{_percent(share.value, digits)} {ends}" if share.trials else "–"


def _against_far(row: Any) -> str:
    """A row of `precision.precision` beside that of a puck far away."""
    ends = f"[{number(row.difference_low, 3)}, {number(row.difference_high, 3)}]"
    far = number(row.std - row.difference, 3)
    return f"STD {number(row.std, 3)} against {far}, a difference of {number(row.difference, 3)} {ends}"


def _points(gain: RatingDifference) -> str:
    """Elo points above or below something, without a sign, and the interval in the same direction."""
    side, ends = ("above", gain[1:]) if gain.value >= 0 else ("below", (-gain.high, -gain.low))
    return f"{number(abs(gain.value), 0)} [{', '.join(number(end, 0) for end in ends)}] points {side}"


def _p(value: float) -> str:
    """A p with its sign, without the zero before the point."""
    return "< .001" if value < 0.001 else "= " + f"{value:.3f}".lstrip("0")
