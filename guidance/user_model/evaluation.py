"""How well a person's actions are predicted, ahead of time and by whom: errors, likelihoods, coverage.

Everything is computed person by person, so that intervals are over people and not over ticks. Actions and errors are
in units of action (0.075 m of the hand).
"""

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor, nn

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.experiment.validation import CPU, check_arrays, check_counts, check_numbers, check_tensors
from guidance.forces.equations import lookahead_state
from guidance.user_model.maml import forward, parameters
from guidance.user_model.rounds import action_ahead, round_begins
from guidance.user_model.training import adapt_to_user

# Observations (ticks, 12) and seconds ahead -> mean and STD (ticks, 2) of the action then.
Predictor = Callable[[Tensor, float], tuple[Tensor, Tensor]]
SIGMAS = {1: 1 - math.exp(-0.5), 2: 1 - math.exp(-2.0)}  # share of a two-dimensional Gaussian within so many STDs


def paddle(observation: Tensor, table: TableSpec) -> tuple[Tensor, Tensor]:
    """Place (..., 2) of the own paddle in units of action, and its velocity (..., 2) per second."""
    check_tensors(CPU, observation=(observation, "... 12"))
    middle, half = (torch.tensor(part, dtype=observation.dtype) for part in action_range(table))
    return (observation[..., 0:2] - middle) / half, observation[..., 2:4] / half


def persistence(observation: Tensor, action: Tensor, table: TableSpec) -> Predictor:
    """Whoever says that the hand stays where the paddle is; its STD is what that is worth on this play."""
    check_tensors(CPU, observation=(observation, "ticks 12"), action=(action, "ticks 2"))
    return _baseline(lambda seen, seconds: paddle(seen, table)[0], observation, action, table)


def extrapolation(observation: Tensor, action: Tensor, table: TableSpec) -> Predictor:
    """Whoever moves the paddle on with its velocity; its lead on the paddle is fitted to this play (ticks, .)."""
    check_tensors(CPU, observation=(observation, "ticks 12"), action=(action, "ticks 2"))
    place, velocity = paddle(observation, table)
    lead = ((velocity * (action - place)).sum() / velocity.square().sum().clamp(min=1e-9)).item()  # s

    def guess(seen: Tensor, seconds: float) -> Tensor:
        place, velocity = paddle(seen, table)
        return (place + (lead + seconds) * velocity).clamp(-1.0, 1.0)

    return _baseline(guess, observation, action, table)


def ahead(observation: Tensor, seconds: float, table: TableSpec) -> tuple[Tensor, Tensor]:
    """Ticks (k,) of one person's play (ticks, 12), and the ticks (k,) `seconds` after them, in the same round."""
    check_tensors(CPU, observation=(observation, "ticks 12"))
    check_numbers(0.0, at_most=len(observation) * table.tick, seconds=seconds)
    then = round(seconds / table.tick)
    number = round_begins(observation, table).cumsum(0)
    now = torch.arange(len(observation) - then)
    now = now[number[now] == number[now + then]]
    return now, now + then


