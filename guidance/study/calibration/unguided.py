"""Calibration from unguided play of the training users: opponent, stiffness and thresholds of UT."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from scipy.optimize import brentq
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.evaluation.matches import play_rounds
from airhockey_marl.experiment.command import InputError
from airhockey_marl.players.players import Player
from guidance.forces.conditions import ADAPTED, OPTIMAL
from guidance.forces.equations import uncertainty_weight
from guidance.forces.lookahead import Lookahead
from guidance.study.games import Games, no_force, play_games
from guidance.study.models import Models
from guidance.study.protocol import Protocol, user_and_table_states
from guidance.study.setup import PlaySetup
from guidance.user_model.maml import forward_stacked

NEW_ROUND = 0.1  # m; a paddle that moves further in a tick was put back for a new round


@dataclass(frozen=True)
class UnguidedPlay:
    """The training users, who play without guidance.

    Attributes:
        people: (users,) the training users.
        setup: their table and response to a force; the opponent is given to each call.
        protocol: the course of a game.
        games: that each of them plays.
        seed: every random number follows from it.
    """

    people: np.ndarray
    setup: PlaySetup
    protocol: Protocol
    games: int
    seed: int

    def play(self, opponent: Player, trial: int, demonstrations: bool = False) -> Games:
        """`games` games of each, person by person; `trial` stands in the seeds where a study has its condition."""
        states = [user_and_table_states(self.seed, range(len(self.people)), trial + game) for game in range(self.games)]
        users, tables = (np.stack(part, axis=1).ravel() for part in zip(*states, strict=True))
        participants = self.setup.simulated_users(np.repeat(self.people, self.games), users)
        return play_games(participants, opponent, no_force, self.protocol, self.setup.table, tables, demonstrations)

    def against(self, opponents: dict[int, Player], trial: int, progress: Callable[[float], None]) -> pd.DataFrame:
        """Per `generation` of `opponents` the users' `win_rate` and the mean `round_seconds`."""
        rows = []
        for generation, opponent in opponents.items():
            games = self.play(opponent, trial)
            win_rate, seconds = np.nanmean(games.results["win_rate"]), games.seconds.sum() / games.rounds.sum()
            rows.append({"generation": generation, "win_rate": win_rate, "round_seconds": seconds})
            progress(len(rows) / len(opponents))
        return pd.DataFrame(rows)


def select_opponent(trials: pd.DataFrame, win_rate: Iterable[float], round_seconds: Iterable[float]) -> int:
    """The newest generation within both ranges.

    Args:
        trials: see `UnguidedPlay.against`.

    Raises:
        InputError: no generation is within both.
    """
    win_rate, round_seconds = list(win_rate), list(round_seconds)
    fits = trials["win_rate"].between(*win_rate) & trials["round_seconds"].between(*round_seconds)
    if not fits.any():
        rows = trials.to_dict("records")
        raise InputError(f"no generation has win_rate in {win_rate} and round_seconds in {round_seconds}: {rows}")
    return int(trials.loc[fits, "generation"].max())


@torch.no_grad()
def target_lead(
    models: Models, demonstrations: list[tuple[Tensor, Tensor]], games: int, lookahead: Lookahead
) -> np.ndarray:
    """Lead (users,) of UPHG's target (UA) over the hand, in s: the slope of their distance over the hand's velocity.

    Args:
        demonstrations: user by user, `games` games each; the first of each is for UA.
    """
    adapted, tick, leads = models.adapted_to(demonstrations[::games]), TableSpec().tick, []
    for person in range(len(adapted)):
        distances, velocities = [], []
        for observation, action in demonstrations[person * games + 1 : (person + 1) * games]:
            anticipated = models.lookahead_state(ADAPTED, observation[1:], lookahead)
            output = forward_stacked(models.meta, adapted[person : person + 1], anticipated[None])[0][0]
            hand, velocity = action[:-1], action.diff(dim=0) / tick
            target = models.target(ADAPTED, hand, output, observation[1:], lookahead)
            in_one_round = (observation.diff(dim=0)[:, :2].norm(dim=1) < NEW_ROUND)[:, None]
            distances.append((target - hand) * in_one_round)
            velocities.append(velocity * in_one_round)
        distance, velocity = torch.cat(distances), torch.cat(velocities)
        leads.append(((distance * velocity).sum() / velocity.square().sum()).item())
    return np.array(leads)


