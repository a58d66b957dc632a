"""Rollouts are the same in one process, in several, and in the actors of a Ray cluster."""

import numpy as np
import pytest
import torch

from airhockey_marl.league.league import League, TableSlice
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import MULTISYNC, RAY, SINGLE, CollectorConfig, RolloutWorkers
from airhockey_marl.self_play.two_player_policy import GaussianSampling
from tests.airhockey_marl.league.test_league import league_of

TABLES = {"backend": "batched", "tables": 30, "round_seconds": 0.4, "frame_skip": 2}
OPPONENTS = ["defender", 0, "striker", 1, 1]


@pytest.fixture(scope="module")
def policies() -> tuple[GaussianPolicy, League]:
    torch.manual_seed(0)
    return GaussianPolicy([8]), league_of(2)


def rollouts(config: CollectorConfig, policies: tuple[GaussianPolicy, League]) -> tuple[list, np.ndarray, torch.Tensor]:
    """Two generations of two rollouts, with other weights in the second; the random states of tables and torch."""
    torch.manual_seed(1)
    policy, league = policies
    workers, batches = RolloutWorkers(config, TABLES, 7, policy, 300), []
    for generation in range(2):
        weights = {name: tensor * (1 - 0.5 * generation) for name, tensor in policy.state_dict().items()}
        workers.start_rounds(league.opponent_batch(OPPONENTS))
        batches += [workers.rollout(weights).clone() for _ in range(2)]
        workers.save_rng_states()
    workers.close()
    return batches, workers.rng_states.copy(), torch.get_rng_state()


@pytest.fixture(scope="module")
def single(policies):
    return rollouts(CollectorConfig(), policies)


def assert_equal_rollouts(actual, expected) -> None:
    """Equal but for the rounding of matrix products with fewer rows, which so short a rollout does not amplify."""
    batches, rng_states, torch_rng_state = actual
    assert len(batches) == len(expected[0]) == 4
    for batch, other in zip(batches, expected[0], strict=True):
        assert batch.batch_size == other.batch_size == (30, 10)
        for key in ("observation", "action"):
            for seat in ("left", "right"):
                assert torch.allclose(batch[seat, key], other[seat, key], atol=1e-4), (seat, key)
        assert torch.equal(batch["next", "done"], other["next", "done"])
    assert np.array_equal(rng_states, expected[1]) and torch.equal(torch_rng_state, expected[2])


def test_multiprocessing_equals_single_process(policies, single):
    assert_equal_rollouts(rollouts(CollectorConfig(MULTISYNC, 2), policies), single)


def test_ray_equals_single_process(policies, single, monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    try:
        assert_equal_rollouts(rollouts(CollectorConfig(RAY, 2), policies), single)
        with pytest.raises(ValueError, match=r"collector\.workers = 3 must be at most 2, the cores of the Ray cluster"):
            RolloutWorkers(CollectorConfig(RAY, 3), TABLES, 0, policies[0], 300)
    finally:
        ray.shutdown()


def test_saved_random_states_continue_the_rollouts(policies, single):
    """Rollouts depend on weights, opponents, and the random states of torch and the tables only."""
    policy, league = policies
    torch.manual_seed(1)
    first = RolloutWorkers(CollectorConfig(), TABLES, 7, policy, 300)
    first.start_rounds(league.opponent_batch(OPPONENTS))
    for _ in range(2):
        first.rollout(policy.state_dict())
    first.save_rng_states()
    rng_states, torch_rng_state = first.rng_states.copy(), torch.get_rng_state()
    first.close()
    second = RolloutWorkers(CollectorConfig(), TABLES, 999, policy, 300)
    second.rng_states[:] = rng_states
    torch.set_rng_state(torch_rng_state)
    second.start_rounds(league.opponent_batch(OPPONENTS))
    weights = {name: tensor * 0.5 for name, tensor in policy.state_dict().items()}
    continued = [second.rollout(weights).clone() for _ in range(2)]
    second.save_rng_states()
    second.close()
    for batch, other in zip(continued, single[0][2:], strict=True):
        assert torch.equal(batch["left", "observation"], other["left", "observation"])
        assert torch.equal(batch["right", "action"], other["right", "action"])
    assert np.array_equal(second.rng_states, single[1])


@pytest.mark.parametrize("workers", [1, 2, 3, 4, 6, 12])
def test_slices_of_opponents_equal_the_batch(workers):
    """60 tables of five players, 12 each: for 2, 3 and 4 workers, slices divide the tables of a player."""
    opponents = league_of(3).opponent_batch([2, "striker", 0, "defender", 0])
    observation = torch.randn(60, 1, 12)
    mean, std = opponents(observation)
    size = 60 // workers
    for worker in range(workers):
        first, last = worker * size, (worker + 1) * size
        slice_mean, slice_std = opponents.slice(TableSlice(first, last, 60))(observation[first:last])
        assert torch.allclose(slice_mean, mean[first:last], atol=1e-6)
        assert torch.allclose(slice_std, std[first:last], atol=1e-6)


def test_noise_does_not_depend_on_the_slice():
    policy, observation = GaussianPolicy([8]), torch.randn(10, 1, 12)
    torch.manual_seed(0)
    expected = GaussianSampling(policy, TableSlice(0, 10, 10))(observation)
    torch.manual_seed(0)
    actual = GaussianSampling(policy, TableSlice(4, 7, 10))(observation[4:7])
    assert torch.allclose(actual, expected[4:7], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "several"}, "collector.kind = 'several' must be one of single, multisync, ray"),
        ({"kind": MULTISYNC, "workers": 0}, "collector.workers = 0 must be a whole number of at least 1"),
        ({"kind": MULTISYNC, "workers": True}, "collector.workers = True must be a whole number"),
        ({"kind": SINGLE, "workers": 2}, "collector.workers = 2 must be 1 where collector.kind = single"),
        ({"kind": MULTISYNC, "address": ""}, "collector.address = '' must be local, auto or"),
    ],
)
def test_wrong_settings_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        CollectorConfig(**arguments)


def test_uneven_division_of_tables_is_named(policies):
    with pytest.raises(ValueError, match=r"env\.tables = 30 must be a multiple of collector\.workers = 4"):
        RolloutWorkers(CollectorConfig(MULTISYNC, 4), TABLES, 0, policies[0], 300)
