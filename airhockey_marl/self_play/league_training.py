"""The training loop of a league: a generation learns, is frozen, measured and saved, again and again (section 3.2.2)."""

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from omegaconf import DictConfig, OmegaConf
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from airhockey_marl.algorithms.base import Learner
from airhockey_marl.algorithms.divergence import name_divergence
from airhockey_marl.algorithms.reward_shaping import RewardShaping, shaping_strength
from airhockey_marl.evaluation import figures
from airhockey_marl.evaluation.matches import play_each
from airhockey_marl.experiment.checkpoint import Checkpoint
from airhockey_marl.experiment.command import (
    InputError,
    report_input_errors,
)
from airhockey_marl.experiment.files import name_write_errors, write_text
from airhockey_marl.experiment.plotting import png_bytes
from airhockey_marl.experiment.tensorboard import add_picture, log_run_header, open_writer, tensorboard_dir
from airhockey_marl.league.league import League, PlayerId
from airhockey_marl.league.opponent_pool import OpponentPool
from airhockey_marl.league.opponent_sampling import OpponentSampler
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.scripted import REFERENCE_PLAYERS
from airhockey_marl.self_play.collectors import RolloutWorkers
from airhockey_marl.self_play.trainer import SelfPlayTrainer

LEAGUE, MATCHES, STATE = "league.safetensors", "matches.csv", "state.safetensors"
FACTS = {"generation": int, "matches": list, "goals": list, "seconds": float}  # of the state
STRONGEST_SCRIPT = "striker"  # of the scripts: the strongest
CARD_ROUNDS = 25  # times as many rounds as in training, for the scores on the card
FILM_SECONDS, FILM_WIDTH = 6.0, 240  # of play, and pixels
SEEDS_APART = 100_000  # more than there are tables in a match, each of which has a seed of its own
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
    },
}


def train_league(
    cfg: DictConfig,
    folder: Path,
    policy: GaussianPolicy,
    learner: Learner,
    crew: RolloutWorkers,
    sampler: OpponentSampler,
) -> tuple[League, float]:
    """Run the league: generation after generation learns against those before it, is frozen and written to `folder`.

    Args:
        cfg: what `check` has passed; with `resume`, it goes on after the last generation that `folder` holds.
        policy: generation 0, trained in place by `learner`.
        crew: plays the tables; the policy sits at the left of each.
        sampler: chooses whom it meets.

    Returns:
        The league, and the seconds it took, before it was resumed and after.
    """
    checkpoint = Checkpoint({"policy": policy, **learner.parts()}, np.random.default_rng(cfg.seed), [crew.streams])
    shaping = RewardShaping(cfg.shaping.position, cfg.shaping.velocity, cfg.shaping.shot, cfg.shaping.approach)
    practice = SelfPlayTrainer(crew, policy, shaping, cfg.gamma)
    pool = OpponentPool(League(GaussianPolicy(cfg.hidden, cfg.inputs)), cfg.league.anchors, sampler, cfg.league.memory)
    pool.league.add(policy)
    done, matches, seconds = 0, [], 0.0
    if cfg.resume is not None:
        with report_input_errors():
            written = League.load(folder / LEAGUE)
            facts = checkpoint.load(folder / STATE, FACTS)  # last: now the random numbers are those of the run
            if not 0 <= facts["generation"] < len(written):
                raise InputError(f"resume = {folder}: {LEAGUE} lacks generation {facts['generation']} of {STATE}")
        done, matches, seconds = facts["generation"], facts["matches"], facts["seconds"]
        pool.goals = dict(facts["goals"])
        pool.league = written.until(done)
    # What a killed run logged after its last checkpoint is struck out, so no scalar stands twice.
    board = open_writer(tensorboard_dir(folder), done * cfg.steps_per_generation + 1)
    if not done:
        log_run_header(board, cfg, TAGS, LAYOUT)
    began = time.perf_counter() - seconds
    todo = range(done + 1, cfg.generations + 1)
    bar = tqdm(todo, desc="generation", initial=done, total=cfg.generations, file=sys.stderr, disable=None)
    for generation in bar:
        opponents = pool.draw(cfg.league.opponents, checkpoint.rng)
        strength = shaping_strength(generation, cfg.shaping.generations)
        with name_divergence(f"generation {generation}", folder / STATE):
            metrics, goals = practice.generation(learner, opponents, cfg.steps_per_generation, strength)
        pool.remember(opponents.members, goals)
        pool.league.add(policy)
        others = reference_opponents(generation, cfg.league.match_every)
        results = play_each(
            pool.league.player(generation),
            pool.league.lineup(others),
            cfg.league.match_rounds,
            cfg.seed + SEEDS_APART * generation,
            cfg.env.frame_skip,
        )
        matches += [
            {"generation": generation, "opponent": opponent, **result._asdict()} for opponent, result in results.items()
        ]

        step, seconds = generation * cfg.steps_per_generation, time.perf_counter() - began
        rates = {str(opponent): result.win_rate for opponent, result in results.items()}
        scalars = {f"update/{name}": value for name, value in metrics.items()}
        scalars |= {f"win_rate_against/{name}": value for name, value in rates.items()}
        with name_write_errors(tensorboard_dir(folder)):
            for name, value in {**scalars, "speed/steps_per_s": step / seconds}.items():
                board.add_scalar(name, value, step)
            if cfg.pictures_every and (generation % cfg.pictures_every == 0 or generation == cfg.generations):
                log_pictures(board, pool.league, matches, cfg.seed, cfg.env.frame_skip, step)
            board.flush()
        pool.league.save(folder / LEAGUE)
        write_text(folder / MATCHES, pd.DataFrame(matches).to_csv(index=False))
        facts = {"generation": generation, "matches": matches, "goals": list(pool.goals.items()), "seconds": seconds}
        checkpoint.save(folder / STATE, facts)
        bar.set_postfix({name: f"{rates[name]:.2f}" for name in ("0", *REFERENCE_PLAYERS)})
    board.close()
    return pool.league, time.perf_counter() - began


