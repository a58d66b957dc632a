"""Hydra's launcher for Ray clusters: each job of a sweep is a Ray task.

The maintained pieces of it are Hydra's `run_job` and Ray itself; what is here only hands the one to the other.
hydra-ray-launcher 1.2.2 does the same, but holds every environment to cloudpickle 2 and brings the SDK of AWS.

Hydra finds plugins below folders `hydra_plugins` alone; `experiment.command` adds this one to the search path.
"""

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

log = logging.getLogger(__name__)


class RayLauncher(Launcher):
    """Runs the jobs of a sweep as tasks of a Ray cluster.

    `init` is for `ray.init`, unless the program has joined a cluster already, and `remote` for `ray.remote`.
    """

    def __init__(self, init: DictConfig, remote: DictConfig) -> None:
        self.init, self.remote = (OmegaConf.to_container(part, resolve=True) for part in (init, remote))

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        """Run the jobs, as many at a time as the cluster has room for; what came of each, in their order."""
        import ray

        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        sweep = Path(self.config.hydra.sweep.dir).absolute()  # here: there, environment and working folder differ
        sweep.mkdir(parents=True, exist_ok=True)
        if not ray.is_initialized():
            ray.init(**self.init)
        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers do not know the way here
        task = ray.remote(**self.remote)(_run)
        tasks = []
        for number, overrides in enumerate(job_overrides, initial_job_idx):
            log.info(f"\t#{number} : {' '.join(filter_overrides(overrides))}")
            config = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
            with open_dict(config):
                config.hydra.job.id, config.hydra.job.num = f"{config.hydra.job.name}_{number}", number
                config.hydra.sweep.dir = str(sweep)
            tasks.append(task.remote(self.hydra_context, config, self.task_function, Singleton.get_state()))
        return [_outcome(ray, job, overrides) for job, overrides in zip(tasks, job_overrides, strict=True)]


def _run(
    hydra_context: HydraContext, config: DictConfig, task_function: TaskFunction, state: dict[Any, Any]
) -> JobReturn:
    """One job, in a process of Ray's."""
    setup_globals()
    Singleton.set_state(state)
    HydraConfig.instance().set_config(config)
    folders = {"job_dir_key": "hydra.sweep.dir", "job_subdir_key": "hydra.sweep.subdir"}
    return run_job(hydra_context=hydra_context, task_function=task_function, config=config, **folders)


def _outcome(ray: Any, job: Any, overrides: Sequence[str]) -> JobReturn:
    """What came of a job; where Ray lost its process, a failed job, which costs the others nothing."""
    try:
        return ray.get(job)
    except ray.exceptions.RayError as error:
        failure = JobReturn(overrides=list(overrides), status=JobStatus.FAILED)
        failure.return_value = error
        return failure