def _baseline(guess: Callable[[Tensor, float], Tensor], seen: Tensor, action: Tensor, table: TableSpec) -> Predictor:
    """A guess, with one STD for each time ahead: its root mean square error on the play given."""
    spread: dict[float, Tensor] = {}

    def predict(observation: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
        if seconds not in spread:
            now, then = ahead(seen, seconds, table)
            error = action[then] - guess(seen[now], seconds)
            spread[seconds] = error.square().mean(0).sqrt().clamp(min=1e-4)
        mean = guess(observation, seconds)
        return mean, spread[seconds].expand_as(mean)

    return predict


def by_model(model: Callable[[Tensor], tuple[Tensor, Tensor]], ahead: float = 0.0) -> Predictor:
    """A model of the action `ahead` s after a state, asked about a looked-ahead state as a guidance asks it (Eq. 4)."""
    check_numbers(0.0, ahead=ahead)
    return lambda observation, seconds: model(lookahead_state(observation, max(seconds - ahead, 0.0)))


def adapted_model(meta: nn.Module, adapted: TensorDict) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """The meta-learned model with one person's parameters: observations (n, 12) to mean and STD (n, 2)."""
    return partial(forward, meta, adapted)


def predictors(
    user: nn.Module, meta: nn.Module, lr: float, seen: Tensor, action: Tensor, table: TableSpec, ahead: float = 0.0
) -> dict[str, Predictor]:
    """Everybody who predicts one person, knowing one game of theirs (ticks, 12), (ticks, 2).

    The models are asked for the action `ahead` s after a state.
    """
    check_tensors(CPU, seen=(seen, "ticks 12"), action=(action, "ticks 2"))
    check_numbers(0.0, ahead=ahead)
    then = action_ahead(seen, action, ahead, table)
    adapted = adapt_to_user(meta, parameters(meta), seen[None], then[None], lr)[0]
    return {
        "persistence": persistence(seen, action, table),
        "extrapolation": extrapolation(seen, action, table),
        "supervised": by_model(user, ahead),
        "before_ua": by_model(meta, ahead),
        "after_ua": by_model(adapted_model(meta, adapted), ahead),
    }


def judge(
    predictor: Predictor, observation: Tensor, action: Tensor, seconds: float, table: TableSpec
) -> dict[str, float]:
    """How one person's play (ticks, 12), (ticks, 2) is predicted `seconds` ahead.

    Returns:
        rmse; nll, nats of a two-dimensional Gaussian; loss, Eq. 3; within_1 and within_2, shares of the actions within
        so many STDs.
    """
    check_tensors(CPU, observation=(observation, "ticks 12"), action=(action, "ticks 2"))
    now, then = ahead(observation, seconds, table)
    mean, std = predictor(observation[now], seconds)
    error = action[then] - mean
    squared, variance = error.square().sum(-1), std.square().sum(-1)
    distance = (error / std).square().sum(-1)
    found = {
        "rmse": squared.mean().sqrt(),
        "nll": (distance / 2 + std.log().sum(-1)).mean() + math.log(2 * math.pi),
        "loss": (squared / (2 * variance) + variance.log() / 2).mean(),
        **{f"within_{sigma}": (distance <= sigma**2).float().mean() for sigma in SIGMAS},
    }
    return {name: value.item() for name, value in found.items()}


def reliability(predictor: Predictor, observation: Tensor, action: Tensor, bins: int = 10) -> tuple[Tensor, Tensor]:
    """Said and seen (bins,): norms of the predicted STD, and of the errors there, each a root mean square.

    Bins hold as many ticks each, from the surest to the least sure.
    """
    check_tensors(CPU, observation=(observation, "ticks 12"), action=(action, "ticks 2"))
    check_counts(bins=bins)
    mean, std = predictor(observation, 0.0)
    said, seen = std.square().sum(-1), (action - mean).square().sum(-1)
    order = said.argsort()
    parts = [(said[part].mean().sqrt(), seen[part].mean().sqrt()) for part in order.tensor_split(bins)]
    return torch.stack([said for said, _ in parts]), torch.stack([seen for _, seen in parts])


def interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float, float]:
    """Mean over people, and Student's interval of it."""
    values = np.asarray(values)
    check_arrays(values=(values, "n"))
    check_numbers(above=0.0, at_most=1.0, confidence=confidence)
    mean, n = float(values.mean()), len(values)
    half = stats.t.ppf(0.5 + confidence / 2, n - 1) * values.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan
    return mean, mean - half, mean + half


def with_intervals(per_person: Mapping[str, np.ndarray]) -> dict[str, dict[str, float | None]]:
    """Mean, low and high of each entry; None where they are not finite, as JSON knows no other word for it."""
    found = {}
    for name, values in per_person.items():
        numbers = zip(("mean", "low", "high"), interval(values), strict=True)
        found[name] = {key: number if math.isfinite(number) else None for key, number in numbers}
    return found
