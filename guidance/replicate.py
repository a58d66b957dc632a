"""Do the study again and again: which of the paper's 38 findings hold over other people, and over other assumptions?

    python -m guidance.replicate                       200 studies, and 3 x 50 under other assumptions
    python -m guidance.replicate n=20 sensitivity.points=0
    python -m guidance.replicate ray=auto together=5   on all cores of a Ray cluster; ray=local: of this machine
    python -m guidance.replicate resume=outputs/...    go on with a run that was stopped, as if it had not been

A study comes out the same to the last bit whichever others are played beside it. Each of the second kind draws its
people from a population in which every assumed number is another one (a Latin hypercube), once per variant of how
people answer a force. A few more are negative controls, which must leave UA nothing to do: everybody's game is taken
for somebody else's, or all people have one style.

Writes into its run folder: batches/, the trials, a file whenever some studies are done; factors.csv, what was assumed;
outcomes.csv, a row per study and pair of the paper's; studies.csv, a row per study; robustness.csv, a row per finding
and kind of study; robustness.png and .svg; replicate.html; manifest.json.
"""

import base64
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numba
import numpy as np
import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from airhockey_marl import cluster
from airhockey_marl.building import build
from airhockey_marl.cli import (
    InputError,
    ProgressBar,
    command,
    config_of,
    input_errors,
    require_counts,
    require_device,
    require_numbers,
)
from airhockey_marl.cluster import HERE
from airhockey_marl.files import replacing, write_json, write_text
from airhockey_marl.lock import locked
from airhockey_marl.page import template
from airhockey_marl.table import Table
from guidance.figures import robustness_map, save_figure
from guidance.provenance import chosen_conditions, chosen_models, chosen_opponent, frozen_study, hashes_of, manifest
from guidance.robustness import findings_over, leans_on, outcomes_of, scores_of, spread, ua_over, wrong_over
from guidance.sensitivity import changed, latin_hypercube
from guidance.stats import EVIDENCE, METRICS, reference_points
from guidance.study import Cohort, run_studies
from guidance.users import Population, load_mentors, sample_people
from guidance.users.population import TRAITS
from guidance.users.reaction import check_variant

STATE = "manifest.json"  # written when a run begins
# groups of studies: that assume what the study assumes; that leave UA nothing to do; and by the name of their variant,
# those under other assumptions
AS_IT_IS, SWAPPED, ALIKE = "replicates", "swapped", "alike"


@dataclass(frozen=True)
class Batch:
    """Studies that are played side by side and written down together.

    Attributes:
        group: what they have in common.
        variant: of how people answer a force.
        studies: their numbers.
    """

    group: str
    variant: str
    studies: list[int]

    def file(self, folder: Path) -> Path:
        """Where their trials are written."""
        return folder / "batches" / f"{self.group}-{self.studies[0]:04d}.csv"

    def population(self, usual: Population, factors: pd.DataFrame, study: int) -> Population:
        """From which the people of a study are drawn."""
        if self.group in (AS_IT_IS, SWAPPED):
            return usual
        if self.group == ALIKE:
            return replace(usual, trait_concentration=float("inf"), archetypes={"alike": [0.5] * len(TRAITS)})
        return changed(usual, factors.loc[study])


class Studies:
    """All that the batches of a run rest on, from its configuration.

    Raises:
        ValueError: names the key, its value and what is allowed.
    """

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg
        self.population: Population = build(cfg.users.population)
        self.models = chosen_models(cfg, cfg.device)
        self.opponent = chosen_opponent(cfg, cfg.device)
        self.mentors = load_mentors(cfg.users.mentors)
        self.conditions, self.protocol = chosen_conditions(cfg), build(cfg.study)
        self.factors = assumptions(cfg, self.population)

    def play(self, batch: Batch, progress: Callable[[str, float], None] = lambda what, share: None) -> pd.DataFrame:
        """The trials of a batch, with their group and study; no bit of them depends on where they are played."""
        cfg = self.cfg
        cohorts = []
        for study in batch.studies:
            drawn_from = batch.population(self.population, self.factors, study)
            cohorts.append(Cohort(sample_people(cfg.participants, cfg.seed + study, drawn_from), cfg.seed + study))
        scales = OmegaConf.to_container(cfg.users.scales)
        how = (cfg.guidance.lookahead, self.protocol, Table(), batch.variant, self.mentors, scales, progress)
        swapped = batch.group == SWAPPED
        trials = run_studies(cohorts, self.conditions, self.models, self.opponent, *how, swapped=swapped)
        return pd.concat([t.assign(group=batch.group, study=k) for k, t in zip(batch.studies, trials, strict=True)])


