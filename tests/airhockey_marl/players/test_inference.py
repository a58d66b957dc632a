"""Row-wise inference: equal to the modules, and bit-identical in any batch."""

import numpy as np
import pytest
import torch
from torch.func import stack_module_state

from airhockey_marl.players.inference import BatchedInference, PerRowInference, greedy_player, make_inference
from airhockey_marl.players.networks import GaussianPolicy


def random_policy(hidden, inputs="table", seed=0):
    """A policy whose outputs depend on the state."""
    torch.manual_seed(seed)
    policy = GaussianPolicy(hidden, inputs).requires_grad_(False)
    for parameter in policy.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    return policy


@pytest.mark.parametrize("hidden", [[1], [5], [64, 64], [7, 130, 3], [80, 80, 80, 80]])
@pytest.mark.parametrize("inputs", ["table", "paddle"])
def test_row_wise_outputs_are_those_of_the_module(hidden, inputs):
    policy, observation = random_policy(hidden, inputs), np.random.default_rng(0).normal(size=(50, 12))
    for output, expected in zip(
        PerRowInference(policy)(observation), policy(torch.from_numpy(observation).float()), strict=True
    ):
        np.testing.assert_allclose(output, expected.numpy(), atol=2e-6)


def test_each_row_uses_its_own_model():
    models = [random_policy([9, 6], seed=seed) for seed in range(4)]
    weights, _ = stack_module_state(models)
    observation, model_index = (
        np.random.default_rng(0).normal(size=(30, 12)),
        np.random.default_rng(1).integers(0, 4, 30),
    )
    mean, std = PerRowInference(models[0], weights)(observation, model_index)
    for row, model in enumerate(model_index):
        expected = PerRowInference(models[model])(observation[row : row + 1])
        assert np.array_equal(mean[row], expected[0][0]) and np.array_equal(std[row], expected[1][0])


GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=GPU)])
def test_batched_outputs_are_equal_but_for_the_last_bits(device):
    models = [random_policy([80, 80, 80, 80], "paddle", seed=seed) for seed in range(4)]
    weights, _ = stack_module_state(models)
    observation, model_index = (
        np.random.default_rng(0).normal(size=(30, 12)),
        np.random.default_rng(1).integers(0, 4, 30),
    )
    for policy, weights_or_none, index in (
        (models[1], None, None),
        (models[0], weights, model_index),
        (models[0], weights, None),
    ):
        outputs = BatchedInference(policy, weights_or_none, device)(observation, index)
        for output, expected in zip(outputs, PerRowInference(policy, weights_or_none)(observation, index), strict=True):
            assert output.dtype == np.float32
            np.testing.assert_allclose(output, expected, atol=5e-6)


def test_a_cpu_is_asked_row_by_row():
    assert isinstance(make_inference(random_policy([8])), PerRowInference)
    assert isinstance(make_inference(random_policy([8]), device="meta"), BatchedInference)


def test_no_bit_depends_on_the_company_or_on_the_number_of_threads():
    rows, observation = PerRowInference(random_policy([64, 64])), np.random.default_rng(0).normal(size=(2000, 12))
    everyone = rows(observation)
    for some in (slice(3, 4), slice(0, 77), slice(500, 1900)):
        for alone, together in zip(rows(observation[some]), everyone, strict=True):
            assert np.array_equal(alone, together[some])


def test_the_steady_player_plays_the_mean():
    policy, observation = random_policy([8]), torch.randn(5, 12)
    assert torch.allclose(greedy_player(policy)(observation), policy(observation)[0], atol=1e-6)


def test_what_is_not_a_number_stays_none():
    observation = np.zeros((2, 12))
    observation[0, 3] = np.nan
    mean, _ = PerRowInference(random_policy([8]))(observation)
    assert np.isnan(mean[0]).all() and np.isfinite(mean[1]).all()
