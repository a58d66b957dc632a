"""Evaluate the nine conditions of haptic guidance on simulated people: the study of section 4, tests and report.

    python -m guidance.evaluate                                all nine conditions, 20 people
    python -m guidance.evaluate condition=oahg_ut              one of them
    python -m guidance.evaluate -m 'condition=glob(*)'         the nine as nine jobs
    python -m guidance.evaluate beyond=true                    the nine, and two that are not the paper's
    airhockey report runs=outputs/evaluate/...        merge the jobs into one report
    python -m guidance.evaluate +preset=smoke                  seconds, to see that it runs

Writes into its run folder: trials.csv (a row per person and condition), tests.csv (every t, F and post hoc),
figure6.png and .svg, report.html, manifest.json (configuration, seeds, models, versions), and what TensorBoard reads.
"""

import sys
import time
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import (
    ProgressBar,
    command,
    report_input_errors,
    require_counts,
    require_device,
    require_numbers,
)
from airhockey_marl.experiment.files import atomic_write, write_json
from airhockey_marl.experiment.registry import construct
from guidance.simulated_users import Population, load_advisors, sample_people
from guidance.simulated_users.force_response import check_variant
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.histograms import Histograms
from guidance.statistics.report import screen_table, write_report
from guidance.statistics.tensorboard import log_study
from guidance.study.protocol import PAPER_LETTERS, Protocol, is_balanced, williams_design
from guidance.study.provenance import file_hashes, load_conditions, load_models, load_opponent, manifest
from guidance.study.study import run_study


@command("evaluate")
def main(cfg: DictConfig) -> None:
    began = time.perf_counter()
    with report_input_errors():
        require_counts(cfg, "participants", "threads")
        require_counts(cfg, "seed", least=0)
        require_device(cfg)
        require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)
        conditions = load_conditions(cfg)
        protocol: Protocol = construct(Protocol, cfg.study, "study")
        population: Population = construct(Population, cfg.users.population, "users.population")
        models = load_models(cfg, cfg.compute)
        opponent = load_opponent(cfg, cfg.compute)
        people = sample_people(cfg.participants, cfg.seed, population)
        mentors = load_advisors(cfg.users.mentors)
        for name in cfg.users.withdrawn:
            if name not in RATINGS:
                raise ValueError(f"users.withdrawn: {name!r} must be one of {', '.join(RATINGS)}")
        check_variant(cfg.users.variant)
    if not is_balanced(cfg.participants, len(PAPER_LETTERS)):
        rows = len(williams_design(len(PAPER_LETTERS)))
        print(f"note: the order of nine conditions is balanced over multiples of {rows} people", file=sys.stderr)
    torch.set_num_threads(cfg.threads)
    progress, histograms = ProgressBar(), Histograms(conditions, len(people), cfg.guidance.spring.limit)
    trials = run_study(
        people,
        conditions,
        models,
        opponent,
        cfg.guidance.lookahead,
        protocol,
        TableSpec(),
        cfg.users.variant,
        mentors,
        OmegaConf.to_container(cfg.users.scales),
        seed=cfg.seed,
        progress=progress,
        answered=histograms.add,
    )
    progress.close()
    folder = Path(HydraConfig.get().runtime.output_dir)
    with atomic_write(folder / "trials.csv") as temporary:
        trials.to_csv(temporary, index=False)
    command_line = " ".join(["python -m guidance.evaluate", *HydraConfig.get().overrides.task])
    facts = manifest(cfg, file_hashes(cfg, models), command_line, time.perf_counter() - began)
    write_json(folder / "manifest.json", facts)
    tests = write_report(trials, folder, facts)
    log_study(cfg, folder, trials, tests, histograms)
    print(screen_table(trials))
    print("" if facts["frozen"] else "\nNOT the frozen study: its configuration, models or seed differ; exploratory.")
    print(f"report: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
