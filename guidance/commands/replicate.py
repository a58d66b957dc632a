"""Replicate the study: which of the paper's 38 findings hold over other people and other assumptions.

    airhockey replicate                       200 studies, and 3 x 50 under other assumptions
    airhockey replicate n=20 sensitivity.points=0
    airhockey replicate ray=auto together=5   on all cores of a Ray cluster; ray=local: of this machine
    airhockey replicate resume=outputs/...    continue a stopped run

A study is the same to the last bit whichever others are played beside it. Studies under other assumptions draw their
people from populations in which every assumed number is varied (a Latin hypercube), for each variant of the response to
a force. Negative controls leave user adaptation no effect: each model is adapted to another person's game, or all
people have one playstyle.

Writes into its run folder: batches/ (trials), factors.csv (assumptions), outcomes.csv (a row per study and pair of the
paper's), studies.csv (a row per study), robustness.csv (a row per finding and kind of study), robustness.png and .svg,
replicate.html, manifest.json.
"""

import time
from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import load_json, write_json, write_text
from airhockey_marl.experiment.parallel import LOCAL_CLUSTER
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import command_history, command_line, lock_run_folder, note_headline

STATE_FILE = "manifest.json"  # written when a run begins


def main(cfg: DictConfig) -> None:
    import pandas as pd

    from guidance.simulated_users.force_response import check_variant
    from guidance.statistics.replication_report import summarize
    from guidance.study.replication import Studies, batches_of, on_ray, one_by_one
    from guidance.study.setup import file_hashes, frozen_study, manifest

    with report_input_errors():
        for variant in cfg.sensitivity.variants:
            check_variant(variant)
        studies = Studies(cfg)
    facts = manifest(cfg, file_hashes(cfg, studies.setup.models), command_line(), 0.0)
    facts["frozen"] = facts["study_hash"] in frozen_study()["studies"].values()  # with other seeds
    if cfg.resume and facts["study_hash"] != load_json(Path(cfg.resume) / STATE_FILE).get("study_hash"):
        raise InputError(f"resume = {cfg.resume}: the models are not those with which its studies were played")
    with lock_run_folder(cfg) as folder:
        facts |= command_history(cfg)
        write_json(folder / STATE_FILE, facts)
        write_text(folder / "factors.csv", studies.factors.to_csv(index_label="study"))
        progress, start = ProgressBar(), time.perf_counter()
        missing = [batch for batch in batches_of(cfg) if not batch.file(folder).is_file()]
        results = on_ray(cfg, missing, progress) if cfg.ray else one_by_one(studies, missing, progress)
        for batch, trials in results:
            write_text(batch.file(folder), trials.to_csv(index=False))
        progress.close()
        write_json(folder / STATE_FILE, facts | {"seconds": round(time.perf_counter() - start, 1)})
        print(summarize(folder, cfg, facts, studies.factors))
        outcomes = pd.read_csv(folder / "studies.csv")
        own = outcomes.loc[outcomes["group"] == "replicates", "replicated"]
        others = len(outcomes) - len(own)
        note_headline(folder, f"{own.mean():.1f} of 38 findings over {len(own)} studies, {others} others")
        print(f"\nreport: {folder / 'replicate.html'}")


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "together")
    require_counts(cfg, "participants", least=3)  # fewer cannot be tested
    require_counts(cfg, "n", "controls", "sensitivity.points", least=0)
    require_numbers(cfg, "sensitivity.largest", above=1.0)
    if not cfg.n and not (cfg.sensitivity.points and cfg.sensitivity.variants):
        raise InputError("n = 0 must be at least 1 where sensitivity.points is 0: there is nothing to do")
    if cfg.ray is not None and not isinstance(cfg.ray, str):
        raise InputError(f"ray = {cfg.ray} must be null, {LOCAL_CLUSTER}, auto or the address of a cluster, host:port")
    if cfg.ray is not None and find_spec("ray") is None:
        raise InputError(f"ray = {cfg.ray} needs what `pip install 'airhockey-haptics[ray]'` brings: there is no ray")
