"""Evaluation of predictors of a person's actions: errors, likelihoods and coverage by prediction horizon.

Metrics are per person, so that intervals are over people and not over ticks. Actions and errors are in units of action
(0.075 m of the hand). Play is observations (ticks, 12) and actions (ticks, 2) of one person.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor, nn

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import as_tensor
from guidance.forces.lookahead import PRINTED, moved_state, paddle_as_action
from guidance.user_model.data import Samples, action_ahead, round_starts
from guidance.user_model.maml import forward, parameters
from guidance.user_model.training import adapt_to_user

# Observations (ticks, 12) and a horizon in seconds -> mean and STD (ticks, 2) of the action at that horizon.
Predictor = Callable[[Tensor, float], tuple[Tensor, Tensor]]
SIGMAS = {1: 1 - math.exp(-0.5), 2: 1 - math.exp(-2.0)}  # share of a two-dimensional Gaussian within n STDs


def persistence(observation: Tensor, action: Tensor, table: TableSpec) -> Predictor:
    """The baseline that the hand stays at the paddle's position; its STD is its error on this play."""
    return _with_empirical_std(lambda states, seconds: paddle_as_action(states, table)[0], observation, action, table)


def extrapolation(observation: Tensor, action: Tensor, table: TableSpec) -> Predictor:
    """The baseline that the paddle keeps its velocity; the hand's lead over the paddle is fitted to this play."""
    position, velocity = paddle_as_action(observation, table)
    lead = ((velocity * (action - position)).sum() / velocity.square().sum().clamp(min=1e-9)).item()  # s

    def predict_mean(states: Tensor, seconds: float) -> Tensor:
        position, velocity = paddle_as_action(states, table)
        return (position + (lead + seconds) * velocity).clamp(-1.0, 1.0)

    return _with_empirical_std(predict_mean, observation, action, table)


def ticks_ahead(observation: Tensor, seconds: float, table: TableSpec) -> tuple[Tensor, Tensor]:
    """Ticks (k,) of play (ticks, 12), and the ticks (k,) `seconds` later, where these are in the same round."""
    shift = round(seconds / table.tick)
    round_number = round_starts(observation, table).cumsum(0)
    now = torch.arange(len(observation) - shift)
    now = now[round_number[now] == round_number[now + shift]]
    return now, now + shift


