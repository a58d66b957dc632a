"""Policies asked row by row: the same answers as the modules, and the same bits in any company."""

import numpy as np
import pytest
import torch
from torch.func import stack_module_state

from airhockey_marl.players.inference import BatchedInference, PerRowInference, greedy_player, make_inference
from airhockey_marl.players.networks import GaussianPolicy


def restless(hidden, inputs="table", seed=0):
    """A policy whose answers depend on the state."""
    torch.manual_seed(seed)
    policy = GaussianPolicy(hidden, inputs).requires_grad_(False)
    for parameter in policy.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    return policy


@pytest.mark.parametrize("hidden", [[1], [5], [64, 64], [7, 130, 3], [80, 80, 80, 80]])
@pytest.mark.parametrize("inputs", ["table", "paddle"])
def test_rows_answer_as_the_module_does(hidden, inputs):
    policy, seen = restless(hidden, inputs), np.random.default_rng(0).normal(size=(50, 12))
    for said, expected in zip(PerRowInference(policy)(seen), policy(torch.from_numpy(seen).float()), strict=True):
        np.testing.assert_allclose(said, expected.numpy(), atol=2e-6)


def test_each_row_asks_its_own_model():
    models = [restless([9, 6], seed=seed) for seed in range(4)]
    weights, _ = stack_module_state(models)
    seen, which = np.random.default_rng(0).normal(size=(30, 12)), np.random.default_rng(1).integers(0, 4, 30)
    mean, std = PerRowInference(models[0], weights)(seen, which)
    for row, model in enumerate(which):
        expected = PerRowInference(models[model])(seen[row : row + 1])
        assert np.array_equal(mean[row], expected[0][0]) and np.array_equal(std[row], expected[1][0])


GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=GPU)])
def test_all_at_once_the_answers_are_the_same_but_for_the_last_bits(device):
    models = [restless([80, 80, 80, 80], "paddle", seed=seed) for seed in range(4)]
    weights, _ = stack_module_state(models)
    seen, which = np.random.default_rng(0).normal(size=(30, 12)), np.random.default_rng(1).integers(0, 4, 30)
    for policy, own, asked in ((models[1], None, None), (models[0], weights, which), (models[0], weights, None)):
        answers = BatchedInference(policy, own, device)(seen, asked)
        for said, expected in zip(answers, PerRowInference(policy, own)(seen, asked), strict=True):
            assert said.dtype == np.float32
            np.testing.assert_allclose(said, expected, atol=5e-6)


def test_a_cpu_is_asked_row_by_row():
    assert isinstance(make_inference(restless([8])), PerRowInference)
    assert isinstance(make_inference(restless([8]), device="meta"), BatchedInference)


def test_no_bit_depends_on_the_company_or_on_the_number_of_threads():
    rows, seen = PerRowInference(restless([64, 64])), np.random.default_rng(0).normal(size=(2000, 12))
    everyone = rows(seen)
    for some in (slice(3, 4), slice(0, 77), slice(500, 1900)):
        for alone, together in zip(rows(seen[some]), everyone, strict=True):
            assert np.array_equal(alone, together[some])


def test_the_steady_player_plays_the_mean():
    policy, seen = restless([8]), torch.randn(5, 12)
    assert torch.allclose(greedy_player(policy)(seen), policy(seen)[0], atol=1e-6)


def test_what_is_not_a_number_stays_none():
    seen = np.zeros((2, 12))
    seen[0, 3] = np.nan
    mean, _ = PerRowInference(restless([8]))(seen)
    assert np.isnan(mean[0]).all() and np.isfinite(mean[1]).all()
