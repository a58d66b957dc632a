"""Many studies, in batches: played here or on a Ray cluster, resumable."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numba
import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment import parallel as cluster
from airhockey_marl.experiment.registry import construct
from guidance.simulated_users import Population, load_advisors, sample_people
from guidance.simulated_users.population import TRAITS
from guidance.study.protocol import Protocol
from guidance.study.provenance import load_conditions, load_models, load_opponent
from guidance.study.sensitivity import latin_hypercube, scale_assumptions
from guidance.study.study import Cohort, run_studies

# groups of studies: that assume what the study assumes; that leave UA nothing to do; and by the name of their variant,
# those under other assumptions
AS_IT_IS, SWAPPED, ALIKE = "replicates", "swapped", "alike"

STATE = "manifest.json"  # written when a run begins


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
        return scale_assumptions(usual, factors.loc[study])


class Studies:
    """All that the batches of a run rest on, from its configuration.

    Raises:
        ValueError: names the key, its value and what is allowed.
    """

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg
        self.population: Population = construct(Population, cfg.users.population, "users.population")
        self.models = load_models(cfg, cfg.compute)
        self.opponent = load_opponent(cfg, cfg.compute)
        self.mentors = load_advisors(cfg.users.mentors)
        self.conditions, self.protocol = load_conditions(cfg), construct(Protocol, cfg.study, "study")
        self.factors = assumptions(cfg, self.population)

    def play(self, batch: Batch, progress: Callable[[str, float], None] = lambda what, share: None) -> pd.DataFrame:
        """The trials of a batch, with their group and study; no bit of them depends on where they are played."""
        cfg = self.cfg
        cohorts = []
        for study in batch.studies:
            drawn_from = batch.population(self.population, self.factors, study)
            cohorts.append(Cohort(sample_people(cfg.participants, cfg.seed + study, drawn_from), cfg.seed + study))
        scales = OmegaConf.to_container(cfg.users.scales)
        how = (cfg.guidance.lookahead, self.protocol, TableSpec(), batch.variant, self.mentors, scales, progress)
        swapped = batch.group == SWAPPED
        trials = run_studies(cohorts, self.conditions, self.models, self.opponent, *how, swapped=swapped)
        return pd.concat([t.assign(group=batch.group, study=k) for k, t in zip(batch.studies, trials, strict=True)])


def _tell(progress: Callable[[str, float], None], batch: str, what: str, share: float) -> None:
    progress(f"{batch}, {what}", share)


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

    cluster.join_ray_cluster(cfg.ray)
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


def assumptions(cfg: DictConfig, population: Population) -> pd.DataFrame:
    """By study (those after the first `n`), the factor of each assumed number."""
    points, names = cfg.sensitivity.points, list(cfg.sensitivity.parameters)
    if not points:
        return pd.DataFrame(columns=names)
    factors = latin_hypercube(names, points, cfg.sensitivity.largest, cfg.seed)
    for _, row in factors.iterrows():
        scale_assumptions(population, row)  # refuses a name or a value before any work
    return factors.set_index(np.arange(cfg.n, cfg.n + points))
