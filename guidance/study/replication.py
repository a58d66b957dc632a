"""Replicated studies in batches, in this process or on a Ray cluster; resumable.

Sensitivity studies draw their people from populations whose assumed parameters are varied over a Latin hypercube.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from scipy.stats import qmc

from airhockey_marl.experiment import parallel as cluster
from airhockey_marl.experiment.validation import check_numbers
from guidance.simulated_users import Population, load_population, sample_people
from guidance.simulated_users.population import TRAITS, LogNormal, ScaledBeta
from guidance.simulated_users.population.parameters import PROPORTIONS
from guidance.study.setup import load_setup
from guidance.study.study import Cohort, run_studies

# Groups of studies: replicates, two negative controls of UA, one of motor adaptation, and sensitivity studies by the
# name of their variant.
REPLICATES, SHUFFLED_ADAPTATION, ONE_PLAYSTYLE, NO_LEARNING = "replicates", "swapped", "alike", "unlearned"

UTILITY = "utility_weights."  # followed by one of `UtilityRow`


@dataclass(frozen=True)
class Batch:
    """Studies that are played side by side and written to one file.

    Attributes:
        group: the group of the studies.
        variant: how people respond to a force.
        studies: the numbers of the studies.
    """

    group: str
    variant: str
    studies: list[int]

    def file(self, folder: Path) -> Path:
        """The file of the trials."""
        return folder / "batches" / f"{self.group}-{self.studies[0]:04d}.csv"

    def population(self, usual: Population, factors: pd.DataFrame, study: int) -> Population:
        """The population that the people of a study are drawn from."""
        if self.group in (REPLICATES, SHUFFLED_ADAPTATION, NO_LEARNING):
            return usual
        if self.group == ONE_PLAYSTYLE:
            return usual.with_parameters(trait_concentration=float("inf"), archetypes={"alike": [0.5] * len(TRAITS)})
        return scale_assumptions(usual, factors.loc[study])


class Studies:
    """Plays the batches of a configuration."""

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg
        self.population = load_population(cfg.users)
        self.setup = load_setup(cfg)
        self.factors = assumptions(cfg, self.population)

    def play(self, batch: Batch, progress: Callable[[str, float], None] = lambda stage, share: None) -> pd.DataFrame:
        """The trials of a batch, with their group and study; bit-identical on every machine of a cluster."""
        cfg = self.cfg
        cohorts = []
        for study in batch.studies:
            population = batch.population(self.population, self.factors, study)
            cohorts.append(Cohort(sample_people(cfg.participants, cfg.seed + study, population), cfg.seed + study))
        setup = replace(self.setup, variant=batch.variant)
        if batch.group == NO_LEARNING:
            setup = replace(setup, adaptation=False)
        shuffled = batch.group == SHUFFLED_ADAPTATION
        studies = run_studies(cohorts, setup, progress, shuffled_adaptation=shuffled)
        return pd.concat(
            [tables.trials.assign(group=batch.group, study=k) for k, tables in zip(batch.studies, studies, strict=True)]
        )


def one_by_one(
    studies: Studies, batches: Sequence[Batch], progress: Callable[[str, float], None]
) -> Iterator[tuple[Batch, pd.DataFrame]]:
    """Play the batches in this process, one after the other, each on all cores."""
    for i, batch in enumerate(batches):
        prefix = f"batch {i + 1} of {len(batches)}, "
        yield batch, studies.play(batch, lambda stage, share, prefix=prefix: progress(prefix + stage, share))


def on_ray(
    cfg: DictConfig, batches: Sequence[Batch], progress: Callable[[str, float], None]
) -> Iterator[tuple[Batch, pd.DataFrame]]:
    """Play the batches on a Ray cluster, each as a task of one core, and yield them as they finish.

    If a batch fails, the others are yielded nevertheless, and its error is raised at the end.
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
    """A batch on one core."""
    numba.config.NUMBA_NUM_THREADS = 1
    torch.set_num_threads(1)
    return Studies(OmegaConf.create(cfg)).play(batch)


def batches_of(cfg: DictConfig) -> list[Batch]:
    """All studies in batches. All variants have the same people and serves, controls those of the first replicates."""
    groups = [(REPLICATES, cfg.users.variant, range(cfg.n))]
    groups += [(v, v, range(cfg.n, cfg.n + cfg.sensitivity.points)) for v in cfg.sensitivity.variants]
    controls = (SHUFFLED_ADAPTATION, ONE_PLAYSTYLE, NO_LEARNING)
    groups += [(control, cfg.users.variant, range(cfg.controls)) for control in controls]
    return [
        Batch(group, variant, list(studies[first : first + cfg.together]))
        for group, variant, studies in groups
        for first in range(0, len(studies), cfg.together)
    ]


def assumptions(cfg: DictConfig, population: Population) -> pd.DataFrame:
    """The factor of each assumed parameter (columns) in each sensitivity study (rows, numbered from `n`)."""
    points, names = cfg.sensitivity.points, list(cfg.sensitivity.parameters)
    if not points:
        return pd.DataFrame(columns=names)
    factors = latin_hypercube(names, points, cfg.sensitivity.largest, cfg.seed)
    for _, row in factors.iterrows():
        scale_assumptions(population, row)  # raises for an invalid name or value
    return factors.set_index(np.arange(cfg.n, cfg.n + points))


def latin_hypercube(parameters: Sequence[str], points: int, largest: float, seed: int) -> pd.DataFrame:
    """Factors between 1 / largest and largest, evenly distributed on a logarithmic scale.

    Returns:
        (points, parameters): in each column every one of `points` equal slices of the range occurs once.
    """
    if repeated := {name for name in parameters if list(parameters).count(name) > 1}:
        raise ValueError(f"sensitivity.parameters: {', '.join(sorted(repeated))} more than once")
    unit = qmc.LatinHypercube(len(parameters), rng=seed).random(points)
    return pd.DataFrame(largest ** (2 * unit - 1), columns=list(parameters))


def scale_assumptions(population: Population, factors: Mapping[str, float]) -> Population:
    """The population with each named parameter multiplied by its factor.

    Of a log-normal parameter the median and the clip are scaled, of a Beta its scale; no proportion exceeds 1. A
    utility, `utility_weights.<name>`, has no natural zero: ln(factor) is added to its constant.
    """
    parameters, changes, utilities = population.parameters, {}, dict(population["utility_weights"])
    for name, factor in factors.items():
        check_numbers(above=0.0, **{f"factors[{name!r}]": factor})
        row = name.removeprefix(UTILITY)
        if name.startswith(UTILITY) and row in utilities:
            constant, *terms = utilities[row]
            utilities[row] = [constant + log(factor), *terms]
        elif name in parameters and not isinstance(parameters[name], Mapping):
            changes[name] = _scaled(name, parameters[name], factor)
        else:
            raise ValueError(f"sensitivity.parameters: {name} is not a parameter of people")
    return population.with_parameters(**changes, utility_weights=utilities)


def _scaled(name: str, value: Any, factor: float) -> Any:
    if isinstance(value, LogNormal):
        return value._replace(median=factor * value.median, low=factor * value.low, high=factor * value.high)
    if isinstance(value, ScaledBeta):
        return value._replace(scale=min(1.0, factor * value.scale))
    return min(1.0, factor * value) if name in PROPORTIONS else factor * value
