"""What a record of play, observations (..., ticks, 12) and actions (..., ticks, 2), says by way of its rounds."""

import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import CPU, check_numbers, check_tensors
from guidance.simulated_users.arm import HAND_REACH


def round_begins(observation: torch.Tensor, table: TableSpec) -> torch.Tensor:
    """Whether a round begins with each tick (...) of observations (..., 12): everything is at rest in its place."""
    check_tensors(CPU, observation=(observation, "... 12"))
    rest = [-table.length / 4, 0.0, 0.0, 0.0, table.length / 4, 0.0, 0.0, 0.0, 0.0]  # both paddles, and the puck's x
    return (observation[..., :9] == torch.tensor(rest, dtype=observation.dtype)).all(dim=-1)


def hand_speed(observation: torch.Tensor, action: torch.Tensor, table: TableSpec) -> torch.Tensor:
    """(..., ticks) m/s, the hand's mean speed in each tick of play; a round begins with the hand at its center."""
    check_tensors(CPU, observation=(observation, "... ticks 12"), action=(action, "... ticks 2"))
    begins = round_begins(observation, table)
    before = action.roll(1, dims=-2).masked_fill(begins[..., None], 0.0)
    return (action - before).norm(dim=-1) * HAND_REACH / table.tick


def action_ahead(observation: torch.Tensor, action: torch.Tensor, seconds: float, table: TableSpec) -> torch.Tensor:
    """The action (..., ticks, 2) so many seconds after each tick, or the last of its round, if that is sooner.

    Args:
        observation: (..., ticks, 12), contiguous in time, which says where rounds begin.
        action: (..., ticks, 2).
    """
    check_tensors(CPU, observation=(observation, "... ticks 12"), action=(action, "... ticks 2"))
    check_numbers(0.0, seconds=seconds)
    ticks = observation.shape[-2]
    begins = round_begins(observation, table)
    tick = torch.arange(ticks)
    last = torch.where(begins, tick - 1, ticks - 1).roll(-1, dims=-1)  # of each round, where it ends
    last[..., -1] = ticks - 1
    last = last.flip(-1).cummin(-1).values.flip(-1)
    then = torch.minimum(tick + round(seconds / table.tick), last)
    return action.gather(-2, then.unsqueeze(-1).expand_as(action))
