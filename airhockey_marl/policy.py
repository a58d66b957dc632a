"""The paper's model (Figure 3): a game state in, the mean and the standard deviation of an action out."""

import itertools
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

OPTIMAL_ACTION_HIDDEN = (64, 64)  # section 3.2.1: what the paper's grid search found
USER_PREDICTION_HIDDEN = (80, 80, 80, 80)

# An observation's numbers divided by these are about 1: half a table's length and width in m, fast paddles in m/s.
# Constants rather than running statistics, which would move under a frozen opponent's feet.
BODY_SCALE = (0.97, 0.52, 3.0, 3.0)


class GaussianPolicy(nn.Module):
    """12 -> hidden ReLU layers -> mean (2) and sigmoid STD (2): a diagonal Gaussian over the action.

    Args:
        hidden: sizes of the hidden layers.
    """

    def __init__(self, hidden: Sequence[int] = OPTIMAL_ACTION_HIDDEN) -> None:
        super().__init__()
        if not hidden or min(hidden) < 1:
            raise ValueError(f"hidden = {tuple(hidden)} must name at least one layer, each of at least 1 unit")
        self.hidden = tuple(hidden)
        self.register_buffer("scale", torch.tensor(BODY_SCALE * 3), persistent=False)
        self.layers = nn.Sequential(*relu_layers(12, self.hidden))
        self.head = nn.Linear(self.hidden[-1], 4)
        with torch.no_grad():  # begin near the middle of one's side, and less wild than sigmoid(0) = 0.5
            self.head.weight *= 0.1
            self.head.bias[:] = torch.tensor([0.0, 0.0, 0.0, 0.0])

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (..., 12) to mean (..., 2), any number, and STD (..., 2), in (0, 1)."""
        mean, spread = self.head(self.layers(observation / self.scale)).chunk(2, dim=-1)
        return mean, torch.sigmoid(spread)

    def forward_each(self, weights: Mapping[str, Tensor], observation: Tensor) -> tuple[Tensor, Tensor]:
        """k models of this architecture at once, in one batched product per layer.

        Args:
            weights: by the names of the parameters, (k, ...) each; this model's own are not used.
            observation: (k, n, 12), each model's own.

        Returns:
            Mean and STD (k, n, 2).
        """

        def linear(name: str, inputs: Tensor) -> Tensor:
            return torch.baddbmm(weights[f"{name}.bias"].unsqueeze(1), inputs, weights[f"{name}.weight"].mT)

        hidden = observation / self.scale
        for index, layer in enumerate(self.layers):
            hidden = linear(f"layers.{index}", hidden) if isinstance(layer, nn.Linear) else layer(hidden)
        mean, spread = linear("head", hidden).chunk(2, dim=-1)
        return mean, torch.sigmoid(spread)


class Critic(nn.Module):
    """The value of a state, for the reinforcement learning of the optimal action model: 12 -> hidden tanh -> 1."""

    def __init__(self, hidden: Sequence[int] = (64, 64)) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(BODY_SCALE * 3), persistent=False)
        self.layers = nn.Sequential(*relu_layers(12, tuple(hidden), nn.Tanh), nn.Linear(hidden[-1], 1))

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations (..., 12) to values (..., 1)."""
        return self.layers(observation / self.scale)


def relu_layers(inputs: int, hidden: Sequence[int], activation: type[nn.Module] = nn.ReLU) -> list[nn.Module]:
    """Fully connected layers of the sizes `hidden`, each followed by its activation."""
    sizes = (inputs, *hidden)
    return [layer for a, b in itertools.pairwise(sizes) for layer in (nn.Linear(a, b), activation())]
