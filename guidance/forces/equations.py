"""The guiding forces of section 3.3: Eq. 4 to 7 as pure functions of tensors.

Nothing here knows a puck from a paddle. Every function takes any leading batch dimensions, works in float32 and
float64, and passes NaN on as NaN. Only shapes, dtypes and scalar parameters are checked: a look at the values of every
tensor in every tick would cost more than the arithmetic.
"""

import math

import torch
from torch import Tensor


def lookahead_state(state: Tensor, seconds: float) -> Tensor:
    """Moves every body along its current velocity: x_lookahead of section 3.3.

    Nothing stops a body on its way: walls, contacts and friction are left out, as in the paper. For other readings of
    the look-ahead see `guidance.forces.lookahead`.

    Args:
        state: (..., 4 * bodies), each body (x, y, vx, vy), positions and velocities in the same length unit, velocities
            per second.
        seconds: T_lookahead >= 0.

    Returns:
        The anticipated state, shaped like ``state``; velocities unchanged.

    Raises:
        ValueError: ``state`` is not floating point, not a multiple of 4 long, or ``seconds`` is negative or not finite.
    """
    _require_floating("state", state)
    if state.ndim == 0 or state.shape[-1] == 0 or state.shape[-1] % 4:
        raise ValueError(f"state: shape {tuple(state.shape)}, must be (..., 4 * bodies)")
    if not 0 <= seconds < math.inf:
        raise ValueError(f"seconds: {seconds}, must be finite and not negative")
    position, velocity = state.unflatten(-1, (-1, 4)).split(2, dim=-1)  # each (..., bodies, 2)
    return torch.cat((position + seconds * velocity, velocity), dim=-1).flatten(-2)


def spring_force(position: Tensor, target: Tensor, stiffness: float, limit: float) -> Tensor:
    """A spring toward the target, clipped: Eq. 4, clip(-K(u - y)).

    The norm of the force is clipped, not each axis, so that clipping never turns the force away from the target.

    Args:
        position: u, (..., 2), the hand in meters.
        target: y, (..., 2), the target action in meters of hand travel; broadcasts against ``position``.
        stiffness: K >= 0 in N/m.
        limit: the largest force >= 0 in newtons.

    Returns:
        The force in newtons, (..., 2); zero where the hand is on the target.

    Raises:
        ValueError: a tensor is not floating point (..., 2), or ``stiffness`` or ``limit`` is negative or not finite.
    """
    _require_pair("position", position, "target", target)
    for name, value in (("stiffness", stiffness), ("limit", limit)):
        if not 0 <= value < math.inf:
            raise ValueError(f"{name}: {value}, must be finite and not negative")
    # Size and direction apart: a stretch whose force overflows still ends at the limit, not at NaN.
    stretch, direction = _polar(target - position)
    return (stiffness * stretch).clamp(max=limit) * direction


def uncertainty_weight(std: Tensor, low: float, high: float) -> Tensor:
    """Uncertainty-based thresholding (UT): Eq. 5, a ramp from 1 at T_low down to 0 at T_high.

    Args:
        std: the predicted standard deviation of the action, (..., 2), in units of action.
        low: T_low > 0, a threshold on the *squared* norm of ``std``.
        high: T_high > T_low, likewise.

    Returns:
        W_unc in [0, 1], (...); multiply a force by ``weight[..., None]``.

    Raises:
        ValueError: ``std`` is not floating point (..., 2), or 0 < low < high < inf does not hold.
    """
    _require_vectors("std", std)
    if not 0 < low < high < math.inf:
        raise ValueError(f"low, high: {low}, {high}, must satisfy 0 < low < high < inf")
    squared_norm = std.square().sum(dim=-1)
    return ((high - squared_norm) / (high - low)).clamp(0, 1)


def combine(optimal: Tensor, user: Tensor) -> Tensor:
    """The plain combination (CombHG): Eq. 6, the average of the two forces.

    Args:
        optimal: F_OAHG, (..., 2), in newtons.
        user: F_UPHG, (..., 2), in newtons; broadcasts against ``optimal``.

    Returns:
        F_CombHG, (..., 2), in newtons.

    Raises:
        ValueError: a tensor is not floating point (..., 2).
    """
    _require_pair("optimal", optimal, "user", user)
    return (optimal + user) / 2


def similarity_weight(first: Tensor, second: Tensor) -> Tensor:
    """Similarity-based combination (SC): Eq. 7, cos^2(phi / 2), phi the angle between the two forces.

    Computed as (1 + cos phi) / 2, which needs no acos. The size of a force does not matter, be it 1e-30 N or 1e30 N. A
    zero force has no direction and the paper does not say what then; here cos phi counts as 0 and the weight is 1/2,
    halfway between agreement and opposition.

    Args:
        first: (..., 2), in any unit.
        second: (..., 2), in any unit; broadcasts against ``first``.

    Returns:
        W_sim in [0, 1], (...): 1 for the same direction, 1/2 at a right angle, 0 for opposite directions.

    Raises:
        ValueError: a tensor is not floating point (..., 2).
    """
    _require_pair("first", first, "second", second)
    (_, first_direction), (_, second_direction) = _polar(first), _polar(second)
    cosine = (first_direction * second_direction).sum(dim=-1)
    return ((1 + cosine) / 2).clamp(0, 1)  # rounding can leave the cosine a hair outside [-1, 1]


def _polar(vector: Tensor) -> tuple[Tensor, Tensor]:
    """Norm (..., 1) and direction (..., 2) of a vector (..., 2); the direction of zero is zero."""
    # Divided by its larger component first: the square of 1e30 is inf in float32, that of 1e-30 is 0.
    largest = vector.abs().amax(dim=-1, keepdim=True)
    scaled = vector / torch.where(largest == 0, 1, largest)
    norm = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True).clamp(min=1)  # in [1, sqrt 2] unless zero
    return largest * norm, scaled / norm


def _require_floating(name: str, tensor: Tensor) -> None:
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name}: {type(tensor).__name__}, must be a tensor")
    if not tensor.is_floating_point():
        raise ValueError(f"{name}: dtype {tensor.dtype}, must be floating point")


def _require_pair(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Two tensors of vectors that go together."""
    _require_vectors(name, tensor)
    _require_vectors(other_name, other)
    if tensor.device != other.device:
        raise ValueError(f"{other_name}: on {other.device}, must be on {tensor.device} as {name}")
    pairs = zip(reversed(tensor.shape), reversed(other.shape), strict=False)
    if any(a != b and 1 not in (a, b) for a, b in pairs):
        raise ValueError(f"{other_name}: shape {tuple(other.shape)}, must go with {tuple(tensor.shape)} of {name}")


def _require_vectors(name: str, tensor: Tensor) -> None:
    _require_floating(name, tensor)
    if tensor.ndim == 0 or tensor.shape[-1] != 2:
        raise ValueError(f"{name}: shape {tuple(tensor.shape)}, must be (..., 2)")
