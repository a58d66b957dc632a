"""Is a policy's STD meaningful? How sure it is in which situation, and where on the table; how smooth its play is.

The paper takes a low STD for a confident action (section 3.2.2). If that holds, a policy should be surer right before
it has to save or strike than while the puck is far away. What that means was fixed before any result was seen:

before a save     left alone, the puck enters the own goal within `SAVE_SECONDS`: along a straight path that the side
                  walls turn back, without drag
before a strike   the own paddle touches the puck within `STRIKE_SECONDS`, and it is not before a save
puck far away     in the opponent's half and not approaching, or more than `FAR` from the own paddle, and none of those
otherwise         all other decisions

A decision's STD is the mean over its two axes, in action units; a situation's is the mean over its decisions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from airhockey_marl.envs.physics import LEFT, TOUCHED_BY, TableSpec
from airhockey_marl.envs.puck_path import seconds_to_goal
from airhockey_marl.envs.world import OBSERVATION_SIZE, World, round_steps
from airhockey_marl.evaluation.matches import FRAME_SKIP
from airhockey_marl.experiment.validation import check_counts, check_numbers
from airhockey_marl.players.players import Player
from airhockey_marl.players.rollout import rollout

SAVE_SECONDS, STRIKE_SECONDS, FAR = 0.4, 0.2, 0.8  # s, s, m
SITUATIONS = ("before a save", "before a strike", "puck far away", "otherwise")
SAVE, STRIKE, AWAY, OTHER = range(4)
BOOTSTRAPS = 2000
AT_TOP_SPEED = 0.95  # of the speed limit and above


@dataclass(frozen=True)
class Trajectories:
    """What the left seat of n tables lived through in T decisions, round after round.

    Attributes:
        observation: (T, n, 12) before each decision.
        mean, std, action: (T, n, 2) of the policy, and what was sampled from them.
        touched: (T, n) bool, whether the own paddle touched the puck while the action was held.
        ended: (T, n) bool, whether the rally ended then: by a goal, by time, or by another serve.
        decision_seconds: how long an action is held.
        table: what it was played on.
    """

    observation: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    action: np.ndarray
    touched: np.ndarray
    ended: np.ndarray
    decision_seconds: float
    table: TableSpec


@torch.no_grad()
def record(
    policy: Callable[[Tensor], tuple[Tensor, Tensor]],
    opponent: Player,
    tables: int,
    seconds: float,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    table: TableSpec | None = None,
) -> Trajectories:
    """Let a policy play, sampled as in training, and write down what it saw, meant and did for `seconds` per table."""
    check_counts(0, seed=seed)
    check_numbers(above=0.0, seconds=seconds)
    world, generator = World(tables, table), torch.Generator().manual_seed(seed)
    world.seed(seed)
    world.new_rounds()
    decisions, max_steps = (round_steps(time, world.table, frame_skip) for time in (seconds, round_seconds))
    observation = np.empty((decisions, tables, OBSERVATION_SIZE), dtype=np.float32)
    mean, std, action = np.empty((3, decisions, tables, 2), dtype=np.float32)
    touched, ended = np.empty((2, decisions, tables), dtype=bool)
    outputs: tuple[Tensor, Tensor]

    def sample(inputs: Tensor) -> Tensor:
        nonlocal outputs
        outputs = policy(inputs)
        return outputs[0] + outputs[1] * torch.randn(outputs[0].shape, generator=generator)

    steps = rollout(world, (sample, opponent), frame_skip, max_steps)
    for now, step in enumerate(islice(steps, decisions)):
        observation[now], action[now], (mean[now], std[now]) = step.observation[LEFT], step.action[:, LEFT], outputs
        touched[now], ended[now] = world.touched & TOUCHED_BY[LEFT] != 0, step.done | world.served
    return Trajectories(observation, mean, std, action, touched, ended, frame_skip * world.table.tick, world.table)


def situations(play: Trajectories) -> np.ndarray:
    """(T, n) int: the place in `SITUATIONS` of every decision; see the module's docstring."""
    seen = play.observation
    save = seconds_to_goal(seen, play.table) < SAVE_SECONDS
    strike, goes_on = np.zeros_like(play.touched), np.ones_like(play.touched)
    for ahead in range(min(round(STRIKE_SECONDS / play.decision_seconds), len(seen))):
        until = len(seen) - ahead
        strike[:until] |= goes_on[:until] & play.touched[ahead:]
        goes_on[:until] &= ~play.ended[ahead:]
    away = (seen[..., 8] > 0) & (seen[..., 10] >= 0)
    away |= np.hypot(seen[..., 8] - seen[..., 0], seen[..., 9] - seen[..., 1]) > FAR
    return np.select([save, strike, away], [SAVE, STRIKE, AWAY], OTHER)


