"""The paper's model (Figure 3): a game state in, the mean and the standard deviation of an action out."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from airhockey_marl.experiment.validation import check_counts, check_tensors

OPTIMAL_ACTION_HIDDEN = (64, 64)  # section 3.2.1: what the paper's grid search found
USER_PREDICTION_HIDDEN = (80, 80, 80, 80)

MOST_WEIGHTS = 10_000_000  # of a network; the paper's has 20 thousand

# An observation's numbers divided by these are about 1: half a table's length and width in m, fast paddles in m/s.
# Constants rather than running statistics, which would move under a frozen opponent's feet.
BODY_SCALE = (0.97, 0.52, 3.0, 3.0)
STROKE = 0.3  # m, the scale of the puck's place as seen from the paddle: a stroke is decided by centimeters
TABLE, PADDLE = "table", "paddle"  # where the puck's place is measured from


class ObservationScaling(nn.Module):
    """Observations (..., 12) as a network takes them: an invertible linear map to 12 numbers of about 1.

    Args:
        origin: of the puck's place: "table", its center, as in the observation; or "paddle", the own one.
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
        scale = self.scale
        sound = isinstance(observation, Tensor) and observation.shape[-1:] == (12,) and observation.is_floating_point()
        if not sound or observation.device != scale.device:  # by hand: it is asked in every tick
            check_tensors(scale.device, observation=(observation, "... 12"))
        if self.origin == TABLE:
            return observation / scale
        place = observation[..., 8:10] - observation[..., 0:2]
        return torch.cat([observation[..., :8], place, observation[..., 10:]], dim=-1) / scale


def check_hidden(hidden: Any, name: str = "hidden") -> None:
    """Refuse what are no sizes of hidden layers, or of a network larger than any of this project could be.

    Raises:
        ValueError: names the value and what is allowed.
    """
    sized = isinstance(hidden, Sequence) and not isinstance(hidden, str) and len(hidden) > 0
    if not sized or not all(isinstance(size, int) and not isinstance(size, bool) and size >= 1 for size in hidden):
        shown = tuple(hidden) if isinstance(hidden, Sequence) and not isinstance(hidden, str) else hidden
        raise ValueError(f"{name} = {shown!r} must name at least one layer, each of at least 1 unit")
    weights = sum(a * b for a, b in itertools.pairwise((12, *hidden, 4)))
    if weights > MOST_WEIGHTS:
        raise ValueError(f"{name} = {tuple(hidden)} makes {weights} weights, must be at most {MOST_WEIGHTS}")


class GaussianPolicy(nn.Module):
    """12 -> hidden ReLU layers -> mean (2) and sigmoid STD (2): a diagonal Gaussian over the action.

    Args:
        hidden: sizes of the hidden layers.
        inputs: where the puck's place is measured from, see `ObservationScaling`.
    """

    def __init__(self, hidden: Sequence[int] = OPTIMAL_ACTION_HIDDEN, inputs: str = TABLE) -> None:
        super().__init__()
        check_hidden(hidden)
        self.hidden = tuple(hidden)
        self.inputs = ObservationScaling(inputs)
        self.layers = nn.Sequential(*mlp_layers(12, self.hidden))
        self.head = nn.Linear(self.hidden[-1], 4)
        with torch.no_grad():  # begin near the middle of one's side, with a STD of sigmoid(0) = 0.5
            self.head.weight *= 0.1
            self.head.bias.zero_()

    @property
    def facts(self) -> dict[str, Any]:
        """What must be known of a file of weights to use them; see `from_facts`."""
        return {"hidden": list(self.hidden), "inputs": self.inputs.origin}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> "GaussianPolicy":
        """A model, untrained, of the architecture that a file's facts describe.

        Raises:
            ValueError: they describe none.
        """
        if "hidden" not in facts:
            raise ValueError("does not say its hidden sizes: not a file of this project")
        check_hidden(facts["hidden"])
        return cls(facts["hidden"], facts.get("inputs", TABLE))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations (..., 12) to mean (..., 2), any number, and STD (..., 2), in (0, 1)."""
        mean, spread = self.head(self.layers(self.inputs(observation))).chunk(2, dim=-1)
        return mean, torch.sigmoid(spread)

    def forward_stacked(self, weights: Mapping[str, Tensor], observation: Tensor) -> tuple[Tensor, Tensor]:
        """k models of this architecture at once, in one batched product per layer.

        Args:
            weights: by the names of the parameters, (k, ...) each; this model's own are not used.
            observation: (k, n, 12), each model's own.

        Returns:
            Mean and STD (k, n, 2).
        """

        def linear(name: str, inputs: Tensor) -> Tensor:
            return torch.baddbmm(weights[f"{name}.bias"].unsqueeze(1), inputs, weights[f"{name}.weight"].mT)

        models = len(weights["head.bias"]) if "head.bias" in weights else 0
        check_tensors(observation=(observation, f"{models} n 12"))
        hidden = self.inputs(observation)
        for index, layer in enumerate(self.layers):
            hidden = linear(f"layers.{index}", hidden) if isinstance(layer, nn.Linear) else layer(hidden)
        mean, spread = linear("head", hidden).chunk(2, dim=-1)
        return mean, torch.sigmoid(spread)


class Critic(nn.Module):
    """The value of a state, for the reinforcement learning of the optimal action model: 12 -> hidden tanh -> 1."""

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

    They begin orthogonal, at a scale that keeps activations about as large as the inputs, which on-policy learning
    wants (Andrychowicz et al. 2021, section 3.2); torch's own beginnings shrink them layer by layer.
    """
    check_counts(inputs=inputs)
    check_hidden(hidden)
    sizes, layers = (inputs, *hidden), []
    for a, b in itertools.pairwise(sizes):
        linear = nn.Linear(a, b)
        nn.init.orthogonal_(linear.weight, gain=2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, activation()]
    return layers
