"""Train the user prediction models: one meta-learned for user adaptation, one for people in general (section 3.2.3).

    python -m guidance.meta_train                      the paper's schedule, on nine simulated users
    python -m guidance.meta_train +preset=smoke        seconds, to see that it runs
    tensorboard --logdir outputs                       watch

Writes into its run folder: meta.safetensors, user.safetensors, card.json (what they are, how well they predict people
they have not seen) and tensorboard/.
"""

import sys
import time
from functools import partial
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import nn
from torchrl.record.loggers.tensorboard import TensorboardLogger
from tqdm import tqdm

from airhockey_marl.cli import ProgressBar, command, input_errors, require_counts, require_numbers
from airhockey_marl.files import sha256, write_json
from airhockey_marl.league import League
from airhockey_marl.match import confident
from airhockey_marl.policy import GaussianPolicy
from airhockey_marl.table import Table, reach
from guidance.demonstrations import collect
from guidance.maml import forward_each, parameters
from guidance.models import save_user_model
from guidance.user_model import Demonstrations, adapt_to_user, prediction_loss, train_maml, train_supervised
from guidance.users import Population, load_mentors, sample_people, training_people

HELD_OUT_SEED = 1_000_003  # the card's people: neither the training users nor those of a study with a small seed


def check(cfg: DictConfig) -> None:
    """Refuse what cannot run.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    require_counts(cfg, "threads", "maml.epochs", "maml.block", "supervised.epochs", "supervised.batch_size")
    require_counts(cfg, "seed", least=0)
    require_counts(cfg, "demonstrations.games", least=2)  # one to adapt to and one to validate on
    require_counts(cfg, "demonstrations.ticks", least=cfg.maml.block)
    require_numbers(cfg, "maml.inner_lr", "maml.lr", "maml.max_norm", "supervised.lr")


@command("meta_train")
def main(cfg: DictConfig) -> None:
    with input_errors():
        check(cfg)
        population: Population = hydra.utils.instantiate(cfg.users.population)
        mentors = load_mentors(cfg.users.mentors)
        opponent = confident(League.load(cfg.models.league).player(cfg.opponent))
        torch.manual_seed(cfg.seed)
        meta, user = GaussianPolicy(cfg.hidden), GaussianPolicy(cfg.hidden)
    torch.set_num_threads(cfg.threads)
    folder, began = Path(HydraConfig.get().runtime.output_dir), time.perf_counter()

    progress = ProgressBar()

    def play(people: np.ndarray, seed: int, what: str) -> Demonstrations:
        told = partial(progress, what)
        how = {"table": Table(), "variant": cfg.users.variant, "mentors": mentors, "seed": seed}
        return collect(people, opponent, **cfg.demonstrations, **how, progress=told)

    data = play(training_people(cfg.seed, population), cfg.seed, "nine people play")
    generator = torch.Generator().manual_seed(cfg.seed)
    trainings = {
        "maml": train_maml(meta, data, **cfg.maml, generator=generator),
        "supervised": train_supervised(user, data, **cfg.supervised, generator=generator),
    }
    progress.close()
    logger = TensorboardLogger("tensorboard", log_dir=str(folder))
    for name, training in trainings.items():
        bar = tqdm(training, total=cfg[name].epochs, desc=name, unit="epoch", file=sys.stderr, disable=None)
        for metrics in bar:
            epoch = metrics.pop("epoch")
            logger.log_metrics({f"{name}/{key}": value for key, value in metrics.items()}, step=epoch)
            bar.set_postfix({key: f"{value:.3f}" for key, value in metrics.items()})

    strangers = sample_people(len(data.action), HELD_OUT_SEED, population)
    scores = prediction_scores(meta, user, play(strangers, HELD_OUT_SEED, "nine others play"), cfg.maml.inner_lr)
    logger.log_metrics({f"held_out/{key}": value for key, value in scores.items()}, step=cfg.maml.epochs)
    facts = {"seed": cfg.seed, "inner_lr": cfg.maml.inner_lr}
    save_user_model(folder / "meta.safetensors", meta, facts)
    save_user_model(folder / "user.safetensors", user, {"seed": cfg.seed})
    write_json(folder / "card.json", card(cfg, scores, time.perf_counter() - began))


@torch.no_grad()
def prediction_scores(meta: nn.Module, user: nn.Module, data: Demonstrations, inner_lr: float) -> dict[str, float]:
    """How the models predict people they were not trained on: each person's last game, after UA with the first.

    Returns:
        Per model the loss of Eq. 3 and the root mean square error in units of action. What a model must beat to be
        called a prediction: `persistence`, the action is where the paddle is, and `extrapolation`, it is where the
        paddle's velocity takes it in a time fitted to the first games.
    """

    def paddle(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Position and velocity (..., 2) of the own paddle in units of action, and per second."""
        middle, half = (torch.tensor(part, dtype=torch.float32) for part in reach(Table()))
        return (observation[..., 0:2] - middle) / half, observation[..., 2:4] / half

    first, last = data.observation[:, 0], data.observation[:, -1]  # (users, ticks, 12)
    action = data.action[:, -1]
    adapted = adapt_to_user(meta, parameters(meta), first, data.action[:, 0], inner_lr)
    predictions = {
        "supervised": user(last),
        "maml_before_ua": meta(last),
        "maml_after_ua": forward_each(meta, adapted, last),
    }
    scores = {}
    for name, (mean, std) in predictions.items():
        scores[f"{name}_loss"] = prediction_loss(mean, std, action).item()
        scores[f"{name}_rmse"] = (mean - action).square().sum(-1).mean().sqrt().item()
    place, velocity = paddle(first)
    ahead = (velocity * (data.action[:, 0] - place)).sum() / velocity.square().sum()  # s
    place, velocity = paddle(last)
    for name, guess in (("persistence", place), ("extrapolation", place + ahead * velocity)):
        scores[f"{name}_rmse"] = (guess - action).square().sum(-1).mean().sqrt().item()
    return scores


def card(cfg: DictConfig, scores: dict[str, float], seconds: float) -> dict:
    """The model card: how the models were made, and how they predict."""
    return {
        "models": "user prediction models (section 3.2.3): meta.safetensors for UA, user.safetensors without",
        "command": " ".join(["python -m guidance.meta_train", *HydraConfig.get().overrides.task]),
        "date": time.strftime("%Y-%m-%d"),
        "seed": cfg.seed,
        "seconds": round(seconds, 1),
        "data": f"nine simulated training users, {cfg.demonstrations.games} x {cfg.demonstrations.ticks} ticks each",
        "league_sha256": sha256(cfg.models.league),
        "on_nine_others": {name: round(value, 4) for name, value in scores.items()},
        "config": OmegaConf.to_container(cfg),
    }


if __name__ == "__main__":
    main()
