"""Train the optimal action model: a league of generations that learn by playing those before them (section 3.2.2).

    python -m airhockey_marl.train                     the paper's 100 generations x 200 K steps
    python -m airhockey_marl.train +preset=smoke       seconds, to see that it runs
    python -m airhockey_marl.train -m seed=0,1,2       three seeds, one after another
    python -m airhockey_marl.train resume=outputs/...  go on with a run that was stopped, as if it had not been
    tensorboard --logdir outputs                       watch

Writes into its run folder: league.safetensors (every generation), card.json (what it is, and how it plays), and
tensorboard/. The league is written again after each generation, whole, and so is state.safetensors, from which
`resume` goes on: the weights end bit for bit as those of a run that was never stopped.
"""

import sys
import time
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.objectives.value import GAE
from torchrl.record.loggers.tensorboard import TensorboardLogger
from tqdm import tqdm

from airhockey_marl.checkpoint import Learner
from airhockey_marl.cli import InputError, command, input_errors, require_counts, require_numbers
from airhockey_marl.env import make_env, serve_streams
from airhockey_marl.files import load_tensors, save_tensors, write_json
from airhockey_marl.league import League, Sampler
from airhockey_marl.match import play_match, sampled
from airhockey_marl.policy import Critic, GaussianPolicy
from airhockey_marl.seats import LEARNER, OPPONENT, Seat, actor, learner_view
from airhockey_marl.shaping import Shaping
from airhockey_marl.trpo import TRPO

LEAGUE, STATE = "league.safetensors", "state.safetensors"


