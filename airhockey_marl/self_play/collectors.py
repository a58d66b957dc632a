"""Two policies at one table, as TorchRL's collectors see them: who acts where, and what the learner lived through."""

import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, Collector, MultiCollector

from airhockey_marl.algorithms.reward_shaping import RewardShaping
from airhockey_marl.envs.torchrl_env import make_env, serve_rng_states
from airhockey_marl.experiment import parallel as cluster
from airhockey_marl.experiment.parallel import LOCAL_CLUSTER
from airhockey_marl.experiment.validation import check_counts, check_numbers
from airhockey_marl.league.league import OpponentBatch
from airhockey_marl.players.networks import GaussianPolicy

LEARNER, OPPONENT = "left", "right"  # seats are alike, so the learner always takes the left one


@dataclass(frozen=True)
class TableSlice:
    """Of all tables, numbered from 0 to `of`, those from `first` to before `last`."""

    first: int
    last: int
    of: int


def actor(seat: str, policy: nn.Module, share: TableSlice | None = None) -> TensorDictModule:
    """Let a policy act in a seat, sampling from its Gaussian; `share` says at which of all tables, see `GaussianSampling`."""
    return TensorDictModule(
        GaussianSampling(policy, share), in_keys=[(seat, "observation")], out_keys=[(seat, "action")]
    )


class GaussianSampling(nn.Module):
    """Actions (..., 2) drawn from what a policy says about observations (..., 12).

    A whole `ProbabilisticActor` would be slower: no algorithm here needs the log-probabilities of the moment, each
    works them out for a batch at a time.

    Args:
        share: draw for all tables and use what falls to these, so that a table's noise does not depend on who plays
            the others; None if these are all.
    """

    def __init__(self, policy: nn.Module, share: TableSlice | None = None) -> None:
        super().__init__()
        self.policy, self.share = policy, share

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        mean, std = self.policy(observation)
        if self.share is None:
            return mean + std * torch.randn_like(mean)
        noise = torch.randn(self.share.of, *mean.shape[1:], dtype=mean.dtype)
        return mean + std * noise[self.share.first : self.share.last]


class SwappablePolicy(nn.Module):
    """A place for a policy that can be given up to another while a collector runs."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.policy(observation)


def learner_batch(data: TensorDictBase, shaping: RewardShaping, strength: float, gamma: float) -> TensorDictBase:
    """What one seat lived through: (tables, ticks) with observation (.., 12), action (.., 2), reward (.., 1), next."""
    check_numbers(0.0, strength=strength)
    check_numbers(0.0, at_most=1.0, gamma=gamma)
    view = data.select((LEARNER, "observation"), (LEARNER, "action"))[LEARNER].squeeze(-1)
    following = data["next"].select("done", "terminated", "truncated")
    following["observation"] = data["next", LEARNER, "observation"].squeeze(-2)
    following["reward"] = data["next", LEARNER, "reward"].squeeze(-2)
    if strength > 0:
        following["reward"] += strength * shaping.reward(
            view["observation"], following["observation"], following["terminated"], gamma
        )
    view["next"] = following
    return view


SINGLE, MULTISYNC, RAY = "single", "multisync", "ray"
KINDS = (SINGLE, MULTISYNC, RAY)


@dataclass(frozen=True)
class CollectorConfig:
    """How play is collected (`conf/collector`).

    Attributes:
        kind: "single", "multisync" or "ray".
        workers: among which the tables are divided, evenly.
        address: of the Ray cluster: "local", "auto" or host:port.
    """

    kind: str = SINGLE
    workers: int = 1
    address: str = LOCAL_CLUSTER

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"collector.kind = {self.kind!r} must be one of {', '.join(KINDS)}")
        if isinstance(self.workers, bool) or not isinstance(self.workers, int) or self.workers < 1:
            raise ValueError(f"collector.workers = {self.workers!r} must be a whole number, at least 1")
        if self.kind == SINGLE and self.workers != 1:
            raise ValueError(f"collector.workers = {self.workers} must be 1 where collector.kind = {SINGLE}")
        if not isinstance(self.address, str) or not self.address:
            raise ValueError(
                f"collector.address = {self.address!r} must be {LOCAL_CLUSTER}, auto or a cluster's host:port"
            )
        if self.kind == RAY and find_spec("ray") is None:
            raise ValueError(f"collector.kind = {RAY} needs what `pip install 'airhockey-haptics[ray]'` brings")


class TablesCollector(Collector):
    """TorchRL's collector at some of the tables, and what must be said to it, in whichever process it lives."""

    def begin(self, opponents: OpponentBatch, streams: np.ndarray) -> None:
        """Begin new rounds, against these opponents, with these random numbers (tables,) uint64 of the tables."""
        self.policy.opponents.policy = opponents
        at = 0
        for stream in serve_rng_states(self.env):
            stream[:] = streams[at : at + len(stream)]
            at += len(stream)
        self.reset()

    def follow(self, weights: Mapping[str, Tensor], random_state: Tensor) -> None:
        """Take over the learner's weights, and torch's random numbers as they are where it learns."""
        self.policy.learner.load_state_dict(weights)
        torch.set_rng_state(random_state)

    def random_state(self) -> Tensor:
        """Torch's random numbers, as they are after the play so far."""
        return torch.get_rng_state()

    def streams(self) -> np.ndarray:
        """The random numbers of the tables, (tables,) uint64."""
        return np.concatenate(serve_rng_states(self.env))


