"""The networks: the paper's Gaussian policy (Figure 3), the critic, and the scaling of their inputs."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from airhockey_marl.experiment.validation import as_tensor

OPTIMAL_ACTION_HIDDEN = (64, 64)  # section 3.2.1, from the paper's grid search
USER_PREDICTION_HIDDEN = (80, 80, 80, 80)

MAX_WEIGHTS = 10_000_000  # of a network; the paper's has 20 thousand

# Scale of x, y, vx, vy: half a table's length and width in m, the speed of a fast paddle in m/s. Constants, as running
# statistics would change the inputs of frozen opponents.
BODY_SCALE = (0.97, 0.52, 3.0, 3.0)
STROKE = 0.3  # m, scale of the puck's position relative to the paddle: a stroke is decided by centimeters
TABLE, PADDLE = "table", "paddle"  # origins of the puck's position


class ObservationScaling(nn.Module):
    """Scales observations (..., 12) for a network: an invertible linear map to 12 numbers of about 1.

    Args:
        origin: of the puck's position: "table", the table's center as in the observation, or "paddle", the own paddle.
    """

    def __init__(self, origin: str) -> None:
        super().__init__()
        if origin not in (TABLE, PADDLE):
            raise ValueError(f"inputs = {origin!r} must be {TABLE!r} or {PADDLE!r}")
        self.origin, scale = origin, torch.tensor(BODY_SCALE * 3)
        if origin == PADDLE:
            scale[8:10] = STROKE
        self.register_buffer("scale", scale, persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        if self.origin == TABLE:
            return observation / self.scale
        position = observation[..., 8:10] - observation[..., 0:2]
        return torch.cat([observation[..., :8], position, observation[..., 10:]], dim=-1) / self.scale


def check_hidden(hidden: Any, name: str = "hidden") -> None:
    """Raise a ValueError if `hidden` is no sequence of layer sizes, or makes more than `MAX_WEIGHTS` weights."""
    sized = isinstance(hidden, Sequence) and not isinstance(hidden, str) and len(hidden) > 0
    if not sized or not all(isinstance(size, int) and not isinstance(size, bool) and size >= 1 for size in hidden):
        sizes = tuple(hidden) if isinstance(hidden, Sequence) and not isinstance(hidden, str) else hidden
        raise ValueError(f"{name} = {sizes!r} must name at least one layer, each of at least 1 unit")
    weights = sum(a * b for a, b in itertools.pairwise((12, *hidden, 4)))
    if weights > MAX_WEIGHTS:
        raise ValueError(f"{name} = {tuple(hidden)} makes {weights} weights, must be at most {MAX_WEIGHTS}")


class GaussianPolicy(nn.Module):
    """12 -> hidden ReLU layers -> mean (2) and sigmoid STD (2): a diagonal Gaussian over the action.

    `inputs` is the origin of the puck's position, see `ObservationScaling`.
    """

    def __init__(self, hidden: Sequence[int] = OPTIMAL_ACTION_HIDDEN, inputs: str = TABLE) -> None:
        super().__init__()
        check_hidden(hidden)
        self.hidden = tuple(hidden)
        self.inputs = ObservationScaling(inputs)
        self.layers = nn.Sequential(*mlp_layers(12, self.hidden))
        self.head = nn.Linear(self.hidden[-1], 4)
        with torch.no_grad():  # initial actions near the midpoint of the own side, with a STD of sigmoid(0) = 0.5
            self.head.weight *= 0.1
            self.head.bias.zero_()

    @property
    def architecture(self) -> dict[str, Any]:
        """The architecture, as stored beside weights in a file; see `from_architecture`."""
        return {"hidden": list(self.hidden), "inputs": self.inputs.origin}

    @classmethod
    def from_architecture(cls, architecture: Mapping[str, Any]) -> "GaussianPolicy":
        """An untrained model of an `architecture`; other keys of a file's metadata are ignored."""
        if "hidden" not in architecture:
            raise ValueError("has no sizes of hidden layers (hidden): not a file of this project")
        return cls(architecture["hidden"], architecture.get("inputs", TABLE))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (..., 12) to mean (..., 2), unbounded, and STD (..., 2), in (0, 1), of the action."""
        inputs = self.inputs(as_tensor("observation", observation, 12, self.head.weight.dtype))
        mean, std_logit = self.head(self.layers(inputs)).chunk(2, dim=-1)
        return mean, torch.sigmoid(std_logit)

    def forward_stacked(self, weights: Mapping[str, Tensor], observation: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs of k models of this architecture, in one batched product per layer.

        Args:
            weights: of the k models, by the names of the parameters, (k, ...) each; this model's own are not used.
            observation: (k, n, 12), n observations for each model.

        Returns:
            Mean and STD (k, n, 2).
        """

        def linear(name: str, inputs: Tensor) -> Tensor:
            return torch.baddbmm(weights[f"{name}.bias"].unsqueeze(1), inputs, weights[f"{name}.weight"].mT)

        hidden = self.inputs(as_tensor("observation", observation, 12, weights["head.bias"].dtype))
        for index, layer in enumerate(self.layers):
            hidden = linear(f"layers.{index}", hidden) if isinstance(layer, nn.Linear) else layer(hidden)
        mean, std_logit = linear("head", hidden).chunk(2, dim=-1)
        return mean, torch.sigmoid(std_logit)


class Critic(nn.Module):
    """The value function for reinforcement learning: 12 -> hidden tanh layers -> 1."""

    def __init__(self, hidden: Sequence[int] = (64, 64), inputs: str = PADDLE) -> None:
        super().__init__()
        check_hidden(hidden)
        self.inputs = ObservationScaling(inputs)
        self.layers = nn.Sequential(*mlp_layers(12, tuple(hidden), nn.Tanh), nn.Linear(hidden[-1], 1))

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations (..., 12) to values (..., 1)."""
        return self.layers(self.inputs(observation))


def mlp_layers(inputs: int, hidden: Sequence[int], activation: type[nn.Module] = nn.ReLU) -> list[nn.Module]:
    """Fully connected layers of the sizes `hidden`, each followed by its activation.

    Orthogonal initialization with gain sqrt(2), which keeps the scale of the activations and helps on-policy learning
    (Andrychowicz et al. 2021, section 3.2); torch's default shrinks them layer by layer.
    """
    sizes, layers = (inputs, *hidden), []
    for a, b in itertools.pairwise(sizes):
        linear = nn.Linear(a, b)
        nn.init.orthogonal_(linear.weight, gain=2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, activation()]
    return layers
