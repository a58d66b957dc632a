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

from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import sha256, write_json, write_text
from airhockey_marl.experiment.html import number, template
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import output_folder

NAMES = {
    "persistence": "the paddle's place",
    "extrapolation": "the paddle, moved on with its velocity",
    "supervised": "model for people in general",
    "before_ua": "meta-learned model, before UA",
    "after_ua": "meta-learned model, after UA",
}


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "demonstrations.ticks")
    require_counts(cfg, "participants", "demonstrations.games", least=2)
    for name, least in (("ahead", 0.0), ("minutes", 0.01), ("steps", 1)):
        if not cfg[name] or not all(isinstance(value, int | float) and value >= least for value in cfg[name]):
            raise InputError(f"{name} = {list(cfg[name])} must be numbers of at least {least}")


def main(cfg: DictConfig) -> None:
    import numpy as np

    from airhockey_marl.envs.physics import TableSpec
    from guidance.simulated_users import load_population, sample_people
    from guidance.study import prediction
    from guidance.study.demonstrations import collect_demonstrations
    from guidance.study.setup import load_lookahead, load_models, load_play_setup

    table, sizes = TableSpec(), (cfg.demonstrations.games, cfg.demonstrations.ticks)
    with report_input_errors():
        most = (sizes[0] - 1) * sizes[1] * table.tick / 60
        if min(cfg.minutes) > most:
            raise InputError(f"minutes = {list(cfg.minutes)} must hold one of at most {most:.3g}, the play for UA")
        require_numbers(cfg, "demonstrations.ticks", above=2 * max(cfg.ahead) / table.tick)
        people = sample_people(cfg.participants, cfg.seed, load_population(cfg.users))
        models, lookahead, setup = load_models(cfg), load_lookahead(cfg), load_play_setup(cfg)
    progress = ProgressBar()
    data = collect_demonstrations(people, setup, *sizes, cfg.seed, partial(progress, "people play"))
    progress("predictions", 0.0)
    results = {
        "ahead": prediction.errors_ahead(models, data, list(cfg.ahead), table, lookahead.reading),
        "matrix": prediction.everybody_by_everybody(models, data, table).tolist(),
        "minutes": prediction.by_amount(models, data, list(cfg.minutes), table),
        "steps": prediction.by_steps(models, data, list(cfg.steps), table),
        "reliability": prediction.reliabilities(models, data, table),
    }
    results["own"] = prediction.for_whom(np.array(results["matrix"]))
    progress("predictions", 1.0)
    progress.close()
    hashes = {name: sha256(cfg.models[name]) for name in cfg.models}
    facts = {"people": len(people), "models": hashes, "config": OmegaConf.to_container(cfg, resolve=True)}
    write(output_folder(cfg), results, facts)


def write(folder: Path, results: Mapping, facts: Mapping) -> None:
    """Write the numbers, the figures and the page, and print the table of errors."""
    from guidance.user_model.figures import draw_adaptation, draw_horizons, draw_reliability

    write_json(folder / "prediction.json", {**results, **facts})
    figures = {"ahead": draw_horizons, "adaptation": draw_adaptation, "reliability": draw_reliability}
    images = {}
    for name, draw in figures.items():
        draw(results, NAMES, folder / f"{name}.png")
        images[name] = base64.b64encode((folder / f"{name}.png").read_bytes()).decode("ascii")
    page = template(Path(__file__).parents[1] / "statistics" / "templates", "prediction_report.html")
    write_text(folder / "prediction_report.html", page.render(results=results, facts=facts, names=NAMES, images=images))
    print(f"{'error ahead of time (units of action)':42}" + "".join(f"{s:>14g} s" for s in facts["config"]["ahead"]))
    for name, label in NAMES.items():
        rows = [row["rmse"] for row in results["ahead"] if row["predictor"] == name]
        cells = [(row["mean"], row["high"] and row["high"] - row["mean"]) for row in rows]
        print(f"{label:42}" + "".join(f"{number(mean, 4):>8} ±{number(half, 4):<6}" for mean, half in cells))
    own = results["own"]["advantage"]
    mean, low, high = (number(own[key], 4) for key in ("mean", "low", "high"))
    print(f"\na person's own model errs by {mean} [{low}, {high}] less than another's")
    print(f"report: {folder / 'prediction_report.html'}")