def one_by_one(
    studies: Studies, batches: Sequence[Batch], progress: Callable[[str, float], None]
) -> Iterator[tuple[Batch, pd.DataFrame]]:
    """Play the batches in this process, each on all cores."""
    for i, batch in enumerate(batches):
        yield batch, studies.play(batch, partial(_tell, progress, f"batch {i + 1} of {len(batches)}"))


def on_ray(
    cfg: DictConfig, batches: Sequence[Batch], progress: Callable[[str, float], None]
) -> Iterator[tuple[Batch, pd.DataFrame]]:
    """Play the batches on a Ray cluster, each as a task of one core, and yield them as they are done.

    One that fails does not keep the others from being yielded; its error is raised when all are over.
    """
    import ray

    cluster.join(cfg.ray)
    task = ray.remote(num_cpus=1)(_play_alone)
    plain = OmegaConf.to_container(cfg, resolve=True)
    waiting, failure = {task.remote(plain, batch): batch for batch in batches}, None
    while waiting:
        (done,), _ = ray.wait(list(waiting))
        batch = waiting.pop(done)
        try:
            yield batch, ray.get(done)
        except ray.exceptions.RayError as error:
            failure = failure or error
        progress(f"{len(batches)} batches", 1 - len(waiting) / len(batches))
    if failure is not None:
        raise failure


def _play_alone(cfg: dict, batch: Batch) -> pd.DataFrame:
    """A batch on one core: the others have batches of their own."""
    numba.config.NUMBA_NUM_THREADS = 1
    torch.set_num_threads(1)
    return Studies(OmegaConf.create(cfg)).play(batch)


@command("replicate")
def main(cfg: DictConfig) -> None:
    with input_errors():
        if cfg.resume is not None:
            cfg = config_of(Path(cfg.resume), STATE, cfg)
        check(cfg)
        studies = Studies(cfg)
    torch.set_num_threads(cfg.threads)
    folder = Path(cfg.resume or HydraConfig.get().runtime.output_dir)
    with locked(folder, "run"):
        command_line = " ".join(["python -m guidance.replicate", *HydraConfig.get().overrides.task])
        facts = manifest(cfg, hashes_of(cfg, studies.models), command_line, 0.0)
        facts["frozen"] = facts["study_hash"] == frozen_study()["study_hash"]  # with other seeds
        write_json(folder / STATE, facts)
        with replacing(folder / "factors.csv") as temporary:
            studies.factors.to_csv(temporary, index_label="study")

        progress, began = ProgressBar(), time.perf_counter()
        missing = [batch for batch in batches_of(cfg) if not batch.file(folder).is_file()]
        played = on_ray(cfg, missing, progress) if cfg.ray else one_by_one(studies, missing, progress)
        for batch, trials in played:
            with replacing(batch.file(folder)) as temporary:
                trials.to_csv(temporary, index=False)
        progress.close()
        write_json(folder / STATE, facts | {"seconds": round(time.perf_counter() - began, 1)})
        print(summarise(folder, cfg, facts, studies.factors))
        print(f"\nreport: {folder / 'replicate.html'}")


def check(cfg: DictConfig) -> None:
    """Refuse what cannot run.

    Raises:
        ValueError: names the key, its value and what is allowed.
    """
    require_counts(cfg, "together", "threads")
    require_device(cfg)
    require_counts(cfg, "participants", least=3)  # fewer cannot be tested
    require_counts(cfg, "n", "seed", "controls", "sensitivity.points", least=0)
    require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)
    require_numbers(cfg, "sensitivity.largest", above=1.0)
    if not cfg.n and not (cfg.sensitivity.points and cfg.sensitivity.variants):
        raise InputError("n = 0 must be at least 1 where sensitivity.points is 0: there is nothing to do")
    if cfg.ray is not None and not isinstance(cfg.ray, str):
        raise InputError(f"ray = {cfg.ray} must be null, {HERE}, auto or the address of a cluster, host:port")
    if cfg.ray is not None and find_spec("ray") is None:
        raise InputError(f"ray = {cfg.ray} needs what `pip install 'airhockey-haptics[ray]'` brings: there is no ray")
    for variant in (cfg.users.variant, *cfg.sensitivity.variants):
        check_variant(variant)


