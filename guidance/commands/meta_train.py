"""Train the user prediction models: one meta-learned for user adaptation, one for people in general (section 3.2.3).

    airhockey meta_train                               the paper's schedule, on nine simulated users
    airhockey meta_train +preset=smoke                 seconds, to see that it runs
    airhockey meta_train resume=outputs/meta_train/...  continue a stopped run
    tensorboard --logdir outputs                       watch

Writes into its run folder: meta.safetensors, user.safetensors, card.json (configuration, and prediction errors on
unseen people), tensorboard/, and after each epoch state.safetensors, from which `resume` continues. With `data` every
person in it is a training user, the errors are on the last part of each person's play, which nothing is trained on, and
data.json says what was read and left out. guidance/user_model/README.md has the columns of a table of your own.
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import STATE_FILE, InputError
from airhockey_marl.experiment.files import load_json, sha256, write_json
from airhockey_marl.experiment.progress import ProgressBar, progress_bar
from airhockey_marl.experiment.run_folder import card_facts, lock_run_folder, note_headline

if TYPE_CHECKING:
    from torch import nn

    from guidance.user_model.data import Demonstrations, Recordings, Samples

TAGS = {
    "maml/*": "per epoch: loss of Eq. 3 after adaptation (Eq. 2), and loss_before it",
    "supervised/*": "per epoch: loss of Eq. 3 without meta-learning",
    "score/*": "losses of Eq. 3 on people who were not trained on, and rmse of the predictions in units of action",
}
LAYOUT = {
    "User models": {
        "loss of Eq. 3, with meta-learning": [r"maml/loss$", r"maml/loss_before$"],
        "loss of Eq. 3, without": [r"supervised/loss$"],
    },
}

COMPILERS = ("g++", "clang++")  # that torch.compile looks for
HELD_OUT_SEED = 1_000_003  # the card's people: neither the training users nor those of a study with a small seed


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "maml.epochs", "maml.block", "supervised.epochs", "supervised.batch_size")
    if cfg.data is None:
        require_counts(cfg, "demonstrations.games", least=2)  # one to adapt to and one to validate on
        require_counts(cfg, "demonstrations.ticks", least=cfg.maml.block)
    require_numbers(cfg, "hold_out", least=0.05, at_most=0.5)
    require_numbers(cfg, "ahead", least=0.0, at_most=1.0)
    require_numbers(cfg, "maml.inner_lr", "maml.lr", "maml.max_norm", "supervised.lr")
    if cfg.maml.compiled and not any(map(shutil.which, COMPILERS)):
        raise InputError(f"maml.compiled = true needs a C++ compiler, one of {', '.join(COMPILERS)}, and finds none")


class SimulatedPeople:
    """Nine simulated training users, and nine others on whom the models are tested."""

    def __init__(self, cfg: DictConfig) -> None:
        from guidance.simulated_users import load_population
        from guidance.study.demonstrations import collect_demonstrations
        from guidance.study.setup import load_play_setup

        self.cfg, self.population, self.setup = cfg, load_population(cfg.users), load_play_setup(cfg)
        self.play = partial(collect_demonstrations, setup=self.setup, **cfg.demonstrations)
        self.progress = ProgressBar()

    def training_data(self, folder: Path) -> Demonstrations:
        from guidance.simulated_users import training_people
        from guidance.user_model.data import Demonstrations, action_ahead

        people = training_people(self.cfg.seed, self.population)
        data = self.play(people, seed=self.cfg.seed, progress=partial(self.progress, "nine people play"))
        self.progress.close()
        action = action_ahead(data.observation, data.action, self.cfg.ahead, self.setup.table)
        return Demonstrations(data.observation, action)

    def tests(self) -> list[tuple[Samples, Samples]]:
        """Of each of nine others a game for UA, and one to predict."""
        from guidance.simulated_users import sample_people

        others = sample_people(9, HELD_OUT_SEED, self.population)
        data = self.play(others, seed=HELD_OUT_SEED, progress=partial(self.progress, "nine others play"))
        self.progress.close()
        people = zip(data.observation, data.action, strict=True)
        return [((states[0], actions[0]), (states[-1], actions[-1])) for states, actions in people]

    def card(self, scores: dict[str, float]) -> dict:
        return {
            "data": "nine simulated training users, {games} x {ticks} ticks each".format(**self.cfg.demonstrations),
            "opponents_sha256": sha256(self.cfg.models.opponents),
            "on_nine_others": scores,
        }


class RecordedPeople:
    """The people of `data`, whose last play the models are tested on."""

    def __init__(self, cfg: DictConfig) -> None:
        from guidance.user_model.recordings import read_recordings, words

        self.cfg, block = cfg, cfg.maml.block
        recordings, self.facts = read_recordings(cfg.data, block)
        self.left_out = words(self.facts["left_out"])
        self.training, self.held_out = recordings.split(cfg.hold_out)
        for label, pieces in self.training.people.items():
            if sum(len(action) // block for _, action in pieces) < 2:
                ticks = sum(len(action) for _, action in recordings.people[label])
                raise InputError(
                    f"data = {cfg.data}: {label} has {ticks} ticks in pieces of at least maml.block = {block}; without "
                    f"the last {cfg.hold_out:g} of them they must make two blocks"
                )

    def training_data(self, folder: Path) -> Recordings:
        from airhockey_marl.envs.physics import TableSpec

        file = folder / "data.json"
        with report_input_errors():
            if self.cfg.resume is not None and (before := load_json(file)) != self.facts:
                changed = [name for name in self.facts if before.get(name) != self.facts[name]]
                raise InputError(f"data = {self.cfg.data}: {', '.join(changed)} must be as in {file}, as the run began")
        write_json(file, self.facts)
        print("data: {people} people, {games} games, {ticks} ticks; left out:".format(**self.facts), self.left_out)
        return self.training.ahead(self.cfg.ahead, TableSpec())

    def tests(self) -> list[tuple[Samples, Samples]]:
        """Of each person the longest piece trained on, for UA, and the longest held out."""
        pieces = zip(self.training.people.values(), self.held_out.people.values(), strict=True)
        return [tuple(max(part, key=lambda piece: len(piece[1])) for part in parts) for parts in pieces]

    def card(self, scores: dict[str, float]) -> dict:
        share = f"the last {self.cfg.hold_out:.0%} of each person's ticks, after UA with their longest piece before"
        return {"data": self.facts, "held_out": share, "on_held_out": scores}


def main(cfg: DictConfig) -> float:
    """Train both; for a sweeper, the loss of Eq. 3 after UA on play that the model was not trained on."""
    import torch

    from airhockey_marl.envs.physics import TableSpec
    from airhockey_marl.experiment.tensorboard import log_final_scores
    from airhockey_marl.players.networks import GaussianPolicy
    from guidance.study.models import save_user_model
    from guidance.user_model.evaluation import unseen_scores

    with report_input_errors():
        people = SimulatedPeople(cfg) if cfg.data is None else RecordedPeople(cfg)
        torch.manual_seed(cfg.seed)
        meta, user = GaussianPolicy(cfg.hidden), GaussianPolicy(cfg.hidden)
    with lock_run_folder(cfg) as folder:
        data = people.training_data(folder)
        seconds = train_both(cfg, folder, meta.to(cfg.compute), user.to(cfg.compute), data.to(cfg.compute))
        meta.cpu(), user.cpu()
        with torch.no_grad():
            scores = unseen_scores(user, meta, cfg.maml.inner_lr, people.tests(), cfg.ahead, TableSpec())
        facts = {"seed": cfg.seed, "ahead_s": cfg.ahead}
        save_user_model(folder / "meta.safetensors", meta, {**facts, "inner_lr": cfg.maml.inner_lr})
        save_user_model(folder / "user.safetensors", user, facts)
        card = {
            "models": "user prediction models (section 3.2.3): meta.safetensors for UA, user.safetensors without",
            **people.card({name: round(value, 4) for name, value in scores.items()}),
        }
        write_json(folder / "card.json", card | card_facts(cfg, seconds))
        log_final_scores(folder, cfg, scores)
        note_headline(folder, f"loss after UA {scores['after_ua_loss']:.3g}, error {scores['after_ua_rmse']:.3g}")
    return scores["after_ua_loss"]


def train_both(
    cfg: DictConfig, folder: Path, meta: nn.Module, user: nn.Module, data: Demonstrations | Recordings
) -> float:
    """Train the meta-learned model, then the one for people in general, both in place; resume if `cfg` says so.

    The state is written after each epoch, so that a run that was stopped ends like one that was not. Returns the
    seconds that it took, before it was resumed and after.
    """
    import numpy as np
    import torch

    from airhockey_marl.algorithms.divergence import name_divergence
    from airhockey_marl.experiment.checkpoint import Checkpoint
    from airhockey_marl.experiment.tensorboard import log_run_header, open_writer, tensorboard_dir
    from guidance.user_model.training import train_maml, train_supervised

    models = {"maml": meta, "supervised": user}
    optimizers = {name: torch.optim.Adam(model.parameters(), cfg[name].lr) for name, model in models.items()}
    parts = {**models, **{f"{name}_optimizer": optimizer for name, optimizer in optimizers.items()}}
    checkpoint = Checkpoint(parts, np.random.default_rng(cfg.seed), [])
    done, seconds = dict.fromkeys(models, 0), 0.0
    if cfg.resume is not None:
        with report_input_errors():
            facts = checkpoint.load(folder / STATE_FILE, {"done": dict, "seconds": float})
        done, seconds = facts["done"], facts["seconds"]
    start = time.perf_counter() - seconds
    for name, train in (("maml", train_maml), ("supervised", train_supervised)):
        # What a killed run logged after its last checkpoint is struck out, so no scalar stands twice.
        board = open_writer(tensorboard_dir(folder) / name, done[name] + 1)
        if name == "maml" and not done[name]:
            log_run_header(board, cfg, TAGS, LAYOUT)
        training = train(models[name], data, **cfg[name], optimizer=optimizers[name], done=done[name])
        bar = progress_bar(training, desc=name, total=cfg[name].epochs, initial=done[name], unit="epochs")
        with name_divergence(f"{name} training", folder / STATE_FILE):
            for metrics in bar:
                epoch = metrics.pop("epoch")
                for key, value in metrics.items():
                    board.add_scalar(f"{name}/{key}", value, epoch)
                board.flush()
                bar.set_postfix({key: f"{value:.3f}" for key, value in metrics.items()}, refresh=False)
                done[name], seconds = epoch, time.perf_counter() - start
                checkpoint.save(folder / STATE_FILE, {"done": done, "seconds": seconds})
        board.close()
    return seconds