def _with_empirical_std(
    predict_mean: Callable[[Tensor, float], Tensor], observation: Tensor, action: Tensor, table: TableSpec
) -> Predictor:
    """A predictor whose STD is, at each horizon, its root mean square error on the given play."""
    stds: dict[float, Tensor] = {}

    def predict(states: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
        if seconds not in stds:
            now, then = ticks_ahead(observation, seconds, table)
            error = action[then] - predict_mean(observation[now], seconds)
            stds[seconds] = error.square().mean(0).sqrt().clamp(min=1e-4)
        mean = predict_mean(states, seconds)
        return mean, stds[seconds].expand_as(mean)

    return predict


def model_predictor(
    model: Callable[[Tensor], tuple[Tensor, Tensor]], ahead: float = 0.0, reading: str = PRINTED
) -> Predictor:
    """Predict with a model of the action `ahead` s after a state, applied to the looked-ahead state as in Eq. 4.

    `reading`: how the state is moved, see `guidance.forces.lookahead`.
    """
    return lambda observation, seconds: model(moved_state(observation, max(seconds - ahead, 0.0), reading))


def adapted_model(meta: nn.Module, adapted: TensorDict) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """The meta-learned model with one person's parameters: observations (n, 12) to mean and STD (n, 2)."""
    return partial(forward, meta, adapted)


def predictors(
    user: nn.Module,
    meta: nn.Module,
    lr: float,
    observation: Tensor,
    action: Tensor,
    table: TableSpec,
    ahead: float = 0.0,
    reading: str = PRINTED,
) -> dict[str, Predictor]:
    """All predictors of one person, given one game of theirs: two baselines, and the models before and after UA.

    Args:
        user: the model without meta-learning.
        meta: the meta-learned model.
        lr: its inner learning rate.
        observation, action: the game.
        ahead: s, the horizon of both models.
        reading: see `model_predictor`.
    """
    observation, action = as_tensor("observation", observation, 12), as_tensor("action", action, 2)
    target = action_ahead(observation, action, ahead, table)
    adapted = adapt_to_user(meta, parameters(meta), observation[None], target[None], lr)[0]
    return {
        "persistence": persistence(observation, action, table),
        "extrapolation": extrapolation(observation, action, table),
        "supervised": model_predictor(user, ahead, reading),
        "before_ua": model_predictor(meta, ahead, reading),
        "after_ua": model_predictor(adapted_model(meta, adapted), ahead, reading),
    }


def prediction_metrics(
    predictor: Predictor, observation: Tensor, action: Tensor, seconds: float, table: TableSpec
) -> dict[str, float]:
    """Metrics of the prediction of play `seconds` ahead.

    Returns:
        rmse; nll, nats of a two-dimensional Gaussian; loss, Eq. 3; within_1 and within_2, shares of the actions within
        one and two STDs.
    """
    observation, action = as_tensor("observation", observation, 12), as_tensor("action", action, 2)
    now, then = ticks_ahead(observation, seconds, table)
    mean, std = predictor(observation[now], seconds)
    error = action[then] - mean
    squared, variance = error.square().sum(-1), std.square().sum(-1)
    distance = (error / std).square().sum(-1)
    metrics = {
        "rmse": squared.mean().sqrt(),
        "nll": (distance / 2 + std.log().sum(-1)).mean() + math.log(2 * math.pi),
        "loss": (squared / (2 * variance) + variance.log() / 2).mean(),
        **{f"within_{sigma}": (distance <= sigma**2).float().mean() for sigma in SIGMAS},
    }
    return {name: value.item() for name, value in metrics.items()}


def unseen_scores(
    user: nn.Module,
    meta: nn.Module,
    lr: float,
    people: Iterable[tuple[Samples, Samples]],
    ahead: float,
    table: TableSpec,
) -> dict[str, float]:
    """How well play is predicted that the models were not trained on.

    Args:
        user, meta, lr, ahead: see `predictors`.
        people: of each person the game of their UA, and the game that is predicted.

    Returns:
        `<name>_loss` and `<name>_rmse` of each of `predictors`, see `prediction_metrics`, averaged over people.
    """
    results: dict[str, list[float]] = {}
    for demonstration, test in people:
        for name, predictor in predictors(user, meta, lr, *demonstration, table, ahead).items():
            metrics = prediction_metrics(predictor, *test, ahead, table)
            for measure in ("loss", "rmse"):
                results.setdefault(f"{name}_{measure}", []).append(metrics[measure])
    return {name: float(np.mean(values)) for name, values in results.items()}


def reliability(predictor: Predictor, observation: Tensor, action: Tensor, bins: int = 10) -> tuple[Tensor, Tensor]:
    """Norm of the predicted STD and of the errors (bins,) each, as root mean squares.

    Bins hold equally many ticks, from the smallest predicted STD to the largest.
    """
    mean, std = predictor(observation, 0.0)
    variance, squared_error = std.square().sum(-1), (action - mean).square().sum(-1)
    bin_ticks = variance.argsort().tensor_split(bins)
    predicted, observed = (
        torch.stack([values[ticks].mean().sqrt() for ticks in bin_ticks]) for values in (variance, squared_error)
    )
    return predicted, observed


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float, float]:
    """Mean of values (n,), and the ends of Student's confidence interval of it; NaN for n = 1."""
    n = len(values)
    with np.errstate(over="ignore", invalid="ignore"):  # of a model that UA has made diverge
        mean = float(values.mean())
        half = stats.t.ppf(0.5 + confidence / 2, n - 1) * values.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan
    return mean, mean - half, mean + half


def with_intervals(per_person: Mapping[str, np.ndarray]) -> dict[str, dict[str, float | None]]:
    """Mean, low and high of each entry over people; None where not finite, as JSON has no NaN."""
    intervals = {}
    for name, values in per_person.items():
        numbers = zip(("mean", "low", "high"), mean_interval(values), strict=True)
        intervals[name] = {key: number if math.isfinite(number) else None for key, number in numbers}
    return intervals
