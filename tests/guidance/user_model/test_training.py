"""Eq. 3 by hand, the pairing of demonstrations, and both trainings on synthetic users who differ in gain and offset."""

import math
import shutil

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from guidance.user_model.data import Demonstrations
from guidance.user_model.loss import prediction_loss
from guidance.user_model.maml import forward_stacked, parameters
from guidance.user_model.training import adapt_to_user, train_maml, train_supervised

USERS, GAMES, TICKS, BLOCK = 4, 4, 100, 50
ALPHA = 0.1


class Gaussian(nn.Module):
    """The model of Figure 3, small: 12 -> 2 x 32 ReLU -> mean (2) and, through a sigmoid, STD (2)."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(12, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 4))

    def forward(self, observation):
        mean, raw = self.net(observation).chunk(2, dim=-1)
        return mean, raw.sigmoid()


@pytest.fixture
def model():
    torch.manual_seed(0)
    return Gaussian()


def synthetic_users(seed, users=USERS):
    """Users who follow the puck (the last four of the state), each with an own gain and offset."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(users, GAMES, TICKS, 12, generator=generator)
    gain = 0.2 + 0.6 * torch.rand(users, 1, 1, 1, generator=generator)
    offset = torch.randn(users, 1, 1, 2, generator=generator)
    noise = 0.05 * torch.randn(users, GAMES, TICKS, 2, generator=generator)
    return Demonstrations(observation, gain * observation[..., 8:10] + offset + noise)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


# Eq. 3


def test_prediction_loss_by_hand():
    # sigma = (0.3, 0.4): ||sigma||^2 = 0.25. Errors (0.6, 0.8) and 0: squared 1 and 0.
    # First sample 1 / 0.5 + ln(0.25) / 2 = 2 - ln 2, second -ln 2; the mean is 1 - ln 2.
    mean, std = torch.zeros(2, 2), torch.tensor((0.3, 0.4)).expand(2, 2)
    action = torch.tensor(((0.6, -0.8), (0.0, 0.0)))
    assert prediction_loss(mean, std, action).item() == pytest.approx(1 - math.log(2), rel=1e-6)


def test_prediction_loss_averages_over_all_leading_dimensions():
    mean, std, action = torch.randn(3, 5, 2), torch.rand(3, 5, 2) + 0.1, torch.randn(3, 5, 2)
    one_by_one = [prediction_loss(mean[i, j], std[i, j], action[i, j]) for i in range(3) for j in range(5)]
    assert_close(prediction_loss(mean, std, action), torch.stack(one_by_one).mean())


@given(st.floats(0.01, 10), st.floats(0, math.pi / 2))
def test_prediction_loss_is_least_where_the_variance_is_the_squared_error(error, share):
    """At a fixed error, along every way of sharing the norm of the STD between the axes."""
    action = torch.tensor((0.0, error), dtype=torch.float64)

    def loss(norm):
        std = norm * torch.tensor((math.cos(share), math.sin(share)), dtype=torch.float64)
        return prediction_loss(torch.zeros(2, dtype=torch.float64), std, action)

    least = loss(error).item()
    assert least == pytest.approx(0.5 + math.log(error), abs=1e-9)
    assert all(loss(factor * error) > least for factor in (0.5, 0.9, 0.99, 1.01, 1.1, 2))
    norm = torch.tensor(error, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(norm), norm)
    assert abs(slope.item() * error) < 1e-9


def test_prediction_loss_pulls_the_mean_to_the_action():
    """The slope is (y_hat - y) / ||sigma||^2 a sample: doubt weakens the pull."""
    mean = torch.zeros(1, 2, requires_grad=True)
    action = torch.tensor([[0.5, -1.0]])
    for std in (0.5, 1.0):
        (slope,) = torch.autograd.grad(prediction_loss(mean, torch.full((1, 2), std), action), mean)
        assert_close(slope, -action / (2 * std**2))


# demonstrations


def labeled(users, games, ticks):
    """Observations with the numbers of user, game and tick as their first three values."""
    observation = torch.zeros(users, games, ticks, 12)
    for place, size in enumerate((users, games, ticks)):
        shape = [1, 1, 1]
        shape[place] = size
        observation[..., place] = torch.arange(size).view(shape)
    return Demonstrations(observation, observation[..., 1:3].clone())


@given(st.integers(1, 3), st.integers(2, 5), st.integers(1, 3), st.integers(1, 4), st.integers(0, 3), st.integers(0, 9))
def test_pairs_come_from_two_games_of_the_same_user(users, games, per_game, block, rest, seed):
    data = labeled(users, games, per_game * block + rest % block)
    blocks, steps = [], 0
    for demo, valid in data.pairs(block, seeded(seed)):
        for observation, action in (demo, valid):
            assert observation.shape == (users, block, 12) and action.shape == (users, block, 2)
            assert torch.equal(action, observation[..., 1:3])
            user, game, tick = observation[..., :3].unbind(-1)  # each (users, block)
            assert torch.equal(user, torch.arange(users).float()[:, None].expand(users, block))
            assert (game == game[:, :1]).all() and (tick == tick[:, :1] + torch.arange(block)).all()
            blocks += [(i, int(game[i, 0]), int(tick[i, 0])) for i in range(users)]
        assert (demo[0][:, 0, 1] != valid[0][:, 0, 1]).all()
        steps += 1
    assert steps == games * per_game // 2
    assert len(set(blocks)) == len(blocks)