def lookahead_win_rate(models: Models, opponent: Player, lookahead: Lookahead, seed: int) -> float:
    """Share of decided rounds that the optimal action model wins when it acts on the looked-ahead state.

    Reported only; no parameter is set by it. It bounds what OAHG can achieve with this look-ahead.
    """

    def player(observation: Tensor) -> Tensor:
        return models.optimal(models.lookahead_state(OPTIMAL, observation, lookahead))[0]

    won, lost, _ = play_rounds(player, opponent, 100, 4, seed, frame_skip=1).sum(axis=0)
    return float(won / (won + lost))


def max_stable_stiffness(lead: np.ndarray, damping: np.ndarray, share: float, of_people: float, step: float) -> float:
    """The largest K for which K * lead <= share * damping holds for a share `of_people` of the users.

    Args:
        lead: (users,) s.
        damping: (users,) N s/m, of arm and device.
        step: N/m, of which K is a multiple.
    """
    stiffness = np.where(lead > 0, share * damping / np.maximum(lead, 1e-12), np.inf)
    return float(step * np.floor(np.quantile(stiffness, 1 - of_people, method="lower") / step))


@torch.no_grad()
def predicted_std(
    models: Models, demonstrations: list[tuple[Tensor, Tensor]], games: int, lookahead: Lookahead
) -> dict[str, Tensor]:
    """STD (ticks, 2) of the optimal and of the adapted user model.

    Args:
        demonstrations: user by user, `games` games each; the first of each is for UA and left out.
    """
    adapted = models.adapted_to(demonstrations[::games])
    optimal, user = [], []
    for i, (observation, _) in enumerate(demonstrations):
        if i % games:
            optimal.append(models.optimal(models.lookahead_state(OPTIMAL, observation, lookahead))[1])
            anticipated = models.lookahead_state(ADAPTED, observation, lookahead)
            user.append(forward_stacked(models.meta, adapted[i // games : i // games + 1], anticipated[None])[1][0])
    return {"optimal": torch.cat(optimal), "user": torch.cat(user)}


def former_rule(
    models: Models,
    demonstrations: list[tuple[Tensor, Tensor]],
    games: int,
    people: np.ndarray,
    lookaheads: Iterable[Lookahead],
    opponent: Player,
    rule: Mapping[str, float],
    seed: int,
) -> list[dict[str, float]]:
    """The former rule: for each look-ahead the largest K that leaves the hands of `people` (users,) damped.

    Args:
        demonstrations: user by user, `games` games each; the first of each is for UA.
        rule: `share`, `of_people` and `step` of `max_stable_stiffness`.

    Returns:
        Rows with `lookahead` in s, the mean `lead` of UPHG's target in s, `stiffness` in N/m, and `optimal_wins`, see
        `lookahead_win_rate`.
    """
    damping, rows = people["stiffness"] * people["damping_time"] + people["device_damping"], []
    for lookahead in lookaheads:
        lead = target_lead(models, demonstrations, games, lookahead)
        rows.append(
            {
                "lookahead": lookahead.seconds,
                "lead": round(float(lead.mean()), 4),
                "stiffness": max_stable_stiffness(lead, damping, **rule),
                "optimal_wins": round(lookahead_win_rate(models, opponent, lookahead, seed), 3),
            }
        )
    return rows


def thresholds(
    models: Models,
    demonstrations: list[tuple[Tensor, Tensor]],
    games: int,
    lookahead: Lookahead,
    mean_weights: Mapping[str, float],
    low_over_high: float,
) -> dict[str, dict[str, float]]:
    """The thresholds of UT for the `optimal` and the `user` model, see `threshold` and `predicted_std`."""
    stds = predicted_std(models, demonstrations, games, lookahead)
    return {name: threshold(std, mean_weights[name], low_over_high) for name, std in stds.items()}


def threshold(std: Tensor, mean_weight: float, low_over_high: float) -> dict[str, float]:
    """T_low and T_high for which the mean W_unc (Eq. 5) of STDs (n, 2) is `mean_weight`."""
    squared = std.double().square().sum(-1)

    def excess(log_high: float) -> float:
        high = float(np.exp(log_high))
        return uncertainty_weight(std.double(), low_over_high * high, high).mean().item() - mean_weight

    ends = np.log(squared.min().item() / 2), np.log(squared.max().item() / low_over_high * 2)
    high = float(np.exp(brentq(excess, *ends)))
    weight = uncertainty_weight(std.double(), low_over_high * high, high)
    return {
        "low": float(f"{low_over_high * high:.4g}"),
        "high": float(f"{high:.4g}"),
        "mean_w_unc": round(weight.mean().item(), 3),
        "sd_w_unc": round(weight.std().item(), 3),
    }