def log_pictures(
    board: SummaryWriter, league: League, matches: list[dict], seed: int, frame_skip: int, step: int
) -> None:
    """Log the newest generation against the strongest script, as a film, and all matches so far, as a heat map.

    The random numbers are the film's own: the league is the same with pictures and without.
    """
    seats, how = (len(league) - 1, STRONGEST_SCRIPT), {"frame_skip": frame_skip, "width": FILM_WIDTH}
    add_picture(board, "league/film", figures.film(league, seats, seed, FILM_SECONDS, **how), step)
    add_picture(board, "league/win_rates", png_bytes(figures.win_rates_figure(pd.DataFrame(matches)), 100), step)


def reference_opponents(generation: int, every: int) -> list[PlayerId]:
    """Whom a new generation is measured against: each `every`-th generation before it, and the scripted anchors."""
    return [*range(0, generation, every), *REFERENCE_PLAYERS]


def model_card(cfg: DictConfig, league: League) -> dict:
    """The model card of a league: what it is, and how its last generation plays."""
    last = len(league) - 1
    others = [*sorted({0, last // 4, last // 2, 3 * last // 4} - {last}), *REFERENCE_PLAYERS]
    rounds = CARD_ROUNDS * cfg.league.match_rounds
    results = play_each(league.player(last), league.lineup(others), rounds, cfg.seed + 1, cfg.env.frame_skip)
    return {
        "model": "optimal action model: a league of self-play generations (section 3.2.2)",
        "date": time.strftime("%Y-%m-%d"),
        "seed": cfg.seed,
        "steps": cfg.generations * cfg.steps_per_generation,
        "generations": len(league),
        "win_rate_of_last_against": {str(opponent): round(result.win_rate, 3) for opponent, result in results.items()},
        "hashes": league.hashes,
        "config": OmegaConf.to_container(cfg),
    }
