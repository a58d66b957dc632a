"""Whether a policy's STD is meaningful: its STD by situation and by the place of the puck; smoothness of its play.

The paper takes a low STD for a confident action (section 3.2.2). If that holds, the STD should be lower right before a
save or a strike than while the puck is far away. These situations were defined before any result was known:

before a save     an untouched puck would enter the own goal within `SAVE_SECONDS`, on a straight path that the side
                  walls reflect, without drag
before a strike   the own paddle touches the puck within `STRIKE_SECONDS`, and it is not before a save
puck far away     in the opponent's half and not approaching, or more than `FAR` from the own paddle, and neither of
                  the above
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

from airhockey_marl.envs.hand_arm import HandArm
from airhockey_marl.envs.physics import LEFT, TOUCHED_BY, TableSpec
from airhockey_marl.envs.puck_path import seconds_to_goal
from airhockey_marl.envs.world import OBSERVATION_SIZE, World, round_steps
from airhockey_marl.evaluation.matches import FRAME_SKIP
from airhockey_marl.players.players import Player, rollout

SAVE_SECONDS, STRIKE_SECONDS, FAR = 0.4, 0.2, 0.8  # s, s, m
SITUATIONS = ("before a save", "before a strike", "puck far away", "otherwise")
SAVE, STRIKE, AWAY, OTHER = range(4)  # indices of SITUATIONS
BOOTSTRAP_RESAMPLES = 2000  # the ends of a 95 % interval then rest on 50 resamples each
TOP_SPEED = 0.95  # of the speed limit: from here on a paddle counts as being at its limit


@dataclass(frozen=True)
class Trajectories:
    """T decisions of the left player at n tables, round after round.

    Attributes:
        observation: (T, n, 12) before each decision.
        mean, std, action: (T, n, 2) of the policy, and the sampled action.
        touched: (T, n) bool, whether the own paddle touched the puck while the action was held.
        ended: (T, n) bool, whether the rally ended then: by a goal, by time, or by another serve.
        decision_seconds: for which an action is held.
        table: the table's geometry and physics.
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
def record_trajectories(
    policy: Callable[[Tensor], tuple[Tensor, Tensor]],
    opponent: Player,
    tables: int,
    seconds: float,
    seed: int,
    round_seconds: float = 30.0,
    frame_skip: int = FRAME_SKIP,
    arm: HandArm | None = None,
) -> Trajectories:
    """Record a policy, on the left and sampling as in training, for `seconds` at each table."""
    world, generator = World(tables, seed=seed, arm=arm), torch.Generator().manual_seed(seed)
    world.new_rounds()
    decisions, max_steps = (round_steps(duration, world.table, frame_skip) for duration in (seconds, round_seconds))
    observation = np.empty((decisions, tables, OBSERVATION_SIZE), dtype=np.float32)
    mean, std, action = np.empty((3, decisions, tables, 2), dtype=np.float32)
    touched, ended = np.empty((2, decisions, tables), dtype=bool)
    outputs: tuple[Tensor, Tensor]

    def sample(inputs: Tensor) -> Tensor:
        nonlocal outputs
        outputs = policy(inputs)
        return outputs[0] + outputs[1] * torch.randn(outputs[0].shape, generator=generator)

    steps = rollout(world, (sample, opponent), frame_skip, max_steps)
    for t, step in enumerate(islice(steps, decisions)):
        observation[t], action[t], (mean[t], std[t]) = step.observation[LEFT], step.action[:, LEFT], outputs
        touched[t], ended[t] = world.touched & TOUCHED_BY[LEFT] != 0, step.done | world.served
    return Trajectories(observation, mean, std, action, touched, ended, frame_skip * world.table.tick, world.table)


def situations(trajectories: Trajectories) -> np.ndarray:
    """(T, n) int: the index in `SITUATIONS` of every decision; see the module's docstring."""
    observation = trajectories.observation
    save = seconds_to_goal(observation, trajectories.table) < SAVE_SECONDS
    strike, same_rally = np.zeros_like(trajectories.touched), np.ones_like(trajectories.touched)
    for offset in range(min(round(STRIKE_SECONDS / trajectories.decision_seconds), len(observation))):
        end = len(observation) - offset
        strike[:end] |= same_rally[:end] & trajectories.touched[offset:]
        same_rally[:end] &= ~trajectories.ended[offset:]
    away = (observation[..., 8] > 0) & (observation[..., 10] >= 0)
    away |= np.hypot(observation[..., 8] - observation[..., 0], observation[..., 9] - observation[..., 1]) > FAR
    return np.select([save, strike, away], [SAVE, STRIKE, AWAY], OTHER)


