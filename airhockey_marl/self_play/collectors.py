"""Rollout workers: in-process, multiprocessing, or Ray."""

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector, MultiCollector
from torchrl.envs import EnvBase

from airhockey_marl.envs.torchrl_env import make_env, serve_rng_states
from airhockey_marl.experiment.parallel import LOCAL_CLUSTER, join_ray_cluster
from airhockey_marl.experiment.validation import check_counts, labeled
from airhockey_marl.league.league import OpponentBatch, TableSlice
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.two_player_policy import TwoPlayerPolicy

SINGLE, MULTISYNC, RAY = "single", "multisync", "ray"
KINDS = (SINGLE, MULTISYNC, RAY)


@dataclass(frozen=True)
class CollectorConfig:
    """Where rollouts are collected (`conf/collector`).

    Attributes:
        kind: "single", in this process; "multisync", in processes of this machine; or "ray", in actors of a cluster.
        workers: processes or actors; each has an equal share of the tables.
        address: of the Ray cluster: "local", "auto" or host:port.
    """

    kind: str = SINGLE
    workers: int = 1
    address: str = LOCAL_CLUSTER

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"collector.kind = {self.kind!r} must be one of {', '.join(KINDS)}")
        check_counts(**labeled(self, "collector", "workers"))
        if self.kind == SINGLE and self.workers != 1:
            raise ValueError(f"collector.workers = {self.workers} must be 1 where collector.kind = {SINGLE}")
        if not isinstance(self.address, str) or not self.address:
            raise ValueError(
                f"collector.address = {self.address!r} must be {LOCAL_CLUSTER}, auto or a cluster's host:port"
            )
        if self.kind == RAY and find_spec("ray") is None:
            raise ValueError(f"collector.kind = {RAY} needs Ray: pip install 'airhockey-haptics[ray]'")


class TableCollector(Collector):
    """TorchRL's collector for one worker's tables; `RolloutWorkers` calls its methods in the worker's process."""

    def start_rounds(self, opponents: OpponentBatch, rng_states: np.ndarray) -> None:
        """Start new rounds against these opponents, serving from these random states (tables,) uint64."""
        self.policy.opponents.policy = opponents
        first = 0
        for state in serve_rng_states(self.env):
            state[:] = rng_states[first : first + len(state)]
            first += len(state)
        self.reset()

    def load_weights(self, weights: Mapping[str, Tensor], torch_rng_state: Tensor) -> None:
        """Load the learner's weights and the state of torch's random generator in the training process."""
        self.policy.learner.load_state_dict(weights)
        torch.set_rng_state(torch_rng_state)

    def torch_rng_state(self) -> Tensor:
        """The state of torch's random generator after the last rollout."""
        return torch.get_rng_state()

    def table_rng_states(self) -> np.ndarray:
        """The random states of the serves, (tables,) uint64."""
        return np.concatenate(serve_rng_states(self.env))


