"""The training of a league: each generation learns, is frozen, evaluated and saved (section 3.2.2)."""

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from omegaconf import DictConfig
from torch.utils.tensorboard import SummaryWriter

from airhockey_marl.algorithms.divergence import name_divergence
from airhockey_marl.algorithms.reward_shaping import shaping_strength
from airhockey_marl.evaluation import figures
from airhockey_marl.evaluation.matches import MatchResult, match_options, play_opponents
from airhockey_marl.experiment.checkpoint import Checkpoint
from airhockey_marl.experiment.command import report_input_errors
from airhockey_marl.experiment.config import STATE_FILE, InputError
from airhockey_marl.experiment.files import name_write_errors, write_text
from airhockey_marl.experiment.plotting import png_bytes
from airhockey_marl.experiment.progress import progress_bar
from airhockey_marl.experiment.tensorboard import add_picture, log_run_header, open_writer, tensorboard_dir
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.league.opponent_pool import OpponentPool
from airhockey_marl.league.opponent_sampling import OPPONENT_SAMPLERS
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import REFERENCE_PLAYERS
from airhockey_marl.self_play.trainer import SelfPlayTrainer

LEAGUE_FILE, MATCHES_FILE = "league.safetensors", "matches.csv"
STATE_METADATA = {"generation": int, "matches": list, "goals": list, "seconds": float}  # types in the state file
STRONGEST_SCRIPT = "striker"
CARD_ROUNDS_FACTOR = 25  # rounds on the model card / rounds after a generation: the card's win rates are kept for good
FILM_SECONDS, FILM_WIDTH = 6.0, 240  # s, pixels: a film of about 200 KB
SEED_STRIDE = 100_000  # between the match seeds of successive generations; a match uses a seed per table
TAGS = {  # x is the number of steps of play
    "update/*": "statistics of the algorithm's updates, means over a generation (TRPO: kl, gain, step, std, ...)",
    "win_rate_against/*": "share of decided rounds that a new generation wins against an older one or a script",
    "speed/steps_per_s": "steps of play per second since the start; the only scalar that differs between equal runs",
    "league/*": "pictures: win_rates, of each generation when it was the newest against earlier ones and the scripts; "
    "film, some seconds of the newest generation (left, blue) against the striker",
    "score/*": "shares of decided rounds that the last generation wins against a script (against_striker) and an older "
    "generation (generation_0)",
}
LAYOUT = {
    "League": {
        "share of rounds won against scripts": [r"win_rate_against/[a-z]+$"],
        "share of rounds won against generations": [r"win_rate_against/\d+$"],
        "STD of actions, in units of action": [r"update/std$"],
        "KL divergence of an update, and gain": [r"update/(kl|gain)$"],
        "share of TRPO's full step": [r"update/step$"],
        "loss of the critic": [r"update/critic_loss$"],
    }
}


class LeagueTraining:
    """A league in training: the components, from the policy to the pool, and the progress that a checkpoint holds.

    Args:
        cfg: as `conf/train.yaml`, checked.

    Attributes:
        generation: the number of the last finished generation.
        matches: results of the new generations, the rows of matches.csv.
        seconds: of training so far.
    """

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg
        self.trainer = SelfPlayTrainer.from_config(cfg)
        self.league = League(GaussianPolicy(cfg.hidden, cfg.inputs))
        self.league.add(self.trainer.policy)
        sampler, options = OPPONENT_SAMPLERS.build(cfg.league.sampler, "league.sampler"), cfg.league
        self.pool = OpponentPool(self.league, options.scripted_players, sampler, options.win_rate_decay)
        self.rng = np.random.default_rng(cfg.seed)  # draws the opponents
        modules = {"policy": self.trainer.policy, **self.trainer.learner.modules()}
        self.checkpoint = Checkpoint(modules, self.rng, [self.trainer.workers.rng_states])
        self.generation, self.matches, self.seconds = 0, [], 0.0

    def save(self, folder: Path) -> None:
        """Write league, matches and state."""
        self.league.save(folder / LEAGUE_FILE)
        write_text(folder / MATCHES_FILE, pd.DataFrame(self.matches).to_csv(index=False))
        metadata = {"generation": self.generation, "matches": self.matches, "seconds": self.seconds}
        self.checkpoint.save(folder / STATE_FILE, {**metadata, "goals": list(self.pool.goals.items())})

    def load(self, folder: Path) -> None:
        """Continue from the files written by `save`."""
        league = League.load(folder / LEAGUE_FILE)
        metadata = self.checkpoint.load(folder / STATE_FILE, STATE_METADATA)  # sets all random states, so it is last
        self.generation, self.matches = metadata["generation"], metadata["matches"]
        self.seconds, self.pool.goals = metadata["seconds"], dict(metadata["goals"])
        if not 0 <= self.generation < len(league):
            raise InputError(f"resume = {folder}: {LEAGUE_FILE} lacks generation {self.generation} of {STATE_FILE}")
        self.league = self.pool.league = league.prefix(self.generation)  # it may have one more, if saving was stopped


