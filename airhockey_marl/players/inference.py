"""Fast inference of policies: compiled row by row on a CPU, batched on any other device.

A batched matrix product rounds differently with the size of its batch, and play amplifies a last bit into another
game. Row by row, an output is bit-identical in any batch: a game comes out the same alone, among nine conditions and
among a hundred studies. On a GPU the product is batched, equal but for the last bits.
"""

import copy
from collections.abc import Mapping
from math import exp

import numpy as np
import torch
from numba import float32, njit
from torch import Tensor

from airhockey_marl.envs.world import FLOATS
from airhockey_marl.experiment.parallel import parallel_for
from airhockey_marl.experiment.validation import check_rows, kind_of
from airhockey_marl.players.networks import PADDLE, GaussianPolicy
from airhockey_marl.players.players import Player


@njit(cache=True, nogil=True, fastmath={"contract"})
def _linear(inputs, weights, bias, outputs):
    """Write inputs (wide,) times weights (wide * high,) + bias (high,) to outputs (high,), skipping inputs of zero."""
    high = len(outputs)
    for j in range(high):
        outputs[j] = bias[j]
    nonzero = np.empty(len(inputs), np.int64)
    count = 0
    for i in range(len(inputs)):
        if inputs[i] != 0.0:  # a ReLU makes about half of them zero
            nonzero[count] = i
            count += 1
    unrolled = count - count % 4
    for k in range(0, unrolled, 4):  # four at a time: outputs are read and written a quarter as often
        a, b, c, d = nonzero[k], nonzero[k + 1], nonzero[k + 2], nonzero[k + 3]
        of_a, of_b = weights[a * high : (a + 1) * high], weights[b * high : (b + 1) * high]
        of_c, of_d = weights[c * high : (c + 1) * high], weights[d * high : (d + 1) * high]
        for j in range(high):
            outputs[j] += inputs[a] * of_a[j] + inputs[b] * of_b[j] + inputs[c] * of_c[j] + inputs[d] * of_d[j]
    for k in range(unrolled, count):
        a = nonzero[k]
        of_a = weights[a * high : (a + 1) * high]
        for j in range(high):
            outputs[j] += inputs[a] * of_a[j]


@njit(cache=True, nogil=True)
def mlp_forward(inputs: np.ndarray, sizes: tuple[int, ...], model: np.ndarray) -> np.ndarray:
    """Outputs (sizes[-1],) float32 of a ReLU network at inputs (sizes[0],) float32, without BLAS.

    `model` has, layer by layer, the transposed weights row by row and the biases.
    """
    hidden, start, last = inputs, 0, len(sizes) - 2
    for layer in range(last + 1):
        wide, high = sizes[layer], sizes[layer + 1]
        bias = start + wide * high
        outputs = np.empty(high, np.float32)
        _linear(hidden, model[start:bias], model[bias : bias + high], outputs)
        if layer < last:
            for j in range(high):
                outputs[j] = max(outputs[j], float32(0.0))
        hidden, start = outputs, bias + high
    return hidden


@njit(cache=True)
def mlp_forward_blas(inputs: np.ndarray, sizes: np.ndarray, model: np.ndarray) -> np.ndarray:
    """As `mlp_forward`, in float64 with BLAS, which rounds differently; `model` has the weights untransposed."""
    hidden, start = inputs, 0
    for layer in range(len(sizes) - 1):
        wide, high = sizes[layer], sizes[layer + 1]
        weights = model[start : start + wide * high].reshape(high, wide)
        start += wide * high
        hidden = np.dot(weights, hidden) + model[start : start + high]
        start += high
        if layer < len(sizes) - 2:
            hidden = np.maximum(hidden, 0.0)
    return hidden


@njit(cache=True, nogil=True)
def _infer_rows(rows, weights, sizes, from_paddle, scale, observation, model_index, mean, std):
    for row in rows:
        inputs = np.empty(12, np.float32)
        for i in range(12):
            number = float32(observation[row, i])
            if from_paddle and (i == 8 or i == 9):
                number -= float32(observation[row, i - 8])
            inputs[i] = number / scale[i]
        outputs = mlp_forward(inputs, sizes, weights[model_index[row]])
        mean[row, 0], mean[row, 1] = outputs[0], outputs[1]
        std[row, 0], std[row, 1] = 1.0 / (1.0 + exp(-outputs[2])), 1.0 / (1.0 + exp(-outputs[3]))