class RolloutWorkers:
    """The workers that play the tables; rollouts do not depend on their kind and number, but for rounding.

    Args:
        config: kind and number of the workers.
        env: the arguments of `make_env` without the seed; its tables are divided among the workers.
        seed: of the serves.
        policy: of the learner's architecture.
        batch: steps of a rollout, over all tables.

    Attributes:
        rng_states: random states of the serves, (tables,) uint64, from which the next rounds start.
    """

    def __init__(
        self, config: CollectorConfig, env: Mapping[str, Any], seed: int, policy: GaussianPolicy, batch: int
    ) -> None:
        tables, self.workers, self.batch = env["tables"], config.workers, batch
        if tables % self.workers:
            raise ValueError(f"env.tables = {tables} must be a multiple of collector.workers = {self.workers}")
        size = tables // self.workers
        self.slices = [TableSlice(worker * size, (worker + 1) * size, tables) for worker in range(self.workers)]
        envs = [partial(make_env, **{**env, "tables": size, "seed": seed + part.first}) for part in self.slices]
        policies = [partial(_make_policy, policy.architecture, part, torch.get_rng_state()) for part in self.slices]
        # `load_weights` sends weights and waits for their arrival; the collectors' own ways do not
        warnings.filterwarnings("ignore", message=".*weight", category=UserWarning, module=r"torchrl\.collectors")
        # its `map_fn` calls a method of the `TableCollector` of every worker
        self.collector = _COLLECTOR_FACTORIES[config.kind](config, envs, policies, batch)
        self.rollouts: Iterator[TensorDictBase] = iter(self.collector)
        self.rng_states = np.concatenate(self.collector.map_fn("table_rng_states"))
        torch.set_rng_state(self.collector.map_fn("torch_rng_state")[0])

    def start_rounds(self, opponents: OpponentBatch) -> None:
        """Start new rounds against these opponents, serving from `rng_states`."""
        slices = [opponents.slice(tables) for tables in self.slices]
        rng_states = np.split(self.rng_states, self.workers)
        self.collector.map_fn("start_rounds", list(zip(slices, rng_states, strict=True)))

    def rollout(self, weights: Mapping[str, Tensor]) -> TensorDictBase:
        """The next batch of steps, (tables, steps), played by a learner with these weights."""
        self.collector.map_fn("load_weights", [(weights, torch.get_rng_state())] * self.workers)
        data = next(self.rollouts)
        torch.set_rng_state(self.collector.map_fn("torch_rng_state")[0])  # the workers drew equally many numbers
        return data.flatten(0, 1) if data.ndim == 3 else data

    def save_rng_states(self) -> None:
        """Update `rng_states` from the workers."""
        self.rng_states[:] = np.concatenate(self.collector.map_fn("table_rng_states"))

    def close(self) -> None:
        """Shut the workers down."""
        self.collector.shutdown()


def _make_policy(architecture: Mapping[str, Any], tables: TableSlice, torch_rng_state: Tensor) -> TwoPlayerPolicy:
    policy = TwoPlayerPolicy(GaussianPolicy.from_architecture(architecture).requires_grad_(False), tables)
    torch.set_rng_state(torch_rng_state)  # a new collector calls its policy once: with equal noise in every worker
    return policy


EnvFactories = list[Callable[[], EnvBase]]
PolicyFactories = list[Callable[[], TwoPlayerPolicy]]
COLLECTOR_OPTIONS = {"auto_register_policy_transforms": False}  # the environment already has the policy's keys


def _single(config: CollectorConfig, envs: EnvFactories, policies: PolicyFactories, batch: int) -> BaseCollector:
    options = {"frames_per_batch": batch, "total_frames": -1, **COLLECTOR_OPTIONS}
    return TableCollector(envs[0](), policy_factory=policies[0], **options)


def _multisync(config: CollectorConfig, envs: EnvFactories, policies: PolicyFactories, batch: int) -> BaseCollector:
    return MultiCollector(
        envs,
        sync=True,
        policy_factory=policies,
        weight_sync_schemes={},
        collector_class=TableCollector,
        frames_per_batch=batch,
        total_frames=-1,
        cat_results="stack",
        num_threads=torch.get_num_threads(),  # by default it would change the threads of this process
        **COLLECTOR_OPTIONS,
    )


def _ray(config: CollectorConfig, envs: EnvFactories, policies: PolicyFactories, batch: int) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    join_ray_cluster(config.address, config.workers)
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < config.workers:  # Ray would wait for free cores forever
        raise ValueError(f"collector.workers = {config.workers} must be at most {cores}, the cores of the Ray cluster")
    return RayCollector(
        envs,
        policy_factory=policies,
        weight_sync_schemes={},
        collector_class=TableCollector,
        collector_kwargs=[dict(COLLECTOR_OPTIONS) for _ in envs],
        frames_per_batch=batch,
        total_frames=sys.maxsize,
        sync=True,
        remote_configs={"num_cpus": 1, "num_gpus": 0},
    )


_COLLECTOR_FACTORIES = {SINGLE: _single, MULTISYNC: _multisync, RAY: _ray}
