"""The loss of the user prediction model (Eq. 3)."""

from torch import Tensor


def prediction_loss(mean: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """The loss of the user prediction model: Eq. 3, as printed.

    ||sigma||^2 is the sum over both axes. At a fixed error the loss is least where ||sigma||^2 equals the squared error
    ||y - y_hat||^2, so the norm of the STD comes to mean the size of the error; how the axes share it is not trained.
    (The likelihood of a two-dimensional Gaussian would weigh the logarithm differently; this is the paper's loss.)

    Args:
        mean: y_hat, the predicted mean, (..., 2), in units of action.
        std: sigma, the predicted standard deviation > 0, (..., 2).
        action: y, the action taken, (..., 2).

    Returns:
        The mean over all N samples, a scalar.

    Raises:
        ValueError: the shapes are not all the same (..., 2), or a dtype is not floating point.
    """
    for name, tensor in (("action", action), ("mean", mean), ("std", std)):
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name}: {type(tensor).__name__}, must be a tensor")
        if tensor.device != action.device:
            raise ValueError(f"{name}: on {tensor.device}, must be on {action.device} as action")
        if tensor.ndim == 0 or tensor.shape[-1] != 2 or tensor.shape != action.shape:
            raise ValueError(f"{name}: shape {tuple(tensor.shape)}, must be (..., 2) and that of action")
        if not tensor.is_floating_point():
            raise ValueError(f"{name}: dtype {tensor.dtype}, must be floating point")
    variance = std.square().sum(dim=-1)  # ||sigma||^2, (...)
    squared_error = (action - mean).square().sum(dim=-1)  # (...)
    return (squared_error / (2 * variance) + variance.log() / 2).mean()