def _stack_weights(policy: GaussianPolicy, weights: Mapping[str, Tensor] | None) -> dict[str, Tensor]:
    """Weights (k, ...) of k models, layer by layer; for None those of the policy, as one model."""
    if weights is None:
        weights = {name: tensor.unsqueeze(0) for name, tensor in policy.named_parameters()}
    return {name: weights[name].detach() for name, _ in policy.named_parameters()}


def _check_batch(observation: np.ndarray, model_index: np.ndarray | None, models: int) -> None:
    """Guard the compiled code, which would access foreign memory; cheap, as it runs in every tick."""
    floats = isinstance(observation, np.ndarray) and observation.dtype in FLOATS
    if not floats or observation.ndim != 2 or observation.shape[1] != 12:
        raise ValueError(f"observation: {kind_of(observation)}, must be numpy float32 or float64 of shape (n, 12)")
    if model_index is not None:
        check_rows("model_index", model_index, models)
        if len(model_index) != len(observation):
            raise ValueError(f"model_index: {len(model_index)} rows, must be {len(observation)} as in observation")


class PerRowInference:
    """Row-wise inference of one or several models of an architecture: outputs are bit-identical in any batch.

    Args:
        policy: the architecture, and the model unless `weights` are given.
        weights: of k models, by the names of the parameters, (k, ...) each. Copied.
    """

    def __init__(self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None) -> None:
        weights = _stack_weights(policy, weights)
        parts = [part.transpose(1, 2).flatten(1) if part.ndim == 3 else part for part in weights.values()]
        self._weights = torch.cat(parts, dim=1).float().contiguous().numpy()
        self._sizes = (12, *policy.hidden, 4)
        self._from_paddle, self._scale = policy.inputs.origin == PADDLE, policy.inputs.scale.numpy().copy()

    def __call__(self, observation: np.ndarray, model_index: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean and STD (n, 2) float32 at observations (n, 12).

        Args:
            model_index: (n,) int64, the model of each row; the first model for all rows if None.
        """
        _check_batch(observation, model_index, len(self._weights))
        n = len(observation)
        # Model by model: the models of many users do not fit into a cache, and each is loaded once.
        rows = np.arange(n) if model_index is None else np.argsort(model_index, kind="stable")
        model_index = np.zeros(n, dtype=np.int64) if model_index is None else model_index
        mean, std = np.empty((n, 2), dtype=np.float32), np.empty((n, 2), dtype=np.float32)
        models = self._weights, self._sizes, self._from_paddle, self._scale
        parallel_for(_infer_rows, rows, *models, observation, model_index, mean, std, least=256)
        return mean, std


class BatchedInference:
    """As `PerRowInference`, but in one batched product per layer, on any device."""

    def __init__(
        self, policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None, device: str = "cpu"
    ) -> None:
        self._policy, self._device = copy.deepcopy(policy).to(device), device
        self._weights = {name: tensor.float().to(device) for name, tensor in _stack_weights(policy, weights).items()}

    @torch.no_grad()
    def __call__(self, observation: np.ndarray, model_index: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean and STD (n, 2) float32 at observations (n, 12), see `PerRowInference`."""
        _check_batch(observation, model_index, len(self._weights["head.bias"]))
        inputs = torch.from_numpy(observation).float().to(self._device)
        if model_index is None:
            models, inputs = slice(1), inputs[None]
        else:
            models, inputs = torch.from_numpy(model_index).to(self._device), inputs[:, None]
        weights = {name: tensor[models] for name, tensor in self._weights.items()}
        mean, std = (part.flatten(0, 1).cpu() for part in self._policy.forward_stacked(weights, inputs))
        return mean.numpy(), std.numpy()


def make_inference(
    policy: GaussianPolicy, weights: Mapping[str, Tensor] | None = None, device: str = "cpu"
) -> PerRowInference | BatchedInference:
    """Inference of one or several models, see `PerRowInference`: row-wise on a CPU, batched on any other device."""
    return PerRowInference(policy, weights) if device == "cpu" else BatchedInference(policy, weights, device)


def greedy_player(policy: GaussianPolicy, device: str = "cpu") -> Player:
    """As `players.greedy`: the player that takes a policy's mean action, computed by `make_inference`."""
    infer = make_inference(policy, device=device)
    return lambda observation: torch.from_numpy(infer(observation.numpy())[0])