def test_the_paper_has_twenty_meta_steps_an_epoch():
    data = Demonstrations(torch.zeros(9, 10, 4000, 12), torch.zeros(9, 10, 4000, 2))  # 360K ticks
    assert sum(1 for _ in data.pairs(1000)) == 20


def test_pairs_change_from_epoch_to_epoch_and_repeat_with_the_seed():
    data, generator = labeled(2, 6, 8), seeded()
    first, second = ([demo[0] for demo, _ in data.pairs(2, generator)] for _ in range(2))
    again = [demo[0] for demo, _ in data.pairs(2, seeded())]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_any_block_of_a_game_may_meet_any_of_another():
    data, generator, met = labeled(1, 2, 3), seeded(), set()
    for _ in range(100):
        met |= {(int(demo[0][0, 0, 2]), int(valid[0][0, 0, 2])) for demo, valid in data.pairs(1, generator)}
    assert met == {(first, second) for first in range(3) for second in range(3)}


def test_batches_pass_over_every_tick_once():
    data = labeled(2, 3, 7)  # 42 ticks
    batches = list(data.batches(10, seeded()))
    assert [len(action) for _, action in batches] == [10, 10, 10, 10, 2]
    seen = torch.cat([observation[:, :3] for observation, _ in batches])
    assert not torch.equal(seen, data.observation.flatten(0, 2)[:, :3])
    assert torch.equal(seen.unique(dim=0), data.observation.flatten(0, 2)[:, :3].unique(dim=0)) and len(seen) == 42
    assert all(torch.equal(observation[:, 1:3], action) for observation, action in batches)


# training


def test_supervised_training_reduces_the_loss(model):
    data = synthetic_users(seed=1)
    history = list(train_supervised(model, data, epochs=20, batch_size=100, lr=1e-2, generator=seeded()))
    assert [metrics["epoch"] for metrics in history] == list(range(1, 21))
    assert history[-1]["loss"] < history[0]["loss"] - 0.1
    with torch.no_grad():
        final = prediction_loss(*model(data.observation), data.action).item()
    assert final == pytest.approx(history[-1]["loss"], abs=0.1)


def test_supervised_loss_is_the_mean_over_ticks_even_of_unequal_batches(model):
    data = synthetic_users(seed=1)
    with torch.no_grad():
        expected = prediction_loss(*model(data.observation), data.action).item()
    (metrics,) = train_supervised(model, data, epochs=1, batch_size=900, lr=1e-12)  # 900 and 700 ticks, standing still
    assert metrics["loss"] == pytest.approx(expected, rel=1e-5)


def cross_losses(model, data):
    """L[i, j]: user i's loss in game 1 after adapting to user j in game 0, and without adaptation (users, 1)."""
    adapted = adapt_to_user(model, parameters(model), data.observation[:, 0], data.action[:, 0], ALPHA)
    users, losses = len(data.action), []
    with torch.no_grad():
        for observation, action in zip(data.observation[:, 1], data.action[:, 1], strict=True):
            means, stds = forward_stacked(model, adapted, observation.expand(users, -1, -1))
            own = [prediction_loss(mean, std, action) for mean, std in zip(means, stds, strict=True)]
            losses.append(torch.stack([*own, prediction_loss(*model(observation), action)]))
    table = torch.stack(losses)
    return table[:, :users], table[:, users:]


def test_adaptation_after_maml_is_specific_to_the_user(model):
    history = list(train_maml(model, synthetic_users(seed=1, users=9), 60, BLOCK, ALPHA, lr=3e-3, generator=seeded()))
    assert history[-1]["loss"] < history[0]["loss"] - 0.3
    assert history[-1]["loss"] < history[-1]["loss_before"] - 0.3
    matrix, before = cross_losses(model, synthetic_users(seed=2))  # four users it never saw
    own, others = matrix.diagonal()[:, None], matrix[~torch.eye(USERS, dtype=torch.bool)].view(USERS, USERS - 1)
    assert (own < before).all()
    assert (own < others).all()


