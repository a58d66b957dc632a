"""Policies asked row by row, compiled: no bit of what a row is told depends on which others are asked with it.

A batched matrix product rounds differently with the size of its batch, and play amplifies a last bit into another game.
Asked like this, a game comes out the same alone, among nine conditions and among a hundred studies. On a GPU, which
is for many rows, they are asked all at once after all: the same but for the last bits.
"""

import copy
from collections.abc import Mapping
from itertools import pairwise
from math import exp

import numpy as np
import torch
from numba import float32, njit
from torch import Tensor, nn

from airhockey_marl.experiment.parallel import parallel_for
from airhockey_marl.experiment.validation import CPU, check_rows, check_tensors, kind_of
from airhockey_marl.players.networks import PADDLE, GaussianPolicy
from airhockey_marl.players.players import Player


@njit(cache=True, nogil=True, fastmath={"contract"})
def _layer(inputs, weights, bias, outputs):
    """outputs (high,) = inputs (wide,) times weights (wide * high,) + bias (high,)."""
    high = len(outputs)
    for j in range(high):
        outputs[j] = bias[j]
    alive = np.empty(len(inputs), np.int64)
    count = 0
    for i in range(len(inputs)):
        if inputs[i] != 0.0:  # about half of what a ReLU lets through is nothing
            alive[count] = i
            count += 1
    whole = count - count % 4
    for k in range(0, whole, 4):  # four at a time: outputs are read and written a quarter as often
        a, b, c, d = alive[k], alive[k + 1], alive[k + 2], alive[k + 3]
        of_a, of_b = weights[a * high : (a + 1) * high], weights[b * high : (b + 1) * high]
        of_c, of_d = weights[c * high : (c + 1) * high], weights[d * high : (d + 1) * high]
        for j in range(high):
            outputs[j] += inputs[a] * of_a[j] + inputs[b] * of_b[j] + inputs[c] * of_c[j] + inputs[d] * of_d[j]
    for k in range(whole, count):
        a = alive[k]
        of_a = weights[a * high : (a + 1) * high]
        for j in range(high):
            outputs[j] += inputs[a] * of_a[j]


@njit(cache=True, nogil=True)
def _answer(row, weights, sizes, from_paddle, scale, observation, which, mean, std):
    model, last = weights[which[row]], len(sizes) - 2
    now = np.empty(12, np.float32)
    for i in range(12):
        number = float32(observation[row, i])
        if from_paddle and (i == 8 or i == 9):
            number -= float32(observation[row, i - 8])
        now[i] = number / scale[i]
    at = 0
    for layer in range(last + 1):
        wide, high = sizes[layer], sizes[layer + 1]
        bias = at + wide * high
        after = np.empty(high, np.float32)
        _layer(now, model[at:bias], model[bias : bias + high], after)
        if layer < last:
            for j in range(high):
                after[j] = max(after[j], float32(0.0))
        now, at = after, bias + high
    mean[row, 0], mean[row, 1] = now[0], now[1]
    std[row, 0], std[row, 1] = 1.0 / (1.0 + exp(-now[2])), 1.0 / (1.0 + exp(-now[3]))


@njit(cache=True, nogil=True)
def _answers(rows, weights, sizes, from_paddle, scale, observation, which, mean, std):
    for row in rows:
        _answer(row, weights, sizes, from_paddle, scale, observation, which, mean, std)


def _stacked(policy: GaussianPolicy, weights: Mapping[str, Tensor] | None) -> dict[str, Tensor]:
    """The weights (k, ...) of the models to ask, layer by layer; those of the policy, as one model, for None."""
    if weights is None:
        weights = {name: tensor.unsqueeze(0) for name, tensor in policy.named_parameters()}
    names = [f"layers.{i}" for i, layer in enumerate(policy.layers) if isinstance(layer, nn.Linear)] + ["head"]
    shapes = {}
    for name, (wide, high) in zip(names, pairwise((12, *policy.hidden, 4)), strict=True):
        shapes |= {f"{name}.weight": f"k {high} {wide}", f"{name}.bias": f"k {high}"}
    check_tensors(CPU, **{f"weights.{name}": (weights.get(name), shape) for name, shape in shapes.items()})
    return {name: weights[name].detach() for name in shapes}