def train_league(training: LeagueTraining, folder: Path) -> None:
    """Train the generations that are missing, and write the run's files to `folder` after each."""
    cfg, trainer, pool = training.cfg, training.trainer, training.pool
    if cfg.resume is not None:
        with report_input_errors():
            training.load(folder)
    # scalars that a killed run logged after its last checkpoint are purged: they will be logged again
    writer = open_writer(tensorboard_dir(folder), training.generation * cfg.steps_per_generation + 1)
    if not training.generation:
        log_run_header(writer, cfg, TAGS, LAYOUT)
    start = time.perf_counter() - training.seconds
    generations = range(training.generation + 1, cfg.generations + 1)
    bar = progress_bar(
        generations, desc="training", unit="generations", initial=training.generation, total=cfg.generations
    )
    for generation in bar:
        opponents = pool.sample(cfg.league.opponents, training.rng)
        strength = shaping_strength(generation, cfg.shaping.generations)
        with name_divergence(f"generation {generation}", folder / STATE_FILE):
            metrics, goals = trainer.train_generation(opponents, cfg.steps_per_generation, strength)
        pool.update(opponents.player_ids, goals)
        training.league.add(trainer.policy)
        results = evaluate_generation(training.league, generation, cfg)
        training.matches += [
            {"generation": generation, "opponent": opponent, **result.as_row()} for opponent, result in results.items()
        ]
        training.generation, training.seconds = generation, time.perf_counter() - start
        with name_write_errors(tensorboard_dir(folder)):
            log_generation(writer, training, metrics, results)
        training.save(folder)
        bar.set_postfix({str(name): f"{results[name].win_rate:.2f}" for name in (0, *REFERENCE_PLAYERS)}, refresh=False)
    writer.close()
    training.seconds = time.perf_counter() - start


def evaluate_generation(league: League, generation: int, cfg: DictConfig) -> dict[PlayerId, MatchResult]:
    """Matches of a new generation against every `league.match_every`-th one before it and the scripted players."""
    opponents = league.opponent_batch([*range(0, generation, cfg.league.match_every), *REFERENCE_PLAYERS])
    seed = cfg.seed + SEED_STRIDE * generation
    return play_opponents(league.player(generation), opponents, cfg.league.match_rounds, seed, **match_options(cfg.env))


def log_generation(
    writer: SummaryWriter,
    training: LeagueTraining,
    metrics: Mapping[str, float],
    results: Mapping[PlayerId, MatchResult],
) -> None:
    """Log the newest generation to TensorBoard: mean metrics of its updates, win rates, speed, and some pictures.

    The pictures are a film against the strongest script and a heat map of all matches. The film has a random generator
    of its own, so `pictures_every` does not change the league.
    """
    cfg, generation = training.cfg, training.generation
    step = generation * cfg.steps_per_generation
    scalars = {f"update/{name}": value for name, value in metrics.items()}
    scalars |= {f"win_rate_against/{opponent}": result.win_rate for opponent, result in results.items()}
    for name, value in {**scalars, "speed/steps_per_s": step / training.seconds}.items():
        writer.add_scalar(name, value, step)
    if cfg.pictures_every and (generation % cfg.pictures_every == 0 or generation == cfg.generations):
        players, options = (generation, STRONGEST_SCRIPT), {"width": FILM_WIDTH, **match_options(cfg.env)}
        film = figures.film(training.league, players, cfg.seed, FILM_SECONDS, **options)
        add_picture(writer, "league/film", film, step)
        heat_map = png_bytes(figures.win_rates_figure(pd.DataFrame(training.matches)), 100)
        add_picture(writer, "league/win_rates", heat_map, step)
    writer.flush()


def model_card(cfg: DictConfig, league: League) -> dict:
    """The model card of a league: its origin, hashes and configuration, and the last generation's win rates."""
    last = len(league) - 1
    opponents = [*sorted({0, last // 4, last // 2, 3 * last // 4} - {last}), *REFERENCE_PLAYERS]
    rounds, batch = CARD_ROUNDS_FACTOR * cfg.league.match_rounds, league.opponent_batch(opponents)
    results = play_opponents(league.player(last), batch, rounds, cfg.seed + 1, **match_options(cfg.env))
    return {
        "model": "optimal action model: a league of self-play generations (section 3.2.2)",
        "steps": cfg.generations * cfg.steps_per_generation,
        "generations": len(league),
        "win_rate_of_last_against": {str(opponent): round(result.win_rate, 3) for opponent, result in results.items()},
        "hashes": league.hashes,
    }
