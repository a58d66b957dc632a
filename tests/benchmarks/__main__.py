"""Benchmarks of this machine, as one JSON object on standard output: `make bench`.

Each figure is the median of a few runs after a warm-up. Ratios compare two methods in the same run; on a shared machine
they tell more than absolute figures.
"""

import json
import math
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from torch.func import grad_and_value

from airhockey_marl.envs.pettingzoo_env import AirHockey
from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.world import AGENTS, World
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from airhockey_marl.players.networks import USER_PREDICTION_HIDDEN, GaussianPolicy
from airhockey_marl.self_play.collectors import MULTISYNC, CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.league_training import LeagueTraining, train_league
from guidance.commands.meta_train import COMPILERS
from guidance.simulated_users import SimulatedUsers, load_advisors, personal_streams, sample_people
from guidance.study.setup import load_setup
from guidance.study.study import run_study
from guidance.user_model.maml import forward, meta_loss, parameters
from guidance.user_model.training import prediction_loss
from tests.benchmarks.peer_maml import peer_maml
from tests.benchmarks.peer_trpo import peer_frames
from tests.benchmarks.seat import seat_punctuality
from tests.benchmarks.servo import servo_jitter


def seconds(task: Callable[[], object], runs: int = 5) -> float:
    """Median time of a call in s, after a warm-up call."""
    task()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        task()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def ratio(whole: float | None, part: float | None) -> float | None:
    return None if whole is None or part is None else round(whole / part, 2)


