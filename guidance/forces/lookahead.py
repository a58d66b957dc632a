"""The look-ahead of section 3.3: where a model is evaluated, and toward which target its output pulls.

The paper evaluates the models at the state to which the present velocities lead in T_lookahead, and pulls the present
hand u toward their output y. This has three readings:

reading      the state in T                                    the force of Eq. 4
printed      every body moves on, through walls and bodies     clip(-K (u - y))
physics      the table's own physics, while nobody steers      clip(-K (u - y))
consistent   the table's own physics, while nobody steers      clip(-K ((u + T u') - y)), u' the hand's velocity

`printed` is the paper's text. It puts a puck that is 20 cm before the paddle at 3 m/s behind it, and evaluates the
model at a goal: hence `physics`. `consistent` is the predictive haptic guidance of Forsyth & MacLean (2006), whom the
paper follows: it compares the output with the hand at the same moment. Then the hand's own motion causes no force: a
model that only extrapolates the hand gives none, and a spring toward a target that does not depend on the hand is
damped by K T u'. In the other two readings a model that predicts the hand pushes along its motion by K T u', which is
negative damping.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec, action_range, coast
from airhockey_marl.experiment.validation import check_numbers
from guidance.forces.equations import lookahead_state

PRINTED, PHYSICS, CONSISTENT = "printed", "physics", "consistent"
READINGS = (PRINTED, PHYSICS, CONSISTENT)


@dataclass(frozen=True)
class Lookahead:
    """T_lookahead and its reading (`guidance.lookahead` of the configuration).

    Attributes:
        seconds: T_lookahead in s.
        reading: one of `READINGS`.
    """

    seconds: float
    reading: str = PRINTED

    def __post_init__(self) -> None:
        check_numbers(0.0, at_most=1.0, **{"guidance.lookahead.seconds": self.seconds})
        if self.reading not in READINGS:
            raise ValueError(f"guidance.lookahead.reading = {self.reading} must be one of {', '.join(READINGS)}")

    def target(self, hand: Tensor, mean: Tensor, state: Tensor, seconds: float) -> Tensor:
        """Where the spring pulls the present hand to, (..., 2) in units of action.

        Args:
            hand: (..., 2) u, where the hand is, in units of action.
            mean: (..., 2) y, the model's output.
            state: (..., 12) the present state.
            seconds: from now to the moment of which y is the action.
        """
        if self.reading != CONSISTENT or not seconds:
            return mean
        return relative_target(hand, paddle_as_action(state, TableSpec())[1], mean, seconds)


def moved_state(state: Tensor, seconds: float, reading: str) -> Tensor:
    """The state (..., 12) `seconds` later by a reading, for states (..., 12) as either side observes them."""
    return lookahead_state(state, seconds) if reading == PRINTED else coasted_state(state, seconds)


def coasted_state(state: Tensor, seconds: float) -> Tensor:
    """The state (..., 12) after `seconds` of the table's physics in which nobody steers, see `physics.coast`.

    Raises:
        ValueError: `state` is not floating point (..., 12), or `seconds` is negative or not finite.
    """
    if not state.is_floating_point() or state.ndim == 0 or state.shape[-1] != 12:
        raise ValueError(f"state: {state.dtype} {tuple(state.shape)}, must be floating point (..., 12)")
    if not 0 <= seconds < math.inf:
        raise ValueError(f"seconds: {seconds}, must be finite and not negative")
    bodies = state.detach().cpu().numpy().astype(np.float64).reshape(-1, 3, 4)
    coast(bodies, float(seconds), TableSpec())
    return torch.from_numpy(bodies.reshape(state.shape)).to(state)


def relative_target(hand: Tensor, velocity: Tensor, mean: Tensor, seconds: float) -> Tensor:
    """The target that gives the present hand the force of the hand as it will be: u + (y - (u + T u')).

    The hand goes on to the end of its range at most, or to y where that lies beyond: a y that extrapolates the hand
    gives exactly u, with or without an end to the range.

    Args:
        hand: (..., 2) u, in units of action.
        velocity: (..., 2) u', in units of action per second.
        mean: (..., 2) y, in units of action.
        seconds: T >= 0.
    """
    extrapolated = hand + seconds * velocity
    extrapolated = torch.minimum(torch.maximum(extrapolated, mean.clamp(max=-1.0)), mean.clamp(min=1.0))
    return hand + (mean - extrapolated)


def paddle_as_action(state: Tensor, table: TableSpec) -> tuple[Tensor, Tensor]:
    """Position (..., 2) of the own paddle in units of action, and its velocity (..., 2) per second."""
    middle, half = (torch.tensor(part, dtype=state.dtype) for part in action_range(table))
    return (state[..., 0:2] - middle) / half, state[..., 2:4] / half
