"""Situations of decisions, compared with the physics; STDs, intervals and maps of synthetic trajectories."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.evaluation.policy_std import (
    AWAY,
    OTHER,
    SAVE,
    SITUATIONS,
    STRIKE,
    Trajectories,
    record_trajectories,
    situations,
    smoothness,
    std_by_situation,
    std_map,
)
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import greedy, stochastic

TABLE = TableSpec()
NEAR, ASIDE, BEYOND = (-0.3, 0.2, 0.1, 0.3), (-0.6, -0.4, 1.0, 0.0), (0.5, 0.1, 0.2, 0.0)


def observed(*pucks: tuple[float, float, float, float]) -> np.ndarray:
    """(T, 1, 12): paddles at rest in the middle of their sides, the puck as given."""
    observation = np.zeros((len(pucks), 1, 12), dtype=np.float32)
    observation[..., 0], observation[..., 4] = -TABLE.length / 4, TABLE.length / 4
    observation[:, 0, 8:] = pucks
    return observation


def make_trajectories(
    *pucks, std: float = 0.2, touched: tuple[int, ...] = (), ended: tuple[int, ...] = ()
) -> Trajectories:
    observation = observed(*pucks)
    nothing = np.zeros((len(pucks), 1, 2), dtype=np.float32)
    events = [np.isin(np.arange(len(pucks)), when)[:, None] for when in (touched, ended)]
    return Trajectories(observation, nothing, nothing + std, nothing, *events, 0.04, TABLE)


def test_every_decision_is_in_one_situation():
    saving = (-0.4, 0.0, -2.0, 0.0)  # in the goal in 0.29 s
    slow = (-0.4, 0.0, -0.2, 0.0)
    trajectories = make_trajectories(saving, slow, BEYOND, NEAR, (0.3, 0.4, -0.1, 0.0), (0.1, 0.0, 0.0, 0.0))
    assert situations(trajectories)[:, 0].tolist() == [SAVE, OTHER, AWAY, OTHER, AWAY, AWAY]


def test_before_a_strike_is_five_decisions_within_a_rally():
    still = [NEAR] * 12
    assert (
        situations(make_trajectories(*still, touched=(7,)))[:, 0].tolist() == [OTHER] * 3 + [STRIKE] * 5 + [OTHER] * 4
    )
    cut = situations(make_trajectories(*still, touched=(7,), ended=(5,)))[:, 0].tolist()
    assert cut == [OTHER] * 6 + [STRIKE] * 2 + [OTHER] * 4
    last = situations(make_trajectories(*still, touched=(11,), ended=(11,)))[:, 0].tolist()
    assert last == [OTHER] * 7 + [STRIKE] * 5
    coming = [(-0.4, 0.0, -2.0, 0.0)] * 3
    assert set(situations(make_trajectories(*coming, touched=(2,)))[:, 0]) == {SAVE}  # a save is no strike


def test_std_by_situation_is_the_mean_of_its_decisions():
    rng = np.random.default_rng(0)
    pucks = np.where(rng.random((500, 20, 1)) < 0.5, BEYOND, NEAR)
    observation = np.repeat(observed(NEAR), 20, axis=1).repeat(500, axis=0)
    observation[..., 8:] = pucks
    far = pucks[..., 0] > 0
    std = np.where(far, 0.3, 0.2)[..., None] + 0.01 * rng.normal(size=(500, 20, 1)) + [-0.05, 0.05]
    nothing, never = np.zeros((500, 20, 2)), np.zeros((500, 20), dtype=bool)
    trajectories = Trajectories(observation, nothing, std, nothing, never, never, 0.04, TABLE)
    table = std_by_situation(trajectories).set_index("situation")
    assert table["decisions"].to_dict() == {
        "before a save": 0,
        "before a strike": 0,
        "puck far away": far.sum(),
        "otherwise": (~far).sum(),
        "all": 10_000,
    }
    away = table.loc["puck far away"]
    assert away["std"] == pytest.approx(std[far].mean()) and away["along"] == pytest.approx(std[far][:, 0].mean())
    error = 0.01 / far.sum() ** 0.5
    for row in (away, table.loc["otherwise"]):
        assert row["low"] < row["std"] < row["high"]
        assert 2 * error < row["high"] - row["low"] < 6 * error
    assert table.loc["otherwise", "difference_low"] < -0.1 < table.loc["otherwise", "difference_high"]
    assert table.loc["before a save", ["std", "low", "difference_low", "difference_high"]].isna().all()
    assert table["share"][list(SITUATIONS)].sum() == pytest.approx(1)
    pd.testing.assert_frame_equal(std_by_situation(trajectories), std_by_situation(trajectories))


def test_intervals_are_wider_if_tables_differ():
    """Decisions at one table are not independent: the bootstrap is over tables."""
    trajectories = make_trajectories(*[NEAR] * 400)
    many = {name: np.repeat(getattr(trajectories, name), 10, axis=1) for name in ("observation", "mean", "action")}
    flags = {name: np.repeat(getattr(trajectories, name), 10, axis=1) for name in ("touched", "ended")}
    std = np.zeros((400, 10, 2)) + np.linspace(0.1, 0.3, 10)[None, :, None]
    row = std_by_situation(Trajectories(std=std, decision_seconds=0.04, table=TABLE, **many, **flags)).set_index(
        "situation"
    )
    low, high = row.loc["otherwise", ["low", "high"]]
    assert high - low == pytest.approx(2 * 1.96 * np.linspace(0.1, 0.3, 10).std() / 10**0.5, rel=0.1)


def test_std_map_is_by_the_place_of_the_puck():
    trajectories = make_trajectories(*[(-0.9, 0.4, -1.0, 0.0)] * 3, *[(0.9, -0.4, 1.0, 0.0)] * 5)
    trajectories = replace(trajectories, std=np.concatenate([np.full((3, 1, 2), 0.1), np.full((5, 1, 2), 0.3)]))
    coming, going = (std_map(trajectories, toward, cells=(10, 4), min_decisions=2) for toward in (True, False))
    assert coming.shape == (4, 10)
    assert np.argwhere(np.isfinite(coming)).tolist() == [[3, 0]] and coming[3, 0] == pytest.approx(0.1)
    assert np.argwhere(np.isfinite(going)).tolist() == [[0, 9]] and going[0, 9] == pytest.approx(0.3)
    assert np.isnan(std_map(trajectories, True, cells=(10, 4), min_decisions=4)).all()


def test_smoothness_is_the_change_within_a_rally():
    trajectories = make_trajectories(*[NEAR] * 6, ended=(2,))
    mean = np.array([0.0, 0.1, 0.2, -5.0, -0.9, -0.8])[:, None, None] * [1.0, 1.0]
    observation = trajectories.observation.copy()
    observation[:3, 0, 2] = TABLE.paddle_speed
    result = smoothness(replace(trajectories, mean=mean, action=-mean, observation=observation))
    assert result["mean_change"] == pytest.approx(0.1) == result["action_change"]  # -5 is clipped to -1
    assert result["at_top_speed"] == 0.5 and result["paddle_speed"] == pytest.approx(TABLE.paddle_speed / 2)


@pytest.fixture(scope="module")
def recorded() -> Trajectories:
    torch.manual_seed(0)
    policy = GaussianPolicy([8])
    return record_trajectories(policy, greedy(policy), tables=30, seconds=20.0, seed=5, round_seconds=8.0)


def test_trajectories_have_the_policys_outputs_and_actions(recorded):
    torch.manual_seed(0)
    policy = GaussianPolicy([8])
    assert recorded.observation.shape == (500, 30, 12) and recorded.action.shape == (500, 30, 2)
    with torch.no_grad():
        mean, std = policy(torch.from_numpy(recorded.observation))
    np.testing.assert_allclose(recorded.mean, mean, atol=1e-6)
    np.testing.assert_allclose(recorded.std, std, atol=1e-6)
    noise = (recorded.action - recorded.mean) / recorded.std
    assert abs(noise.mean()) < 0.03 and abs(noise.std() - 1) < 0.03
    ended, touched = recorded.ended, recorded.touched
    new_round = np.isclose(recorded.observation[1:, :, :2], (-TABLE.length / 4, 0.0)).all(axis=-1)
    assert ended[:-1][new_round].all() and new_round.sum() > 30  # at least two rounds in 20 s of 8 s each
    assert 0 < touched.mean() < 0.5
    faster = np.abs(np.diff(recorded.observation[..., 10:], axis=0)).max(axis=-1) > 1.0
    calm = ~touched[:-1] & ~ended[:-1] & (np.abs(recorded.observation[:-1, :, 8]) < 0.1)
    assert not (faster & calm & (np.abs(recorded.observation[:-1, :, 9]) < 0.2)).any()  # nobody touched: no kick


def test_trajectories_are_reproducible(recorded):
    torch.manual_seed(0)
    policy = GaussianPolicy([8])
    repeated = record_trajectories(policy, greedy(policy), tables=30, seconds=20.0, seed=5, round_seconds=8.0)
    np.testing.assert_array_equal(repeated.observation, recorded.observation)
    other = record_trajectories(
        policy, stochastic(policy, torch.Generator().manual_seed(0)), tables=30, seconds=2.0, seed=6, round_seconds=8.0
    )
    assert not np.array_equal(other.observation, recorded.observation[:50])