def config(command: str, *overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(command, overrides=list(overrides))


def pettingzoo_steps(steps: int = 20_000) -> float:
    env, stay = AirHockey(), {agent: np.zeros(2, dtype=np.float32) for agent in AGENTS}
    env.reset(seed=0)

    def play() -> None:
        for _ in range(steps):
            if not env.agents:
                env.reset()
            env.step(stay)

    return steps / seconds(play)


def batched_ticks(tables: int = 4096, ticks: int = 100) -> float:
    batch, rng = World(tables), np.random.default_rng(0)
    batch.new_rounds()
    actions = rng.uniform(-1, 1, (ticks, tables, 2, 2))

    def play() -> None:
        for action in actions:
            batch.step(action)
            batch.new_rounds(batch.goals != 0)

    return tables * ticks / seconds(play)


def collected_frames(config: CollectorConfig, batch: int = 5000, tables: int = 250) -> float:
    """Frames/s of the learner against 25 opponents, with new weights and random numbers per batch, as in training."""
    policy = GaussianPolicy()
    env = {"backend": "batched", "tables": tables, "round_seconds": 30.0, "frame_skip": 2}
    league, weights = League(policy), policy.state_dict()
    league.add(policy)
    with closing(RolloutWorkers(config, env, 0, policy, batch)) as workers, torch.no_grad():
        workers.start_rounds(league.opponent_batch([0] * 25))
        return batch / seconds(lambda: workers.rollout(weights), runs=20)


def trained_frames(*overrides: str, generations: int = 2, steps: int = 100_000) -> float:
    """Frames/s of training end to end: collection, advantages, update, freezing, matches, files."""
    cfg = config("train", f"generations={generations}", f"steps_per_generation={steps}", *overrides)
    training = LeagueTraining(cfg)
    with closing(training.trainer.workers), tempfile.TemporaryDirectory() as folder:
        elapsed = seconds(lambda: train_league(training, Path(folder)), runs=1)
    return generations * steps / elapsed


def maml_steps(users: int = 9, ticks: int = 1000) -> dict[str, float]:
    """Time in ms of a second-order meta-step of nine users: ours, ours compiled, and the peer's.

    Each with its fastest number of threads; runs alternate, so that a slow moment of the machine slows all of them.
    """
    torch.manual_seed(0)
    model, peer = GaussianPolicy(USER_PREDICTION_HIDDEN), peer_maml()
    demo, valid = ((torch.randn(users, ticks, 12), torch.randn(users, ticks, 2)) for _ in range(2))

    def loss(params, data):
        return prediction_loss(*forward(model, params, data[0]), data[1])

    def eq2(params, demo, valid):
        return meta_loss(params, loss, demo, valid, lr=0.1)

    def batched() -> None:
        model.zero_grad()
        eq2(parameters(model), demo, valid).backward()

    def user_by_user() -> None:
        model.zero_grad()
        maml, total = peer.MAML(model, lr=0.1), 0.0
        for user in range(users):
            learner = maml.clone()
            learner.adapt(prediction_loss(*learner(demo[0][user]), demo[1][user]))
            total = total + prediction_loss(*learner(valid[0][user]), valid[1][user])
        total.backward()

    steps = {"batched": batched}
    if any(map(shutil.which, COMPILERS)):
        fused = torch.compile(grad_and_value(eq2))
        steps["compiled"] = lambda: fused(parameters(model).detach(), demo, valid)
    if peer is not None:
        steps["peer"] = user_by_user
    best = dict.fromkeys(steps, math.inf)
    for threads in range(1, 1 + min(4, os.cpu_count() or 1)):
        torch.set_num_threads(threads)
        times: dict[str, list[float]] = {name: [] for name in steps}
        for run in range(12):
            for name, step in steps.items():
                began = time.perf_counter()
                step()
                if run:  # the first compiles
                    times[name].append(1000 * (time.perf_counter() - began))
        best = {name: min(best[name], statistics.median(times[name])) for name in steps}
    torch.set_num_threads(1)
    return best


def people_tick(n: int, ticks: int = 200) -> float:
    """Time in ms of a tick of n simulated users with advisors, in play against others like them."""
    advisors = load_advisors(config("evaluate").users.advisors)
    sides = [
        SimulatedUsers(sample_people(n, seat), personal_streams(n, seat), TableSpec(), "comply_or_resist", advisors)
        for seat in (0, 1)
    ]
    tables, force, actions, elapsed = World(n), np.zeros((n, 2)), np.zeros((n, 2, 2)), 0.0
    tables.new_rounds()
    states = np.empty((2, n, 12))
    for tick in range(ticks):
        for seat in (0, 1):
            tables.observe(seat, states[seat])
        began = time.perf_counter()
        actions[:, 0] = sides[0].step(states[0], force)
        if tick >= ticks // 4:  # the first ticks compile, and no user has perceived anything yet
            elapsed += time.perf_counter() - began
        actions[:, 1] = sides[1].step(states[1], force)
        tables.step(actions)
    return 1000 * elapsed / (ticks - ticks // 4)


def study() -> float:
    """Time in s of the default study: 20 users, nine conditions, the shipped models."""
    cfg = config("evaluate")
    setup = load_setup(cfg)
    brief = replace(setup, protocol=replace(setup.protocol, rounds=1, min_seconds=0))
    run_study(sample_people(1, 0), brief, seed=cfg.seed)  # compile
    began = time.perf_counter()
    run_study(sample_people(cfg.participants, cfg.seed), setup, seed=cfg.seed)
    return time.perf_counter() - began


def main() -> None:
    torch.set_num_threads(1)
    single, batched = pettingzoo_steps(), batched_ticks()
    maml = maml_steps()
    ours, equal_work = trained_frames(), trained_frames("algorithm.fisher_subsample=1")
    peer = peer_frames()
    best = next(iter(peer.values())) if peer else None
    figures = {
        "env_pettingzoo_steps_per_s": round(single),
        "env_batched_steps_per_s": round(batched),
        "collector_frames_per_s": round(collected_frames(CollectorConfig())),
        "collector_of_2_processes_frames_per_s": round(collected_frames(CollectorConfig(MULTISYNC, 2))),
        "trpo_frames_per_s": round(ours),
        "trpo_over_sb3_contrib": best and round(ours / best, 2),
        "trpo_over_sb3_contrib_with_all_states_in_the_fisher_matrix": best and round(equal_work / best, 2),
        **{f"maml_{name}_ms_per_step": round(ms, 1) for name, ms in maml.items()},
        "maml_compiled_over_learn2learn": ratio(maml.get("peer"), maml.get("compiled")),
        "people_tick_180_ms": round(people_tick(180), 3),
        "people_tick_10000_over_180_per_person": round(people_tick(10_000) / people_tick(180) * 180 / 10_000, 2),
        "study_20_users_s": round(study(), 1),
        **{f"window_{name}": value for name, value in seat_punctuality().items()},
        **{f"servo_idle_{name}": value for name, value in servo_jitter(busy=False).items()},
        **{f"servo_beside_a_busy_core_{name}": value for name, value in servo_jitter(busy=True).items()},
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