def std_by_situation(trajectories: Trajectories, seed: int = 0) -> pd.DataFrame:
    """The mean STD in each situation, with 95 % intervals from a bootstrap over the tables.

    Returns:
        A row per situation and one for all of them; columns situation, decisions, share (of all decisions), std, low,
        high, along and across (the mean STD of either axis), and difference, difference_low, difference_high: std minus
        that of "puck far away". NaN where a situation did not occur, or not in every resample.
    """
    tables = trajectories.std.shape[1]
    in_situation = situations(trajectories)[..., None] == np.arange(len(SITUATIONS))  # (T, n, situations)
    in_situation = np.concatenate([in_situation, np.ones_like(in_situation[..., :1])], axis=-1)
    count = in_situation.sum(axis=0).astype(np.float64)  # (n, situations + 1)
    total = np.einsum("tns,tna->nsa", in_situation, trajectories.std, dtype=np.float64)  # (n, situations + 1, axes)
    weights = np.random.default_rng(seed).multinomial(tables, np.full(tables, 1 / tables), size=BOOTSTRAP_RESAMPLES)
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = total.sum(axis=0) / count.sum(axis=0)[:, None]
        resampled = (weights @ total.mean(axis=-1)) / (weights @ count)  # (resamples, situations + 1)
        std = axes.mean(axis=-1)
    low, high = np.quantile(resampled, [0.025, 0.975], axis=0)
    difference_low, difference_high = np.quantile(resampled - resampled[:, [AWAY]], [0.025, 0.975], axis=0)
    return pd.DataFrame(
        {
            "situation": [*SITUATIONS, "all"],
            "decisions": count.sum(axis=0).astype(np.int64),
            "share": count.sum(axis=0) / in_situation[..., 0].size,
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


def std_map(
    trajectories: Trajectories, approaching: bool, cells: tuple[int, int] = (30, 16), min_decisions: int = 30
) -> np.ndarray:
    """The mean STD by the place of the puck, while it approaches the own goal or while it does not.

    Returns:
        (across, along), as many as `cells`, over the whole table, own end first, right-hand side first; NaN in cells
        with fewer than `min_decisions` decisions.
    """
    along, across = cells
    observation, table = trajectories.observation.reshape(-1, OBSERVATION_SIZE), trajectories.table
    mask = (observation[:, 10] < 0) == approaching
    bounds = [[-table.width / 2, table.width / 2], [-table.length / 2, table.length / 2]]
    puck = observation[mask, 9], observation[mask, 8]
    count, *_ = np.histogram2d(*puck, bins=(across, along), range=bounds)
    std = trajectories.std.reshape(-1, 2).mean(axis=-1)[mask]
    total, *_ = np.histogram2d(*puck, bins=(across, along), range=bounds, weights=std)
    return np.where(count >= max(min_decisions, 1), total / np.maximum(count, 1), np.nan)


def smoothness(trajectories: Trajectories) -> dict[str, float]:
    """How much successive decisions differ, and how fast the paddle moves.

    Returns:
        mean_change, action_change: mean absolute change per axis, in action units, of the mean action and of the
        sampled one between successive decisions of a rally, both clipped as the table does; at_top_speed: share of the
        decisions with the paddle at `TOP_SPEED` of its limit or above; paddle_speed: its mean, in m/s.
    """
    same_rally = ~trajectories.ended[:-1]
    speed = np.hypot(trajectories.observation[..., 2], trajectories.observation[..., 3])
    changes = {
        f"{name}_change": float(np.abs(np.diff(values.clip(-1, 1), axis=0))[same_rally].mean())
        if same_rally.any()
        else float("nan")
        for name, values in (("mean", trajectories.mean), ("action", trajectories.action))
    }
    return {
        **changes,
        "at_top_speed": float((speed >= TOP_SPEED * trajectories.table.paddle_speed).mean()),
        "paddle_speed": float(speed.mean()),
    }
