"""Evaluate the user models on unseen people: prediction error by horizon, and the benefit of user adaptation.

    airhockey prediction_report                       20 people, the shipped models
    airhockey prediction_report users.variant=passive      people of another kind
    airhockey prediction_report +preset=smoke         seconds, to see that it runs

Writes into its run folder: prediction.json (every number, with 95 % intervals over people), ahead.png, adaptation.png,
reliability.png, and prediction_report.html.
"""

import base64
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import sha256, write_json, write_text
from airhockey_marl.experiment.html import template
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.registry import construct
from guidance.simulated_users import Population, load_advisors, sample_people
from guidance.simulated_users.force_response import check_variant
from guidance.study.demonstrations import collect_demonstrations
from guidance.study.models import Models
from guidance.study.setup import load_models, load_opponent
from guidance.user_model.data import Demonstrations, action_ahead
from guidance.user_model.evaluation import (
    Predictor,
    adapted_model,
    model_predictor,
    prediction_metrics,
    predictors,
    reliability,
    with_intervals,
)
from guidance.user_model.figures import draw_adaptation, draw_horizons, draw_reliability
from guidance.user_model.maml import parameters
from guidance.user_model.training import adapt_to_user

NAMES = {
    "persistence": "the paddle's place",
    "extrapolation": "the paddle, moved on with its velocity",
    "supervised": "model for people in general",
    "before_ua": "meta-learned model, before UA",
    "after_ua": "meta-learned model, after UA",
}
EVERY = 3  # every so many-th tick, where everybody's model predicts everybody


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for values that cannot be used."""
    require_counts(cfg, "threads", "demonstrations.ticks")
    require_counts(cfg, "participants", "demonstrations.games", least=2)
    require_counts(cfg, "seed", least=0)
    for name, least in (("ahead", 0.0), ("minutes", 0.01), ("steps", 1)):
        if not cfg[name] or not all(isinstance(value, int | float) and value >= least for value in cfg[name]):
            raise InputError(f"{name} = {list(cfg[name])} must be numbers of at least {least}")


def check_amounts(cfg: DictConfig) -> None:
    """Raise where there is not enough play for UA, or for the longest prediction."""
    most = (cfg.demonstrations.games - 1) * cfg.demonstrations.ticks * TableSpec().tick / 60
    if min(cfg.minutes) > most:
        raise InputError(f"minutes = {list(cfg.minutes)} must hold one of at most {most:.3g}, the play there is for UA")
    require_numbers(cfg, "demonstrations.ticks", above=2 * max(cfg.ahead) / TableSpec().tick)


def main(cfg: DictConfig) -> None:
    """Have people play, predict them, and write the report."""
    with report_input_errors():
        check_amounts(cfg)
        check_variant(cfg.users.variant)
        population: Population = construct(Population, cfg.users.population, "users.population")
        advisors = load_advisors(cfg.users.advisors)
        models = load_models(cfg)
        opponent = load_opponent(cfg)
    torch.set_num_threads(cfg.threads)
    progress, table = ProgressBar(), TableSpec()
    people = sample_people(cfg.participants, cfg.seed, population)
    sizes, how = (cfg.demonstrations.games, cfg.demonstrations.ticks), (table, cfg.users.variant, advisors, cfg.seed)
    data = collect_demonstrations(people, opponent, *sizes, *how, partial(progress, "people play"))
    progress("predictions", 0.0)
    found = {
        "ahead": errors_ahead(models, data, list(cfg.ahead), table),
        "matrix": everybody_by_everybody(models, data, table).tolist(),
        "minutes": by_amount(models, data, list(cfg.minutes), table),
        "steps": by_steps(models, data, list(cfg.steps), table),
        "reliability": reliabilities(models, data, table),
    }
    found["own"] = for_whom(np.array(found["matrix"]))
    progress("predictions", 1.0)
    progress.close()
    hashes = {name: sha256(cfg.models[name]) for name in cfg.models}
    facts = {"people": len(people), "models": hashes, "config": OmegaConf.to_container(cfg, resolve=True)}
    write(Path(HydraConfig.get().runtime.output_dir), found, facts)


def known(models: Models, seen: Tensor, action: Tensor, table: TableSpec) -> dict[str, Predictor]:
    """Everybody who predicts one person, knowing one game of theirs (ticks, 12), (ticks, 2)."""
    return predictors(models.user, models.meta, models.inner_lr, seen, action, table, models.ahead)


@torch.no_grad()
def errors_ahead(models: Models, data: Demonstrations, ahead: list[float], table: TableSpec) -> list[dict]:
    """A row per predictor and time ahead: `prediction_metrics` and the gain over extrapolation, with intervals."""
    found: dict[tuple[str, float], list[dict[str, float]]] = {}
    for observation, action in zip(data.observation, data.action, strict=True):
        everybody = known(models, observation[0], action[0], table)
        for name, predictor in everybody.items():
            for seconds in ahead:
                row = prediction_metrics(predictor, observation[-1], action[-1], seconds, table)
                found.setdefault((name, seconds), []).append(row)
    rows = []
    for (name, seconds), people in found.items():
        measures = {key: np.array([person[key] for person in people]) for key in people[0]}
        base = found["extrapolation", seconds]
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
    seen, action = (part[:, :-1].flatten(1, 2) for part in (data.observation, data.action))
    rows = []
    for amount in minutes:
        ticks = round(amount * 60 / table.tick)
        if ticks <= seen.shape[1]:
            rows.append({"minutes": amount, **_after(models, 1, seen[:, :ticks], action[:, :ticks], data, table)})
    return rows


@torch.no_grad()
def by_steps(models: Models, data: Demonstrations, steps: list[int], table: TableSpec) -> list[dict]:
    """Error after UA with the first game, in so many steps."""
    seen, action = data.observation[:, 0], data.action[:, 0]
    return [{"steps": count, **_after(models, count, seen, action, data, table)} for count in steps]


def _after(
    models: Models, steps: int, seen: Tensor, action: Tensor, data: Demonstrations, table: TableSpec
) -> dict[str, dict[str, float]]:
    """Rmse and nll, with intervals, on the last games of models adapted to (people, ticks, .), one after another."""
    people = []
    for person in range(len(seen)):
        at = slice(person, person + 1)
        then = action_ahead(seen[at], action[at], models.ahead, table)
        adapted = adapt_to_user(models.meta, parameters(models.meta), seen[at], then, models.inner_lr, steps)[0]
        predictor = model_predictor(adapted_model(models.meta, adapted), models.ahead)
        people.append(
            prediction_metrics(predictor, data.observation[person, -1], data.action[person, -1], models.ahead, table)
        )
    return with_intervals({key: np.array([person[key] for person in people]) for key in ("rmse", "nll")})


@torch.no_grad()
def reliabilities(models: Models, data: Demonstrations, table: TableSpec) -> dict[str, dict[str, list[float]]]:
    """Of each model, what its STD says in ten bins and what the errors there are, averaged over people."""
    found: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for observation, action in zip(data.observation, data.action, strict=True):
        everybody: dict[str, Predictor] = known(models, observation[0], action[0], table)
        then = action_ahead(observation[-1], action[-1], models.ahead, table)
        for name in ("supervised", "before_ua", "after_ua"):
            found.setdefault(name, []).append(reliability(everybody[name], observation[-1], then))
    return {
        name: {
            key: torch.stack([pair[place] for pair in pairs]).mean(0).tolist()
            for place, key in enumerate(("said", "seen"))
        }
        for name, pairs in found.items()
    }


def write(folder: Path, found: Mapping, facts: Mapping) -> None:
    """Write the numbers, the figures and the page, and print the table of errors."""
    write_json(folder / "prediction.json", {**found, **facts})
    figures = {"ahead": draw_horizons, "adaptation": draw_adaptation, "reliability": draw_reliability}
    images = {}
    for name, draw in figures.items():
        draw(found, NAMES, folder / f"{name}.png")
        images[name] = base64.b64encode((folder / f"{name}.png").read_bytes()).decode("ascii")
    page = template(Path(__file__).parents[1] / "statistics" / "templates", "prediction_report.html")
    write_text(folder / "prediction_report.html", page.render(found=found, facts=facts, names=NAMES, images=images))
    print(f"{'error ahead of time (units of action)':42}" + "".join(f"{s:>14g} s" for s in facts["config"]["ahead"]))
    for name, label in NAMES.items():
        rows = [row["rmse"] for row in found["ahead"] if row["predictor"] == name]
        print(f"{label:42}" + "".join(f"{row['mean']:8.4f} ±{row['high'] - row['mean']:.4f}" for row in rows))
    own = found["own"]["advantage"]
    print(f"\na person's own model errs by {own['mean']:.4f} [{own['low']:.4f}, {own['high']:.4f}] less than another's")
    print(f"report: {folder / 'prediction_report.html'}")
