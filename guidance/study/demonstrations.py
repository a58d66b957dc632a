"""Play without guidance: the data on which user models are trained, and results of people by skill."""

from collections.abc import Callable

import numpy as np
import torch

from guidance.simulated_users import Population, sample_people
from guidance.simulated_users.validation.measures import SKILLS
from guidance.study.games import GameRunner, no_force, play_games
from guidance.study.protocol import Protocol, RandomStream, spawn_rng_states, user_and_table_states
from guidance.study.setup import PlaySetup
from guidance.user_model.data import Demonstrations

SKILL_TRIAL = 3000  # in the seeds, where a study has the number of its condition


@torch.no_grad()
def collect_demonstrations(
    people: np.ndarray,
    setup: PlaySetup,
    games: int,
    ticks: int,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Demonstrations:
    """Play `games` games of `ticks` ticks with each of `people` (users,), without guidance.

    Returns:
        `Demonstrations`: observations (users, games, ticks, 12) and actions (users, games, ticks, 2), float32. The
        action of a tick is the hand position at its end, the observation that at its beginning.
    """
    users = len(people)
    n = users * games

    def rng_states(stream: RandomStream) -> np.ndarray:
        return np.stack([spawn_rng_states(seed, range(users), game, stream) for game in range(games)], axis=1).ravel()

    demonstrators = rng_states(RandomStream.DEMONSTRATOR)
    players = setup.simulated_users(np.repeat(people, games), demonstrators)
    runner = GameRunner(players, setup.opponent, setup.table, rng_states(RandomStream.DEMONSTRATION_TABLE))
    runner.new_games()
    observation, action = np.empty((ticks, n, 12), dtype=np.float32), np.empty((ticks, n, 2), dtype=np.float32)
    for tick in range(ticks):
        step = runner.tick()
        observation[tick], action[tick] = step.state, step.action
        scored = step.goals != 0
        if scored.any():
            runner.new_rounds(scored)
        if tick % 100 == 99:
            progress((tick + 1) / ticks)

    def by_user(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).transpose(0, 1).unflatten(0, (users, games)).contiguous()

    return Demonstrations(by_user(observation), by_user(action))


def results_by_skill(population: Population, number: int, setup: PlaySetup, seed: int) -> dict[str, np.ndarray]:
    """Rounds won and shots stopped by `number` people of each of `SKILLS`, a value per person each."""
    won, stopped = {}, {}
    protocol = Protocol(familiarization=0, rounds=14, extra_rounds=0, min_seconds=0, round_seconds=30)
    for trial, skill in enumerate(SKILLS):
        people = sample_people(number, seed + 300, population.with_parameters(skill_mean=skill, skill_sd=0.0))
        users, serves = user_and_table_states(seed, range(number), SKILL_TRIAL + trial)
        players = setup.simulated_users(people, users)
        results = play_games(players, setup.opponent, no_force, protocol, setup.table, serves).results
        won[f"rounds won, skill {skill:+.1f}"] = results["win_rate"]
        stopped[f"shots stopped, skill {skill:+.1f}"] = results["defense_rate"]
    return {**won, **stopped}
