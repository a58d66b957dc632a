"""How well models predict people: by whom, how far ahead, what UA adds, and whether the STD is right.

The numbers of `airhockey prediction_report`. Each person's last game is predicted; UA has the games before it.
"""

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from guidance.study.models import Models
from guidance.user_model.data import Demonstrations, action_ahead
from guidance.user_model.evaluation import (
    adapted_model,
    model_predictor,
    prediction_metrics,
    predictors,
    reliability,
    with_intervals,
)
from guidance.user_model.maml import parameters
from guidance.user_model.training import adapt_to_user

EVERY = 3  # every so many-th tick, where everybody's model predicts everybody


@torch.no_grad()
def errors_ahead(
    models: Models, data: Demonstrations, ahead: list[float], table: TableSpec, reading: str
) -> list[dict]:
    """A row per predictor and time ahead: `prediction_metrics` and the gain over extrapolation, with intervals.

    Beyond their own horizon models are evaluated at the state that a `reading` of the look-ahead moves on.
    """
    results: dict[tuple[str, float], list[dict[str, float]]] = {}
    for observation, action in zip(data.observation, data.action, strict=True):
        everybody = predictors(
            models.user, models.meta, models.inner_lr, observation[0], action[0], table, models.ahead, reading
        )
        for name, predictor in everybody.items():
            for seconds in ahead:
                row = prediction_metrics(predictor, observation[-1], action[-1], seconds, table)
                results.setdefault((name, seconds), []).append(row)
    rows = []
    for (name, seconds), people in results.items():
        measures = {key: np.array([person[key] for person in people]) for key in people[0]}
        base = results["extrapolation", seconds]
        with np.errstate(divide="ignore", invalid="ignore"):
            measures["gain"] = 1 - measures["rmse"] / np.array([person["rmse"] for person in base])
        rows.append({"predictor": name, "ahead_s": seconds, **with_intervals(measures)})
    return rows


@torch.no_grad()
def everybody_by_everybody(models: Models, data: Demonstrations, table: TableSpec) -> np.ndarray:
    """(people, people) root mean square error on column's last game of the model adapted to row's first."""
    adapted = models.adapted_to(list(zip(data.observation[:, 0], data.action[:, 0], strict=True)))
    observation = data.observation[:, -1]
    action = action_ahead(observation, data.action[:, -1], models.ahead, table)[:, ::EVERY]
    observation, rows = observation[:, ::EVERY], []
    for own in adapted:
        mean, _ = adapted_model(models.meta, own)(observation.flatten(0, 1))
        error = action - mean.unflatten(0, action.shape[:2])
        rows.append(error.square().sum(-1).mean(-1).sqrt())
    return torch.stack(rows).numpy()


def for_whom(matrix: np.ndarray) -> dict[str, dict[str, float]]:
    """Errors of a person's own model, of the others' models on them, and by how much their own is better."""
    others = (matrix.sum(axis=0) - matrix.diagonal()) / (len(matrix) - 1)
    own = matrix.diagonal()
    return with_intervals({"own": own, "others": others, "advantage": others - own})


@torch.no_grad()
def by_amount(models: Models, data: Demonstrations, minutes: list[float], table: TableSpec) -> list[dict]:
    """Error after UA with so many minutes of the games before the last, as far as they go."""
    observation, action = (part[:, :-1].flatten(1, 2) for part in (data.observation, data.action))
    rows = []
    for amount in minutes:
        ticks = round(amount * 60 / table.tick)
        if ticks <= observation.shape[1]:
            rows.append(
                {"minutes": amount, **_after(models, 1, observation[:, :ticks], action[:, :ticks], data, table)}
            )
    return rows


@torch.no_grad()
def by_steps(models: Models, data: Demonstrations, steps: list[int], table: TableSpec) -> list[dict]:
    """Error after UA with the first game, in so many steps."""
    game = data.observation[:, 0], data.action[:, 0]
    return [{"steps": count, **_after(models, count, *game, data, table)} for count in steps]


def _after(
    models: Models, steps: int, observation: Tensor, action: Tensor, data: Demonstrations, table: TableSpec
) -> dict[str, dict[str, float]]:
    """Rmse and nll, with intervals, on the last games of models adapted to (people, ticks, .), one after another."""
    people = []
    for person in range(len(observation)):
        at = slice(person, person + 1)
        then = action_ahead(observation[at], action[at], models.ahead, table)
        adapted = adapt_to_user(models.meta, parameters(models.meta), observation[at], then, models.inner_lr, steps)[0]
        predictor = model_predictor(adapted_model(models.meta, adapted), models.ahead)
        people.append(
            prediction_metrics(predictor, data.observation[person, -1], data.action[person, -1], models.ahead, table)
        )
    return with_intervals({key: np.array([person[key] for person in people]) for key in ("rmse", "nll")})


@torch.no_grad()
def reliabilities(models: Models, data: Demonstrations, table: TableSpec) -> dict[str, dict[str, list[float]]]:
    """Of each model, what its STD says in ten bins and what the errors there are, averaged over people."""
    results: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for observation, action in zip(data.observation, data.action, strict=True):
        everybody = predictors(
            models.user, models.meta, models.inner_lr, observation[0], action[0], table, models.ahead
        )
        then = action_ahead(observation[-1], action[-1], models.ahead, table)
        for name in ("supervised", "before_ua", "after_ua"):
            results.setdefault(name, []).append(reliability(everybody[name], observation[-1], then))
    return {
        name: {
            key: torch.stack([pair[place] for pair in pairs]).mean(0).tolist()
            for place, key in enumerate(("said", "seen"))
        }
        for name, pairs in results.items()
    }