def _check_asked(observation: np.ndarray, which: np.ndarray | None, models: int) -> None:
    """By hand, as it is asked in every tick."""
    floats = isinstance(observation, np.ndarray) and observation.dtype.kind == "f"
    if not floats or observation.ndim != 2 or observation.shape[1] != 12:
        raise ValueError(f"observation: {kind_of(observation)}, must be an array of floats of shape (n, 12)")
    if which is not None:
        check_rows("which", which, models)
        if len(which) != len(observation):
            raise ValueError(f"which: of {len(which)} rows, must be of {len(observation)} as observation")


class PerRowInference:
    """One or several models of an architecture, for rows that each ask one of them.

    Args:
        policy: the architecture, and the model if `weights` are not given.
        weights: by the names of the parameters, (k, ...) each: k models. Copied.
    """

    def __init__(self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None) -> None:
        weights = _stacked(policy, weights)
        parts = [part.transpose(1, 2).flatten(1) if part.ndim == 3 else part for part in weights.values()]
        self._weights = torch.cat(parts, dim=1).float().contiguous().numpy()
        self._sizes = (12, *policy.hidden, 4)
        self._from_paddle, self._scale = policy.inputs.origin == PADDLE, policy.inputs.scale.numpy().copy()

    def __call__(self, observation: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean and STD (n, 2), float32, at observations (n, 12), of models `which` (n,) int64, of the first if None."""
        _check_asked(observation, which, len(self._weights))
        n = len(observation)
        # Model by model: the models of many users do not fit into a cache, and each is fetched once.
        rows = np.arange(n) if which is None else np.argsort(which, kind="stable")
        which = np.zeros(n, dtype=np.int64) if which is None else which
        mean, std = np.empty((n, 2), dtype=np.float32), np.empty((n, 2), dtype=np.float32)
        parallel_for(
            _answers,
            rows,
            self._weights,
            self._sizes,
            self._from_paddle,
            self._scale,
            observation,
            which,
            mean,
            std,
            least=256,
        )
        return mean, std


class BatchedInference:
    """As `PerRowInference`, but in one batched product per layer, on any device."""

    def __init__(
        self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None, device: str = "cpu"
    ) -> None:
        self._policy, self._device = copy.deepcopy(policy).to(device), device
        self._weights = {name: tensor.float().to(device) for name, tensor in _stacked(policy, weights).items()}

    @torch.no_grad()
    def __call__(self, observation: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean and STD (n, 2), float32, at observations (n, 12), of models `which` (n,) int64, of the first if None."""
        _check_asked(observation, which, len(self._weights["head.bias"]))
        asked = torch.from_numpy(observation).float().to(self._device)
        if which is None:
            models, asked = slice(1), asked[None]
        else:
            models, asked = torch.from_numpy(which).to(self._device), asked[:, None]
        weights = {name: tensor[models] for name, tensor in self._weights.items()}
        mean, std = (part.flatten(0, 1).cpu() for part in self._policy.forward_stacked(weights, asked))
        return mean.numpy(), std.numpy()


def make_inference(
    policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None, device: str = "cpu"
) -> PerRowInference | BatchedInference:
    """The models to ask, see `PerRowInference`: row by row on a CPU, all at once on any other device."""
    return PerRowInference(policy, weights) if device == "cpu" else BatchedInference(policy, weights, device)


def greedy_player(policy: GaussianPolicy, device: str = "cpu") -> Player:
    """The player that always takes a policy's mean action, as `match.confident`, but asked by `make_inference`."""
    rows = make_inference(policy, device=device)
    return lambda observation: torch.from_numpy(rows(observation.numpy())[0])
