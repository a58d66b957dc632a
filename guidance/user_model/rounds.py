"""Rounds in recorded play, that is in observations (..., ticks, 12) and actions (..., ticks, 2)."""

import torch

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users.arm import HAND_REACH


def round_starts(observation: torch.Tensor, table: TableSpec) -> torch.Tensor:
    """Boolean mask (...) of the observations (..., 12) that start a round: everything at rest at its start position."""
    rest = [-table.length / 4, 0.0, 0.0, 0.0, table.length / 4, 0.0, 0.0, 0.0, 0.0]  # both paddles, and the puck's x
    return (observation[..., :9] == torch.tensor(rest, dtype=observation.dtype)).all(dim=-1)


def hand_speed(observation: torch.Tensor, action: torch.Tensor, table: TableSpec) -> torch.Tensor:
    """(..., ticks) m/s, the hand's mean speed in each tick; a round starts with the hand at its center."""
    starts = round_starts(observation, table)
    before = action.roll(1, dims=-2).masked_fill(starts[..., None], 0.0)
    return (action - before).norm(dim=-1) * HAND_REACH / table.tick


def action_ahead(observation: torch.Tensor, action: torch.Tensor, seconds: float, table: TableSpec) -> torch.Tensor:
    """The action (..., ticks, 2) `seconds` after each tick, or the last of its round if that is sooner.

    Args:
        observation: (..., ticks, 12), contiguous in time; marks where rounds start.
        action: (..., ticks, 2).
    """
    ticks = observation.shape[-2]
    starts = round_starts(observation, table)
    tick = torch.arange(ticks)
    last = torch.where(starts, tick - 1, ticks - 1).roll(-1, dims=-1)  # the last tick of a round, where one ends
    last[..., -1] = ticks - 1
    last = last.flip(-1).cummin(-1).values.flip(-1)
    then = torch.minimum(tick + round(seconds / table.tick), last)
    return action.gather(-2, then.unsqueeze(-1).expand_as(action))