def test_maml_metrics_are_means_over_users(model):
    data = synthetic_users(seed=1)
    observation, action = data.observation[:, :2, :BLOCK], data.action[:, :2, :BLOCK]
    same = Demonstrations(
        observation[:, :1].repeat(1, 2, 1, 1), action[:, :1].repeat(1, 2, 1, 1)
    )  # one step, known data
    adapted = adapt_to_user(model, parameters(model), same.observation[:, 0], same.action[:, 0], ALPHA)
    with torch.no_grad():
        after = prediction_loss(*forward_stacked(model, adapted, same.observation[:, 0]), same.action[:, 0]).item()
        before = prediction_loss(*model(same.observation[:, 0]), same.action[:, 0]).item()
    (metrics,) = train_maml(model, same, epochs=1, block=BLOCK, inner_lr=ALPHA)
    assert metrics == {
        "epoch": 1,
        "loss": pytest.approx(after, rel=1e-5),
        "loss_before": pytest.approx(before, rel=1e-5),
    }


def test_the_meta_gradient_is_clipped_to_its_norm(model):
    def last_norm(max_norm):
        list(train_maml(model, synthetic_users(seed=1), 1, BLOCK, ALPHA, max_norm=max_norm))
        return torch.cat([p.grad.flatten() for p in model.parameters()]).norm().item()

    assert last_norm(math.inf) > 0.1
    assert last_norm(0.1) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_the_compiled_meta_step_is_the_same_step():
    """One epoch of several Adam steps; parameters agree to rounding, and the metrics with them."""
    runs = []
    for compiled in (False, True):
        torch.manual_seed(0)
        model = Gaussian()
        metrics = list(
            train_maml(
                model, synthetic_users(seed=1), 1, BLOCK, ALPHA, max_norm=1.0, compiled=compiled, generator=seeded()
            )
        )
        runs.append(([p.detach() for p in model.parameters()], torch.tensor(list(metrics[0].values()))))
    torch.testing.assert_close(runs[0], runs[1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "train",
    [
        lambda model, seed: train_supervised(model, synthetic_users(1), 3, 300, generator=seeded(seed)),
        lambda model, seed: train_maml(model, synthetic_users(1), 3, BLOCK, generator=seeded(seed)),
        lambda model, seed: train_maml(
            model, synthetic_users(1), 3, BLOCK, steps=2, first_order=True, generator=seeded(seed)
        ),
    ],
    ids=["supervised", "maml", "first_order_maml"],
)
def test_training_repeats_bit_for_bit_with_the_seed(train):
    runs = []
    for seed in (0, 0, 1):
        torch.manual_seed(0)
        model = Gaussian()
        torch.manual_seed(len(runs))  # nothing may come from the global generator
        runs.append((list(train(model, seed)), torch.cat([p.detach().flatten() for p in model.parameters()])))
    (first, theta), (second, same), (_, other) = runs
    assert first == second
    assert torch.equal(theta, same)
    assert not torch.equal(theta, other)


def test_adapt_to_user_is_one_step_of_gradient_descent(model):
    data = synthetic_users(seed=3)
    observation, action = data.observation[:, 0], data.action[:, 0]
    adapted = adapt_to_user(model, parameters(model), observation, action, ALPHA)
    assert adapted.batch_size == (USERS,)
    weight = model.net[0].weight
    for i in range(USERS):
        (slope,) = torch.autograd.grad(prediction_loss(*model(observation[i]), action[i]), weight)
        assert_close(adapted["net", "0", "weight"][i], weight - ALPHA * slope)
    assert not any(leaf.requires_grad for leaf in adapted.values(include_nested=True, leaves_only=True))


# what is refused


class Broken(nn.Linear):
    """Predicts a standard deviation of zero."""

    def forward(self, observation):
        mean = super().forward(observation)
        return mean, 0 * mean


class Cliff(nn.Module):
    """Finite, but infinitely steep."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(2))

    def forward(self, observation):
        mean = observation[..., :2] + self.weight.sqrt()
        return mean, torch.ones_like(mean)


@pytest.mark.parametrize("model", [Broken(12, 2), Cliff()])
@pytest.mark.parametrize("train", [lambda m, d: train_supervised(m, d, 1), lambda m, d: train_maml(m, d, 1, BLOCK)])
def test_training_stops_when_the_loss_or_its_gradient_is_not_finite(train, model):
    before = model.weight.detach().clone()
    with pytest.raises(FloatingPointError, match=r"^loss: .* in epoch 1, must be finite"):
        list(train(model, synthetic_users(1)))
    assert torch.equal(model.weight, before)


def bad(observation=(2, 2, 5, 12), action=(2, 2, 5, 2), dtype=torch.float32, value=0.0):
    return Demonstrations(torch.zeros(observation), torch.full(action, value, dtype=dtype))


@pytest.mark.parametrize(
    ("field", "call"),
    [
        ("observation", lambda: bad(observation=(2, 2, 5, 11))),
        ("observation", lambda: bad(observation=(2, 0, 5, 12), action=(2, 0, 5, 2))),
        ("action", lambda: bad(action=(2, 5, 2))),
        ("action", lambda: bad(action=(2, 2, 4, 2))),
        ("action", lambda: bad(dtype=torch.float64)),
        ("action", lambda: bad(value=math.nan)),
    ],
)
def test_bad_input_is_refused_by_name(field, call):
    with pytest.raises(ValueError, match=rf"^{field}\b.*must"):
        call()
