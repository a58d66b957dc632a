"""The loss of the user prediction model: Eq. 3."""

from torch import Tensor

from airhockey_marl.experiment.validation import as_tensor


def prediction_loss(mean: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Eq. 3 as printed: mean of ||y - y_hat||^2 / (2 ||sigma||^2) + ln(||sigma||^2) / 2 over the samples.

    ||sigma||^2 is the sum over both axes. At a fixed error the loss is least where ||sigma||^2 equals the squared
    error, so the norm of the STD learns the size of the error; its split between the axes is not trained. (The
    likelihood of a two-dimensional Gaussian would weigh the logarithm differently; this is the paper's loss.)

    Args:
        mean: y_hat, the predicted mean, (..., 2), in units of action.
        std: sigma, the predicted standard deviation > 0, (..., 2).
        action: y, the action taken, (..., 2).
    """
    variance = std.square().sum(dim=-1)  # ||sigma||^2, (...)
    squared_error = (as_tensor("action", action, 2, mean.dtype) - mean).square().sum(dim=-1)  # (...)
    return (squared_error / (2 * variance) + variance.log() / 2).mean()