def assumptions(cfg: DictConfig, population: Population) -> pd.DataFrame:
    """By study (those after the first `n`), the factor of each assumed number."""
    points, names = cfg.sensitivity.points, list(cfg.sensitivity.parameters)
    if not points:
        return pd.DataFrame(columns=names)
    factors = latin_hypercube(names, points, cfg.sensitivity.largest, cfg.seed)
    for _, row in factors.iterrows():
        changed(population, row)  # refuses a name or a value before any work
    return factors.set_index(np.arange(cfg.n, cfg.n + points))


def batches_of(cfg: DictConfig) -> list[Batch]:
    """All studies. The variants get the same people and serves, and a control those of the first replicates."""
    groups = [(AS_IT_IS, cfg.users.variant, range(cfg.n))]
    groups += [(v, v, range(cfg.n, cfg.n + cfg.sensitivity.points)) for v in cfg.sensitivity.variants]
    groups += [(control, cfg.users.variant, range(cfg.controls)) for control in (SWAPPED, ALIKE)]
    return [
        Batch(group, variant, list(studies[first : first + cfg.together]))
        for group, variant, studies in groups
        for first in range(0, len(studies), cfg.together)
    ]


def _tell(progress: ProgressBar, batch: str, what: str, share: float) -> None:
    progress(f"{batch}, {what}", share)


def summarise(folder: Path, cfg: DictConfig, facts: dict, factors: pd.DataFrame) -> str:
    """Test every study and write tables, figure and page; what the screen says is returned."""
    withdrawn, outcomes, scores = list(cfg.users.withdrawn), [], []
    for batch in batches_of(cfg):
        for study, trials in pd.read_csv(batch.file(folder), dtype={"user": "str"}).groupby("study"):
            outcome = outcomes_of(trials, withdrawn)
            outcomes.append(outcome.assign(group=batch.group, study=study))
            scores.append({"group": batch.group, "study": study} | scores_of(trials, outcome))
    outcomes, scores = pd.concat(outcomes, ignore_index=True), pd.DataFrame(scores)
    findings, wrong = findings_over(outcomes), wrong_over(outcomes)
    groups = list(scores["group"].unique())
    leans = {v: leans_on(outcomes[outcomes["group"] == v], factors) for v in cfg.sensitivity.variants if v in groups}
    tables = {"outcomes": outcomes, "studies": scores, "robustness": findings}
    for name, table in tables.items():
        with replacing(folder / f"{name}.csv") as temporary:
            table.to_csv(temporary, index=False)
    svg = save_figure(lambda: robustness_map(findings), folder, "robustness", dpi=130)
    by_group = {
        group: {"studies": len(rows)} | {name: spread(rows[name]) for name in rows.columns[2:]}
        for group, rows in scores.groupby("group", sort=False)
    }
    by_chance, rerun = reference_points(cfg.participants)
    page = template(Path(__file__).parent, "replicate_template.html").render(
        groups=by_group,
        wrong=wrong[wrong["outcome"] >= 0.25].sort_values("outcome", ascending=False).to_dict("records"),
        leans={group: table[table["p"] < 0.05].to_dict("records") for group, table in leans.items()},
        evidence=EVIDENCE,
        metrics=METRICS,
        withdrawn=withdrawn,
        cells=findings.loc[findings["group"] == groups[0], "evidence"].value_counts().to_dict(),
        counting=int((findings.loc[findings["group"] == groups[0], "withdrawn"] == 0).sum()),
        by_chance=by_chance,
        rerun=rerun,
        figure=base64.b64encode(svg).decode("ascii"),
        facts=facts,
        names={AS_IT_IS: "as the study is", SWAPPED: "UA from somebody else’s game", ALIKE: "people of one style"},
        ua=ua_over(outcomes).to_dict("records"),
    )
    write_text(folder / "replicate.html", page)
    lines = [
        f"{'':12}{'studies':>8}{'of 38':>16}" + "".join(f"{e:>8}" for e in EVIDENCE) + f"{'reversed':>10}{'wrong':>8}"
    ]
    for group, row in by_group.items():
        total = row["replicated"]
        lines.append(
            f"{group:12}{row['studies']:>8}{total['mean']:>6.1f} [{total['low']:.0f}, {total['high']:.0f}]".ljust(36)
            + "".join(f"{row[f'replicated_{e}']['mean']:>8.1f}" for e in EVIDENCE)
            + f"{row['reversed']['mean']:>10.1f}{row['wrongly_significant']['mean']:>8.1f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