def std_by_situation(play: Trajectories, seed: int = 0) -> pd.DataFrame:
    """The mean STD in each situation, with 95 % intervals from a bootstrap over the tables.

    Returns:
        A row per situation and one for all of them; columns situation, decisions, share (of all decisions), std, low,
        high, along and across (the mean STD of either axis), and difference, difference_low, difference_high: std less
        that of "puck far away". Not a number where a situation did not occur, or not in every resample.
    """
    check_counts(0, seed=seed)
    tables = play.std.shape[1]
    here = situations(play)[..., None] == np.arange(len(SITUATIONS))  # (T, n, situations)
    here = np.concatenate([here, np.ones_like(here[..., :1])], axis=-1)
    count = here.sum(axis=0).astype(np.float64)  # (n, situations + 1)
    total = np.einsum("tns,tna->nsa", here, play.std, dtype=np.float64)  # (n, situations + 1, axes)
    resamples = np.random.default_rng(seed).multinomial(tables, np.full(tables, 1 / tables), size=BOOTSTRAPS)
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = total.sum(axis=0) / count.sum(axis=0)[:, None]
        again = (resamples @ total.mean(axis=-1)) / (resamples @ count)  # (resamples, situations + 1)
        std = axes.mean(axis=-1)
    low, high = np.quantile(again, [0.025, 0.975], axis=0)
    difference_low, difference_high = np.quantile(again - again[:, [AWAY]], [0.025, 0.975], axis=0)
    return pd.DataFrame(
        {
            "situation": [*SITUATIONS, "all"],
            "decisions": count.sum(axis=0).astype(np.int64),
            "share": count.sum(axis=0) / here[..., 0].size,
            "std": std,
            "low": low,
            "high": high,
            "along": axes[:, 0],
            "across": axes[:, 1],
            "difference": std - std[AWAY],
            "difference_low": difference_low,
            "difference_high": difference_high,
        }
    )


def std_map(play: Trajectories, toward: bool, cells: tuple[int, int] = (30, 16), least: int = 30) -> np.ndarray:
    """The mean STD by where the puck is, while it comes toward the own goal or goes away from it (or rests).

    Returns:
        (across, along) over the whole table, own end first, the right hand first; not a number in cells that saw fewer
        than `least` decisions.
    """
    along, across = cells
    check_counts(**{"cells[0]": along, "cells[1]": across})
    check_counts(0, least=least)
    seen = play.observation.reshape(-1, OBSERVATION_SIZE)
    chosen = (seen[:, 10] < 0) == toward
    bounds = [[-play.table.width / 2, play.table.width / 2], [-play.table.length / 2, play.table.length / 2]]
    places = seen[chosen, 9], seen[chosen, 8]
    count, *_ = np.histogram2d(*places, bins=(across, along), range=bounds)
    std = play.std.reshape(-1, 2).mean(axis=-1)[chosen]
    total, *_ = np.histogram2d(*places, bins=(across, along), range=bounds, weights=std)
    return np.where(count >= max(least, 1), total / np.maximum(count, 1), np.nan)


def smoothness(play: Trajectories) -> dict[str, float]:
    """How much successive decisions differ, and how hard the paddle is driven.

    Returns:
        mean_change, action_change: mean absolute change per axis, in action units, of the mean action and of the
        sampled one from a decision to the next of the same rally, both as the table clips them; at_top_speed: share of
        the time that the paddle moves at `AT_TOP_SPEED` of its limit or above; paddle_speed: its mean, in m/s.
    """
    same = ~play.ended[:-1]
    speed = np.hypot(play.observation[..., 2], play.observation[..., 3])
    changes = {
        f"{name}_change": float(np.abs(np.diff(values.clip(-1, 1), axis=0))[same].mean())
        if same.any()
        else float("nan")
        for name, values in (("mean", play.mean), ("action", play.action))
    }
    return {
        **changes,
        "at_top_speed": float((speed >= AT_TOP_SPEED * play.table.paddle_speed).mean()),
        "paddle_speed": float(speed.mean()),
    }
