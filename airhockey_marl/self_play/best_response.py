"""Exploitability: the win rate of a policy trained from scratch against one player only.

A lower bound, as with any learned best response: training may miss a weakness. An equal opponent would win half of the
decided rounds; less means that no weakness was found in the given steps.
"""

from collections.abc import Callable

import torch
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.algorithms.reward_shaping import shaping_strength
from airhockey_marl.evaluation.matches import MatchResult, match_options, play_opponents
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.self_play.collectors import SINGLE
from airhockey_marl.self_play.trainer import SelfPlayTrainer


def best_response(
    cfg: DictConfig,
    league: League,
    target: PlayerId,
    generations: int,
    rounds: int,
    seed: int,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
) -> list[tuple[int, MatchResult]]:
    """Train a new policy against `target` only, by the league's algorithm.

    Args:
        cfg: of the league's training (`conf/train.yaml`).
        generations: of training, over all of which the shaping fades; a match of `rounds` rounds follows each.
        seed: of the new policy and its rollouts; the state of torch's random generator is restored.

    Returns:
        For each generation: the steps so far, and the result of the new policy against the target.
    """
    local = {"seed": seed, "compute": "cpu", "collector": {"kind": SINGLE, "workers": 1}, "env": {"backend": "batched"}}
    cfg = OmegaConf.merge(cfg, local | {"action_cost": 0.0})  # only goals count here
    options = match_options(cfg.env)
    history = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        trainer = SelfPlayTrainer.from_config(cfg)
        opponents = league.opponent_batch([target])
        for generation in range(1, generations + 1):
            strength = shaping_strength(generation, generations)
            trainer.train_generation(opponents, cfg.steps_per_generation, strength)
            results = play_opponents(trainer.policy, opponents, rounds, seed + generation, **options)
            history.append((generation * cfg.steps_per_generation, results[target]))
            progress("best response", generation / generations)
        trainer.workers.close()
    return history
