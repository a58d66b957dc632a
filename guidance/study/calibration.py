"""Calibration from unguided play of the training users: opponent, stiffness and thresholds of UT."""

import numpy as np
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
from guidance.study.models import Models
from guidance.user_model.maml import forward_stacked

NEW_ROUND = 0.1  # m; a paddle that moves further in a tick was put back for a new round


def select_opponent(trials: dict[int, dict[str, float]], win_rate: list[float], round_seconds: list[float]) -> int:
    """The newest generation within both ranges.

    Args:
        trials: per generation the `win_rate` of the users and the mean `round_seconds`.

    Raises:
        InputError: no generation is within both.
    """
    generations = [
        generation
        for generation, trial in trials.items()
        if win_rate[0] <= trial["win_rate"] <= win_rate[1]
        and round_seconds[0] <= trial["round_seconds"] <= round_seconds[1]
    ]
    if not generations:
        raise InputError(f"no generation has win_rate in {win_rate} and round_seconds in {round_seconds}: {trials}")
    return max(generations)


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
