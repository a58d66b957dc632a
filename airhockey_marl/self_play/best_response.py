"""Exploitability: how well a policy trained from nothing, against one member alone, comes to do against it.

A lower bound, as any learned best response is: what it does not find may still be there. Half of the decided rounds is
what an equal would win; less means that in so many steps no weakness was found.
"""

from collections.abc import Callable

import torch
from omegaconf import DictConfig

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.reward_shaping import RewardShaping, shaping_strength
from airhockey_marl.evaluation.matches import MatchResult, play_each
from airhockey_marl.experiment.validation import check_counts
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.trainer import SelfPlayTrainer


def best_response(
    cfg: DictConfig,
    league: League,
    target: PlayerId,
    generations: int,
    rounds: int,
    seed: int,
    progress: Callable[[str, float], None] = lambda phase, share: None,
) -> list[tuple[int, MatchResult]]:
    """Train a new policy against `target` alone, by the same algorithm as the league's.

    Args:
        cfg: of the training (`conf/train.yaml`).
        generations: how long, in the league's `steps_per_generation`; the shaping fades over all of them.
        rounds: of the match that follows each.
        seed: of the new policy and its play; torch's own random numbers are put back as they were.

    Returns:
        For each generation: the steps so far, and how the new policy then fares against the target.
    """
    check_counts(generations=generations, rounds=rounds)
    check_counts(0, seed=seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = GaussianPolicy(cfg.hidden, cfg.inputs)
        learner = ALGORITHMS.build(cfg.algorithm, "algorithm").learner(policy, cfg.gamma)
        crew = RolloutWorkers(CollectorConfig(), {**cfg.env, "backend": "batched"}, seed, policy, cfg.batch)
        shaping = RewardShaping(cfg.shaping.position, cfg.shaping.velocity, cfg.shaping.shot, cfg.shaping.approach)
        practice, history = SelfPlayTrainer(crew, policy, shaping, cfg.gamma), []
        for generation in range(1, generations + 1):
            opponents, strength = league.lineup([target]), shaping_strength(generation, generations)
            practice.generation(learner, opponents, cfg.steps_per_generation, strength)
            result = play_each(policy, opponents, rounds, seed + generation, cfg.env.frame_skip)[target]
            history.append((generation * cfg.steps_per_generation, result))
            progress("best response", generation / generations)
        crew.close()
    return history
