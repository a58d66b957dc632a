"""Advisors: generations of a league whose actions raise the utility of the intentions that agree with them."""

from math import erf, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numba import njit

from airhockey_marl.league.league import League
from airhockey_marl.players.inference import mlp_forward_blas


class Advisors(NamedTuple):
    """The networks of k generations, from the weakest to the strongest, for compiled code.

    Attributes:
        sizes: (layers + 1,) int64 widths, from the 12 numbers of a state to mean and STD of the action.
        weights: (k, weights of a network) float64: of each layer the matrix, row by row, then the biases.
    """

    sizes: np.ndarray
    weights: np.ndarray


NO_ADVISORS = Advisors(np.zeros(0, dtype=np.int64), np.zeros((0, 0)))


@torch.no_grad()
def stack_advisors(league: League) -> Advisors:
    """All generations of a league as advisors; the scaling of observations is folded into the first layer."""
    inputs = league.policy.inputs(torch.eye(12)).T.double()
    layers = [f"layers.{2 * index}" for index in range(len(league.policy.hidden))] + ["head"]
    rows = []
    for snapshot in league.snapshots:
        tensors = {name: tensor.double() for name, tensor in snapshot.flatten_keys(".").items()}
        tensors["layers.0.weight"] = tensors["layers.0.weight"] @ inputs
        parts = [tensors[f"{layer}.{part}"].flatten() for layer in layers for part in ("weight", "bias")]
        rows.append(torch.cat(parts))
    return Advisors(np.array([12, *league.policy.hidden, 4]), torch.stack(rows).numpy())


def load_advisors(path: Path | str | None) -> Advisors:
    """The advisors in a league's file; `NO_ADVISORS` for None."""
    return NO_ADVISORS if path is None else stack_advisors(League.load(path))


@njit(cache=True)
def advised_action(advisors, skill, observation):
    """The mean action (x, y) of the generation that advises this skill, at an observation (12,).

    The generation is chosen by the share of people who are less skilled: the middle one for the median person.
    """
    share = 0.5 * (1.0 + erf(skill / sqrt(2.0)))
    model = advisors.weights[int(share * (len(advisors.weights) - 1) + 0.5)]
    mean = mlp_forward_blas(observation, advisors.sizes, model)
    return min(max(mean[0], -1.0), 1.0), min(max(mean[1], -1.0), 1.0)
