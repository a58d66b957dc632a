"""What people do without guidance: the data that user models are trained on and parameters are calibrated on."""

from collections.abc import Callable

import numpy as np
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import check_arrays, check_counts
from airhockey_marl.players.players import Player
from guidance.simulated_users import Advisors, SimulatedUsers
from guidance.study.games import GameRunner
from guidance.study.protocol import spawn_rng_states
from guidance.user_model.data import Demonstrations


@torch.no_grad()
def collect_demonstrations(
    people: np.ndarray,
    opponent: Player,
    games: int,
    ticks: int,
    table: TableSpec,
    variant: str,
    mentors: Advisors,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Demonstrations:
    """Let each of `people` (users,) play `games` games of `ticks` ticks without guidance.

    Returns:
        `Demonstrations`: observations (users, games, ticks, 12) and actions (users, games, ticks, 2), float32. The
        action of a tick is where the hand has gone at its end, on the observation at its beginning.

    Raises:
        ValueError: `games` or `ticks` is below 1.
    """
    check_counts(games=games, ticks=ticks)
    check_arrays("V", people=(people, "users"))
    users = len(people)
    n = users * games

    def game_streams(purpose: int) -> np.ndarray:
        return np.stack([spawn_rng_states(seed, range(users), game, purpose) for game in range(games)], axis=1).ravel()

    players = SimulatedUsers(np.repeat(people, games), game_streams(2), table, variant, mentors)
    rink = GameRunner(players, opponent, table, game_streams(3))
    rink.new_games()
    observation, action = np.empty((ticks, n, 12), dtype=np.float32), np.empty((ticks, n, 2), dtype=np.float32)
    for tick in range(ticks):
        played = rink.tick()
        observation[tick], action[tick] = played.state, played.action
        scored = played.goals != 0
        if scored.any():
            rink.new_rounds(scored)
        if tick % 100 == 99:
            progress((tick + 1) / ticks)

    def by_user(trail: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(trail).transpose(0, 1).unflatten(0, (users, games)).contiguous()

    return Demonstrations(by_user(observation), by_user(action))
