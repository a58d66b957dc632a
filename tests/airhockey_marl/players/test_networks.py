"""The paper's model."""

import pytest
import torch

from airhockey_marl.players.networks import (
    OPTIMAL_ACTION_HIDDEN,
    USER_PREDICTION_HIDDEN,
    GaussianPolicy,
    ObservationScaling,
)


@pytest.mark.parametrize(("hidden", "layers"), [(OPTIMAL_ACTION_HIDDEN, 2), (USER_PREDICTION_HIDDEN, 4)])
def test_the_models_have_the_papers_shape(hidden, layers):
    model = GaussianPolicy(hidden)
    sizes = [module.out_features for module in model.modules() if isinstance(module, torch.nn.Linear)]
    assert sizes == [*hidden, 4] and len(hidden) == layers
    assert sum(isinstance(module, torch.nn.ReLU) for module in model.modules()) == layers


def test_std_is_a_sigmoid_and_mean_is_free():
    model = GaussianPolicy()
    with torch.no_grad():
        model.head.weight *= 1000
    mean, std = model(10 * torch.randn(5, 7, 12))
    assert mean.shape == std.shape == (5, 7, 2)
    assert ((std >= 0) & (std <= 1)).all() and mean.abs().max() > 1


def test_many_models_at_once_are_each_model_by_itself():
    models = [GaussianPolicy([16, 8]) for _ in range(3)]
    weights = {
        name: torch.stack([dict(m.named_parameters())[name] for m in models])
        for name in dict(models[0].named_parameters())
    }
    observation = torch.randn(3, 5, 12)
    mean, std = models[0].forward_stacked(weights, observation)
    for k, model in enumerate(models):
        expected = model(observation[k])
        assert torch.allclose(mean[k], expected[0], atol=1e-6) and torch.allclose(std[k], expected[1], atol=1e-6)


def test_no_layers_is_refused():
    with pytest.raises(ValueError, match="hidden"):
        GaussianPolicy([])


@pytest.mark.parametrize("inputs", ["table", "paddle"])
def test_the_scaling_is_invertible(inputs):
    observation = torch.randn(50, 12)
    scaled = ObservationScaling(inputs)(observation)
    matrix = ObservationScaling(inputs)(torch.eye(12))
    assert torch.allclose(scaled, observation @ matrix, atol=1e-5) and torch.linalg.matrix_rank(matrix) == 12
    assert GaussianPolicy.from_architecture(GaussianPolicy([8], inputs).architecture).inputs.origin == inputs


def test_an_incomplete_architecture_is_refused():
    assert GaussianPolicy.from_architecture({"hidden": [8]}).inputs.origin == "table"  # files older than the choice
    with pytest.raises(ValueError, match="has no sizes of hidden layers"):
        GaussianPolicy.from_architecture({"inputs": "paddle"})
    with pytest.raises(ValueError, match="inputs = 'puck' must be 'table' or 'paddle'"):
        GaussianPolicy.from_architecture({"hidden": [8], "inputs": "puck"})