def check(cfg: DictConfig) -> None:
    """Refuse what cannot run.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    counts = ("threads", "generations", "steps_per_generation", "batch")
    require_counts(cfg, *counts, "env.tables", "env.decision_ticks", "league.opponents", "league.match_rounds")
    require_counts(cfg, "seed", "shaping.generations", least=0)
    require_numbers(cfg, "gamma", "gae_lambda", at_most=1.0)
    require_numbers(cfg, "env.round_seconds")
    for whole, part in (("batch", "env.tables"), ("steps_per_generation", "batch"), ("env.tables", "league.opponents")):
        if OmegaConf.select(cfg, whole) % OmegaConf.select(cfg, part):
            raise InputError(
                f"{whole} = {OmegaConf.select(cfg, whole)} must be a multiple of {part} = {OmegaConf.select(cfg, part)}"
            )


@command("train")
def main(cfg: DictConfig) -> None:
    with input_errors():
        if cfg.resume is not None:
            cfg = config_of(Path(cfg.resume))
        check(cfg)
        algorithm: TRPO = hydra.utils.instantiate(cfg.algorithm)
        sampler: Sampler = hydra.utils.instantiate(cfg.league.sampler)
        torch.manual_seed(cfg.seed)
        policy = GaussianPolicy(cfg.hidden)
        env = make_env(cfg.env.backend, cfg.env.tables, cfg.env.round_seconds, cfg.env.decision_ticks, cfg.seed)
    folder, began = Path(cfg.resume or HydraConfig.get().runtime.output_dir), time.perf_counter()
    league = train(cfg, folder, env, policy, algorithm, sampler)
    seconds = time.perf_counter() - began
    made_by = " ".join(["python -m airhockey_marl.train", *HydraConfig.get().overrides.task])
    write_json(folder / "card.json", {"command": made_by, "seconds": round(seconds, 1), **card(cfg, league)})


def config_of(run: Path) -> DictConfig:
    """The configuration of an earlier run, to go on with it.

    Raises:
        ValueError: it is not a run of this command that has finished a generation.
    """
    if not (run / STATE).is_file() or not (run / ".hydra" / "config.yaml").is_file():
        raise ValueError(f"resume = {run} is not the folder of a run with a finished generation ({STATE})")
    cfg = OmegaConf.load(run / ".hydra" / "config.yaml")
    cfg.resume = str(run)
    return cfg


def train(
    cfg: DictConfig, folder: Path, env: EnvBase, policy: GaussianPolicy, algorithm: TRPO, sampler: Sampler
) -> League:
    """Run the league: generation after generation learns against those before it, is frozen and written to `folder`.

    Args:
        cfg: what `check` has passed; with `resume`, it goes on after the last generation that `folder` holds.
        env: the tables; the learner sits at the left of each.
        policy: generation 0, trained in place.
    """
    torch.set_num_threads(cfg.threads)
    critic = Critic()
    learner = Learner(policy, critic, algorithm.optimizer(critic), np.random.default_rng(cfg.seed), serve_streams(env))
    shaping = Shaping(cfg.shaping.position, cfg.shaping.velocity, cfg.shaping.approach)
    value = TensorDictModule(critic, in_keys=["observation"], out_keys=["state_value"])
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.gae_lambda, value_network=value)
    league, opponent = League(GaussianPolicy(cfg.hidden)), Seat(policy)
    league.add(policy)
    collector = Collector(
        env,
        TensorDictSequential(actor(LEARNER, policy), actor(OPPONENT, opponent)),
        frames_per_batch=cfg.batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    batches, logger = iter(collector), TensorboardLogger("tensorboard", log_dir=str(folder))
    done = 0
    if cfg.resume is not None:
        done = learner.load(folder / STATE)
        tensors, _ = load_tensors(folder / LEAGUE)
        league = League.from_stacked(league.policy, {name: tensor[: done + 1] for name, tensor in tensors.items()})
    began = time.perf_counter()
    todo = range(done + 1, cfg.generations + 1)
    bar = tqdm(todo, desc="generation", initial=done, total=cfg.generations, file=sys.stderr, disable=None)
    for generation in bar:
        opponent.policy = league.opponents(sampler, cfg.league.opponents, learner.rng)
        collector.reset()  # a generation depends on nothing but the league, the learner and the random numbers
        strength = max(0.0, 1.0 - (generation - 1) / cfg.shaping.generations) if cfg.shaping.generations else 0.0
        for _ in range(cfg.steps_per_generation // cfg.batch):
            with torch.no_grad():
                view = advantage(learner_view(next(batches), shaping, strength, cfg.gamma))
            metrics = algorithm.update(policy, critic, learner.optimizer, view.reshape(-1))
        league.add(policy)
        save_tensors(folder / LEAGUE, league.stacked(), {"hidden": list(cfg.hidden)})
        steps = generation * cfg.steps_per_generation
        ratings = rate(league, generation, cfg.league.match_rounds, cfg.seed)
        ratings["steps_per_s"] = (generation - done) * cfg.steps_per_generation / (time.perf_counter() - began)
        logger.log_metrics({f"trpo/{name}": value for name, value in metrics.items()}, step=steps)
        logger.log_metrics({f"league/{name}": value for name, value in ratings.items()}, step=steps)
        learner.save(folder / STATE, generation)
        bar.set_postfix({name: f"{value:.2f}" for name, value in ratings.items() if name.startswith("win")})
    collector.shutdown()
    return league


def rate(league: League, generation: int, rounds: int, seed: int) -> dict[str, float]:
    """How the newest generation does against the untrained one and against the one half its age."""
    return {
        f"win_rate_vs_{name}": win_rate(league, generation, other, rounds, seed)
        for name, other in (("first", 0), ("half_age", generation // 2))
    }


def win_rate(league: League, generation: int, other: int, rounds: int, seed: int) -> float:
    """Share of decided rounds that `generation` wins against `other`."""
    generator = torch.Generator().manual_seed(seed)
    left, right = (sampled(league.player(g), generator) for g in (generation, other))
    return play_match(left, right, rounds, seed).win_rate


def card(cfg: DictConfig, league: League) -> dict:
    """The model card of a league: what it is, and how its last generation plays."""
    last = len(league) - 1
    others = sorted({0, last // 4, last // 2, 3 * last // 4} - {last})
    return {
        "model": "optimal action model: a league of self-play generations (section 3.2.2)",
        "date": time.strftime("%Y-%m-%d"),
        "seed": cfg.seed,
        "steps": cfg.generations * cfg.steps_per_generation,
        "generations": len(league),
        "win_rate_of_last_against": {
            g: round(win_rate(league, last, g, 10 * cfg.league.match_rounds, cfg.seed + 1), 3) for g in others
        },
        "hashes": league.hashes,
        "config": OmegaConf.to_container(cfg),
    }


if __name__ == "__main__":
    main()
