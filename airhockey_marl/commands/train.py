"""Train the optimal action model: a league of generations that learn by playing those before them (section 3.2.2).

    python -m airhockey_marl.train                     the paper's 100 generations x 200 K steps
    python -m airhockey_marl.train +preset=smoke       seconds, to see that it runs
    python -m airhockey_marl.train -m seed=0,1,2       three seeds, one after another
    python -m airhockey_marl.train collector=multisync collector.workers=4    play collected by four processes
    python -m airhockey_marl.train resume=outputs/...  go on with a run that was stopped, as if it had not been
    tensorboard --logdir outputs                       watch

Writes into its run folder: league.safetensors (every generation), matches.csv (each generation against some before it
and the scripted anchors), card.json (what it is, and how it plays), and what TensorBoard reads. All is written again
after each generation, whole, and so is state.safetensors, from which `resume` goes on: weights, matches and what
TensorBoard shows end bit for bit as those of a run that was never stopped (but for `speed/`, which is the clock's).
"""

from contextlib import closing
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.algorithms.base import ALGORITHMS, Algorithm
from airhockey_marl.experiment.command import (
    InputError,
    command,
    report_input_errors,
    require_counts,
    require_device,
    require_numbers,
    resumed_config,
)
from airhockey_marl.experiment.files import write_json
from airhockey_marl.experiment.run_folder import lock_run_folder
from airhockey_marl.experiment.tensorboard import log_final_scores
from airhockey_marl.league.opponent_sampling import OPPONENT_SAMPLERS, OpponentSampler
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
from airhockey_marl.self_play.collectors import CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.league_training import STATE, STRONGEST_SCRIPT, model_card, train_league


def check(cfg: DictConfig) -> None:
    """Refuse what cannot run.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    counts = ("threads", "generations", "steps_per_generation", "batch")
    require_counts(cfg, *counts, "env.tables", "env.frame_skip", "league.opponents")
    require_counts(cfg, "league.match_rounds", "league.match_every")
    require_device(cfg)
    require_counts(cfg, "seed", "shaping.generations", "pictures_every", least=0)
    require_numbers(cfg, "gamma", "league.memory", at_most=1.0)
    require_numbers(cfg, "env.round_seconds")
    require_numbers(cfg, *(f"shaping.{name}" for name in ("position", "velocity", "shot", "approach")), least=0.0)
    for whole, part in (("batch", "env.tables"), ("steps_per_generation", "batch"), ("env.tables", "league.opponents")):
        if OmegaConf.select(cfg, whole) % OmegaConf.select(cfg, part):
            raise InputError(
                f"{whole} = {OmegaConf.select(cfg, whole)} must be a multiple of {part} = {OmegaConf.select(cfg, part)}"
            )
    for name in cfg.league.anchors:
        SCRIPTED_PLAYERS.find(name, "league.anchors")


@command("train")
def main(cfg: DictConfig) -> float:
    """Train; for a sweeper, the last generation's share of decided rounds against the strongest script."""
    with report_input_errors():
        if cfg.resume is not None:
            cfg = resumed_config(Path(cfg.resume), STATE, cfg)
        check(cfg)
        torch.set_num_threads(cfg.threads)
        torch.manual_seed(cfg.seed)
        policy = GaussianPolicy(cfg.hidden, cfg.inputs).to(cfg.compute)
        algorithm: Algorithm = ALGORITHMS.build(cfg.algorithm, "algorithm")
        sampler: OpponentSampler = OPPONENT_SAMPLERS.build(cfg.league.sampler, "league.sampler")
        learner = algorithm.learner(policy, cfg.gamma)
        crew = RolloutWorkers(CollectorConfig(**cfg.collector), cfg.env, cfg.seed, policy, cfg.batch)
    folder = Path(cfg.resume or HydraConfig.get().runtime.output_dir)
    with closing(crew), lock_run_folder(folder, "run"):
        league, seconds = train_league(cfg, folder, policy, learner, crew, sampler)
        made_by = " ".join(["python -m airhockey_marl.train", *HydraConfig.get().overrides.task])
        facts = model_card(cfg, league)
        write_json(folder / "card.json", {"command": made_by, "seconds": round(seconds, 1), **facts})
        scores = facts["win_rate_of_last_against"]
        # the page shows the first five by name until it is asked for others: the scripts come first
        shown = {
            f"{'against' if name in SCRIPTED_PLAYERS else 'generation'}_{name}": rate for name, rate in scores.items()
        }
        log_final_scores(folder, cfg, shown, facts["steps"])
    return scores[STRONGEST_SCRIPT]


if __name__ == "__main__":
    main()
