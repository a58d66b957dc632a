"""Play without guidance: the data on which user models are trained and parameters are calibrated."""

from collections.abc import Callable

import numpy as np
import torch

from guidance.study.games import GameRunner
from guidance.study.protocol import RandomStream, spawn_rng_states
from guidance.study.setup import PlaySetup
from guidance.user_model.data import Demonstrations


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
