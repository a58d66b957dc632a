"""Evaluate the nine conditions of haptic guidance on simulated people: the study of section 4, tests and report.

    airhockey evaluate                                all nine conditions, 20 people
    airhockey evaluate condition=oahg_ut              one of them
    airhockey evaluate -m 'condition=glob(*)'         the nine as nine jobs, each of people who know none of the others
    airhockey evaluate 'beyond=[product]'             the nine, and one that is not the paper's
    airhockey report runs=outputs/evaluate/...        merge the jobs into one report
    airhockey evaluate +preset=smoke                  seconds, to see that it runs

Writes into its run folder: trials.csv (a row per person and condition), tests.csv (every t, F and post hoc),
figure6.png and .svg, report.html, manifest.json (configuration, seeds, models, versions), and TensorBoard's files; for
other programs trials_wide.csv (a row per person), counts.csv (rounds, shots, smashes) and codebooks (trials.json,
counts.json).
"""

import sys
import time

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts
from airhockey_marl.experiment.files import write_json, write_text
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import command_line, note_headline, output_folder


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "participants")


def main(cfg: DictConfig) -> None:
    from guidance.forces.condition_specs import PAPER_LETTERS
    from guidance.simulated_users import load_population, sample_people
    from guidance.simulated_users.ratings import RATINGS
    from guidance.statistics.codebook import tables_beside
    from guidance.statistics.groups import UNTESTED
    from guidance.statistics.report import screen_table, write_report
    from guidance.statistics.tensorboard import Histograms, log_study
    from guidance.study.protocol import balance_note
    from guidance.study.setup import file_hashes, load_setup, manifest
    from guidance.study.study import run_study

    start = time.perf_counter()
    with report_input_errors():
        setup = load_setup(cfg)
        people = sample_people(cfg.participants, cfg.seed, load_population(cfg.users))
        for name in cfg.users.withdrawn:
            if name not in RATINGS:
                raise ValueError(f"users.withdrawn: {name!r} must be one of {', '.join(RATINGS)}")
    paper = sum(condition.letter in PAPER_LETTERS for condition in setup.conditions)
    if note := balance_note(cfg.participants, paper, len(setup.conditions) - paper):
        print(f"note: {note}", file=sys.stderr)
    progress, histograms = ProgressBar(), Histograms(setup.conditions, len(people), cfg.guidance.spring.limit)
    trials, counts = run_study(people, setup, seed=cfg.seed, progress=progress, on_forces=histograms.add)
    progress.close()
    folder = output_folder(cfg)
    write_text(folder / "trials.csv", trials.to_csv(index=False))
    facts = manifest(cfg, file_hashes(cfg, setup.models), command_line(), time.perf_counter() - start)
    write_json(folder / "manifest.json", facts)
    group = write_report(trials, folder, facts)
    for name, content in tables_beside(trials, counts, group.conditions, facts).items():
        write_text(folder / name, content)
    log_study(cfg, folder, group, histograms)
    outcomes = group.findings["outcome"]
    if tested := (~outcomes.isin(UNTESTED)).sum():
        note_headline(folder, f"{(outcomes == 'replicated').sum()} of {tested} tested findings")
    print(screen_table(group))
    print("" if facts["frozen"] else "\nNOT the frozen study: its configuration, models or seed differ; exploratory.")
    print(f"report: {folder / 'report.html'}")
