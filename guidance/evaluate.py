"""Evaluate the nine conditions of haptic guidance on simulated people: the study of section 4, tests and report.

    python -m guidance.evaluate                                all nine conditions, 20 people
    python -m guidance.evaluate condition=oahg_ut              one of them
    python -m guidance.evaluate -m 'condition=glob(*)'         the nine as nine jobs
    python -m guidance.evaluate beyond=true                    the nine, and two that are not the paper's
    python -m guidance.report runs=outputs/evaluate/...        merge the jobs into one report
    python -m guidance.evaluate +preset=smoke                  seconds, to see that it runs

Writes into its run folder: trials.csv (a row per person and condition), tests.csv (every t, F and post hoc),
figure6.png and .svg, report.html, and manifest.json (configuration, seeds, models, versions).
"""

import hashlib
import json
import time
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.cli import CONF, ProgressBar, command, input_errors, require_counts, require_numbers
from airhockey_marl.files import replacing, sha256, write_json
from airhockey_marl.inference import steady
from airhockey_marl.league import League
from airhockey_marl.table import Table
from guidance.conditions import Condition
from guidance.games import Protocol
from guidance.models import Models
from guidance.report import screen_table, write_report
from guidance.study import run_study
from guidance.users import Population, load_mentors, sample_people
from guidance.users.rating import RATINGS
from guidance.users.reaction import check_variant

FROZEN = Path(__file__).parent / "frozen.json"  # study_hash and seed of the study
NOT_THE_STUDY = ("condition", "beyond", "models", "seed", "threads")  # models are hashed themselves
VERSIONS = ("torch", "tensordict", "torchrl", "numba", "numpy", "scipy", "pandas", "pingouin")


def chosen_conditions(cfg: DictConfig) -> list[Condition]:
    """The condition of the configuration; without one, all of `conf/condition`, in the order of their letters.

    With `beyond` those of `conf/condition/beyond` as well, which are not the paper's.
    """
    if cfg.get("condition") is not None:
        return [hydra.utils.instantiate(cfg.condition)]
    nodes = [OmegaConf.load(path) for path in (CONF / "condition").glob("**/*.yaml" if cfg.get("beyond") else "*.yaml")]
    for node in nodes:
        node._set_parent(cfg)  # what a condition refers to, as ${guidance.spring}, is in the configuration
    conditions = sorted((hydra.utils.instantiate(node) for node in nodes), key=lambda condition: condition.letter)
    for one, other in pairwise(conditions):
        if one.letter == other.letter:
            raise ValueError(f"condition.letter = {one.letter} is that of {one.name} and of {other.name}")
    return conditions


@command("evaluate")
def main(cfg: DictConfig) -> None:
    began = time.perf_counter()
    with input_errors():
        require_counts(cfg, "participants", "threads")
        require_counts(cfg, "seed", least=0)
        require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)
        conditions = chosen_conditions(cfg)
        protocol: Protocol = hydra.utils.instantiate(cfg.study)
        population: Population = hydra.utils.instantiate(cfg.users.population)
        models = Models.load(cfg.models.league, cfg.models.generation, cfg.models.user, cfg.models.meta)
        opponent = steady(League.load(cfg.models.opponents).player(cfg.opponent))
        people = sample_people(cfg.participants, cfg.seed, population)
        mentors = load_mentors(cfg.users.mentors)
        for name in cfg.users.withdrawn:
            if name not in RATINGS:
                raise ValueError(f"users.withdrawn: {name!r} must be one of {', '.join(RATINGS)}")
        check_variant(cfg.users.variant)
    torch.set_num_threads(cfg.threads)
    progress = ProgressBar()
    trials = run_study(
        people,
        conditions,
        models,
        opponent,
        cfg.guidance.lookahead,
        protocol,
        Table(),
        cfg.users.variant,
        mentors,
        OmegaConf.to_container(cfg.users.scales),
        seed=cfg.seed,
        progress=progress,
    )
    progress.close()
    folder = Path(HydraConfig.get().runtime.output_dir)
    with replacing(folder / "trials.csv") as temporary:
        trials.to_csv(temporary, index=False)
    command_line = " ".join(["python -m guidance.evaluate", *HydraConfig.get().overrides.task])
    facts = manifest(cfg, hashes_of(cfg, models), command_line, time.perf_counter() - began)
    write_json(folder / "manifest.json", facts)
    write_report(trials, folder, facts)
    print(screen_table(trials))
    print("" if facts["frozen"] else "\nNOT the frozen study: its configuration, models or seed differ; exploratory.")
    print(f"report: {folder / 'report.html'}")


def hashes_of(cfg: DictConfig, models: Models) -> dict[str, str]:
    """SHA-256 of every file that a study rests on, by what it is for."""
    files = {"opponents": cfg.models.opponents, "mentors": cfg.users.mentors}
    return models.hashes | {name: sha256(path) for name, path in files.items() if path is not None}


def manifest(cfg: DictConfig, hashes: dict[str, str], command_line: str, seconds: float) -> dict:
    """What a result came from.

    `study_hash` is the same for runs that may be merged: all but seed and condition. `frozen` says whether it is, with
    the seed, that of the study which was fixed before any condition was compared.
    """
    config = OmegaConf.to_container(cfg, resolve=True)
    shared = {
        key: value for key, value in config.items() if key not in ("condition", "beyond", "models", "seed", "threads")
    }
    shared["users"] = {key: value for key, value in shared["users"].items() if key != "mentors"}  # hashed, like models
    digest = hashlib.sha256(json.dumps([shared, hashes], sort_keys=True).encode()).hexdigest()
    fixed = json.loads(FROZEN.read_text(encoding="utf-8"))
    return {
        "command": command_line,
        "seed": cfg.seed,
        "study_hash": digest,
        "frozen": (digest, cfg.seed) == (fixed["study_hash"], fixed["seed"]),
        "models": hashes,
        "versions": {name: version(name) for name in VERSIONS},
        "seconds": round(seconds, 1),
        "config": config,
    }


if __name__ == "__main__":
    main()
