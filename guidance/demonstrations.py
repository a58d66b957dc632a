"""What people do without guidance: the data that user models are trained on and parameters are calibrated on."""

from collections.abc import Callable

import numpy as np
import torch

from airhockey_marl.match import Player
from airhockey_marl.table import LEFT, RIGHT, Table
from airhockey_marl.tables import Tables
from guidance.games import streams
from guidance.user_model import Demonstrations
from guidance.users import Mentors, Users


@torch.no_grad()
def collect(
    people: np.ndarray,
    opponent: Player,
    games: int,
    ticks: int,
    table: Table,
    variant: str,
    mentors: Mentors,
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
    for name, value in (("games", games), ("ticks", ticks)):
        if value < 1:
            raise ValueError(f"{name} = {value} must be at least 1")
    users = len(people)
    n = users * games

    def game_streams(purpose: int) -> np.ndarray:
        return np.stack([streams(seed, range(users), game, purpose) for game in range(games)], axis=1).ravel()

    tables = Tables(n, table)
    tables.rng[:] = game_streams(3)
    tables.new_rounds()
    players = Users(np.repeat(people, games), game_streams(2), table, variant, mentors)
    observation, action = np.empty((ticks, n, 12), dtype=np.float32), np.empty((ticks, n, 2), dtype=np.float32)
    seen, actions, no_force = np.empty((n, 12)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    seen_by_opponent = np.empty((n, 12), dtype=np.float32)
    for tick in range(ticks):
        observation[tick] = tables.observe(LEFT, seen)
        action[tick] = actions[:, LEFT] = players.step(seen, no_force)
        actions[:, RIGHT] = opponent(torch.from_numpy(tables.observe(RIGHT, seen_by_opponent))).numpy()
        tables.step(actions)
        scored = tables.goals != 0
        if scored.any():
            tables.new_rounds(scored)
            players.new_round(scored)
        if tick % 100 == 99:
            progress((tick + 1) / ticks)

    def by_user(trail: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(trail).transpose(0, 1).unflatten(0, (users, games)).contiguous()

    return Demonstrations(by_user(observation), by_user(action))