class TwoPlayerPolicy(TensorDictSequential):
    """What acts at a worker's tables: a copy of the learner, and whoever has been given the other seat."""

    def __init__(self, learner: GaussianPolicy, share: TableSlice) -> None:
        opponents = SwappablePolicy(learner)
        super().__init__(actor(LEARNER, learner, share), actor(OPPONENT, opponents, share))
        self.learner, self.opponents = learner, opponents


class RolloutWorkers:
    """The workers, and the play they bring.

    Args:
        how: who they are.
        env: what `make_env` wants, but the seed; its tables are divided among the workers.
        seed: of the tables.
        policy: whose architecture the learner has.
        batch: steps that they bring at a time, over all tables.

    Raises:
        ValueError: there can be no such tables, seed or batch, or they cannot be divided among so many.
    """

    def __init__(
        self, how: CollectorConfig, env: Mapping[str, Any], seed: int, policy: GaussianPolicy, batch: int
    ) -> None:
        check_counts(0, seed=seed)
        check_counts(batch=batch)
        tables, self.workers, self.batch = env["tables"], how.workers, batch
        if tables % self.workers:
            raise ValueError(f"env.tables = {tables} must be a multiple of collector.workers = {self.workers}")
        each = tables // self.workers
        self.shares = [TableSlice(index * each, (index + 1) * each, tables) for index in range(self.workers)]
        envs = [partial(make_env, **{**env, "tables": each, "seed": seed + share.first}) for share in self.shares]
        seats = [partial(_both_seats, policy.architecture, share, torch.get_rng_state()) for share in self.shares]
        # weights travel by `follow`, which waits until they have arrived, not in one of the collectors' own ways
        warnings.filterwarnings("ignore", message=".*weight", category=UserWarning, module=r"torchrl\.collectors")
        self.collector = _OPEN[how.kind](how, envs, seats, batch)
        self.batches: Iterator[TensorDictBase] = iter(self.collector)
        self.streams = np.concatenate(self._tell("streams"))
        torch.set_rng_state(self._tell("random_state")[0])

    def begin(self, opponents: OpponentBatch) -> None:
        """Begin new rounds, against these opponents, with the random numbers of `streams`."""
        parts = [opponents.part(share.first, share.last, share.of) for share in self.shares]
        self._tell("begin", list(zip(parts, np.split(self.streams, self.workers), strict=True)))

    def play(self, weights: Mapping[str, Tensor]) -> TensorDictBase:
        """The next batch (tables, steps), the learner at the left of each table playing by these weights."""
        self._tell("follow", [(weights, torch.get_rng_state())] * self.workers)
        play = next(self.batches)
        torch.set_rng_state(self._tell("random_state")[0])  # each has drawn the same
        return play.flatten(0, 1) if play.ndim == 3 else play

    def end(self) -> None:
        """Note the random numbers of the tables, from which the next rounds go on."""
        self.streams[:] = np.concatenate(self._tell("streams"))

    def close(self) -> None:
        """Let the workers go."""
        self.collector.shutdown()

    def _tell(self, what: str, arguments: list[tuple] | None = None) -> list:
        """Call a method of each worker's `TablesCollector`."""
        return self.collector.map_fn(what, arguments)


def _both_seats(facts: Mapping[str, Any], share: TableSlice, random_state: Tensor) -> TwoPlayerPolicy:
    seats = TwoPlayerPolicy(GaussianPolicy.from_architecture(facts).requires_grad_(False), share)
    torch.set_rng_state(random_state)  # a new collector tries its policy once: that, too, is the same everywhere
    return seats


PLAIN = {"auto_register_policy_transforms": False}  # the tables give the keys that the policies want


def _single(how: CollectorConfig, envs: list, seats: list, batch: int) -> BaseCollector:
    return TablesCollector(envs[0](), policy_factory=seats[0], frames_per_batch=batch, total_frames=-1, **PLAIN)


def _multisync(how: CollectorConfig, envs: list, seats: list, batch: int) -> BaseCollector:
    return MultiCollector(
        envs,
        sync=True,
        policy_factory=seats,
        weight_sync_schemes={},
        collector_class=TablesCollector,
        frames_per_batch=batch,
        total_frames=-1,
        cat_results="stack",
        num_threads=torch.get_num_threads(),  # of this process, which it would set to another number
        **PLAIN,
    )


def _ray(how: CollectorConfig, envs: list, seats: list, batch: int) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    cluster.join_ray_cluster(how.address, how.workers)
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < how.workers:  # the actors would be waited for in vain
        raise ValueError(f"collector.workers = {how.workers} must be at most {cores}, the cores of the Ray cluster")
    return RayCollector(
        envs,
        policy_factory=seats,
        weight_sync_schemes={},
        collector_class=TablesCollector,
        collector_kwargs=[dict(PLAIN) for _ in envs],
        frames_per_batch=batch,
        total_frames=sys.maxsize,
        sync=True,
        remote_configs={"num_cpus": 1, "num_gpus": 0},
    )


_OPEN = {SINGLE: _single, MULTISYNC: _multisync, RAY: _ray}
