"""The same play, whoever collects it: one process, several, or the actors of a Ray cluster."""

import numpy as np
import pytest
import torch

from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.self_play.collectors import (
    MULTISYNC,
    RAY,
    SINGLE,
    CollectorConfig,
    GaussianSampling,
    RolloutWorkers,
    TableSlice,
)
from tests.airhockey_marl.league.test_league import league_of

TABLES = {"backend": "batched", "tables": 30, "round_seconds": 0.4, "frame_skip": 2}
MEMBERS = ["defender", 0, "striker", 1, 1]


@pytest.fixture(scope="module")
def policies() -> tuple[GaussianPolicy, League]:
    torch.manual_seed(0)
    return GaussianPolicy([8]), league_of(2)


def played(how: CollectorConfig, policies: tuple[GaussianPolicy, League]) -> tuple[list, np.ndarray, torch.Tensor]:
    """Two generations of two batches, with other weights in the second; and the random numbers they leave behind."""
    torch.manual_seed(1)
    policy, league = policies
    crew, batches = RolloutWorkers(how, TABLES, 7, policy, 300), []
    for generation in range(2):
        weights = {name: tensor * (1 - 0.5 * generation) for name, tensor in policy.state_dict().items()}
        crew.begin(league.lineup(MEMBERS))
        batches += [crew.play(weights).clone() for _ in range(2)]
        crew.end()
    crew.close()
    return batches, crew.streams.copy(), torch.get_rng_state()


@pytest.fixture(scope="module")
def alone(policies):
    return played(CollectorConfig(), policies)


def assert_same_play(found, wanted) -> None:
    """To the last bit but for how a product of fewer rows is rounded, which this short a play does not amplify."""
    batches, streams, random_state = found
    assert len(batches) == len(wanted[0]) == 4
    for batch, other in zip(batches, wanted[0], strict=True):
        assert batch.batch_size == other.batch_size == (30, 10)
        for key in ("observation", "action"):
            for seat in ("left", "right"):
                assert torch.allclose(batch[seat, key], other[seat, key], atol=1e-4), (seat, key)
        assert torch.equal(batch["next", "done"], other["next", "done"])
    assert np.array_equal(streams, wanted[1]) and torch.equal(random_state, wanted[2])


def test_several_processes_collect_what_one_collects(policies, alone):
    assert_same_play(played(CollectorConfig(MULTISYNC, 2), policies), alone)


def test_a_ray_cluster_collects_what_one_process_collects(policies, alone, monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    try:
        assert_same_play(played(CollectorConfig(RAY, 2), policies), alone)
        with pytest.raises(ValueError, match=r"collector\.workers = 3 must be at most 2, the cores of the Ray cluster"):
            RolloutWorkers(CollectorConfig(RAY, 3), TABLES, 0, policies[0], 300)
    finally:
        ray.shutdown()


def test_rounds_go_on_from_the_random_numbers_that_were_noted(policies, alone):
    """What a resumed run needs: the play follows from weights, line-up, torch's random numbers and the tables'."""
    policy, league = policies
    torch.manual_seed(1)
    first = RolloutWorkers(CollectorConfig(), TABLES, 7, policy, 300)
    first.begin(league.lineup(MEMBERS))
    for _ in range(2):
        first.play(policy.state_dict())
    first.end()
    streams, random_state = first.streams.copy(), torch.get_rng_state()
    first.close()
    second = RolloutWorkers(CollectorConfig(), TABLES, 999, policy, 300)
    second.streams[:] = streams
    torch.set_rng_state(random_state)
    second.begin(league.lineup(MEMBERS))
    weights = {name: tensor * 0.5 for name, tensor in policy.state_dict().items()}
    again = [second.play(weights).clone() for _ in range(2)]
    second.end()
    second.close()
    for batch, other in zip(again, alone[0][2:], strict=True):
        assert torch.equal(batch["left", "observation"], other["left", "observation"])
        assert torch.equal(batch["right", "action"], other["right", "action"])
    assert np.array_equal(second.streams, alone[1])


@pytest.mark.parametrize("workers", [1, 2, 3, 4, 6, 12])
def test_a_part_of_a_lineup_is_who_sits_at_its_tables(workers):
    """60 tables of five members, 12 each, which neither 2, 3 nor 4 workers can share out member by member."""
    lineup = league_of(3).lineup([2, "striker", 0, "defender", 0])
    observation = torch.randn(60, 1, 12)
    mean, std = lineup(observation)
    each = 60 // workers
    for worker in range(workers):
        first, last = worker * each, (worker + 1) * each
        part_mean, part_std = lineup.part(first, last, 60)(observation[first:last])
        assert torch.allclose(part_mean, mean[first:last], atol=1e-6)
        assert torch.allclose(part_std, std[first:last], atol=1e-6)


def test_a_tables_noise_does_not_depend_on_who_plays_the_others():
    policy, observation = GaussianPolicy([8]), torch.randn(10, 1, 12)
    torch.manual_seed(0)
    whole = GaussianSampling(policy)(observation)
    torch.manual_seed(0)
    part = GaussianSampling(policy, TableSlice(4, 7, 10))(observation[4:7])
    assert torch.allclose(part, whole[4:7], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "several"}, "collector.kind = 'several' must be one of single, multisync, ray"),
        ({"kind": MULTISYNC, "workers": 0}, "collector.workers = 0 must be a whole number, at least 1"),
        ({"kind": MULTISYNC, "workers": True}, "collector.workers = True must be a whole number"),
        ({"kind": SINGLE, "workers": 2}, "collector.workers = 2 must be 1 where collector.kind = single"),
        ({"kind": MULTISYNC, "address": ""}, "collector.address = '' must be local, auto or"),
    ],
)
def test_collectors_that_cannot_be(arguments, message):
    with pytest.raises(ValueError, match=message):
        CollectorConfig(**arguments)


def test_tables_are_divided_evenly(policies):
    with pytest.raises(ValueError, match=r"env\.tables = 30 must be a multiple of collector\.workers = 4"):
        RolloutWorkers(CollectorConfig(MULTISYNC, 4), TABLES, 0, policies[0], 300)
