"""Training the user prediction model with and without meta-learning, and user adaptation (UA).

The model is any module that maps a game state (..., 12) to the mean (..., 2) and the standard deviation (..., 2) of the
user's next action. Both trainers change it in place. They are generators: each ``next`` trains one epoch and yields its
metrics as a dict, for a progress bar or a log::

    for metrics in train_maml(model, demonstrations, generator=generator):
        log(metrics)

Source: section 3.2.3 of the paper.
"""

import math
from collections.abc import Iterator
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.func import grad_and_value

from airhockey_marl.experiment.validation import as_tensor
from guidance.user_model.data import Demonstrations, Recordings, Samples
from guidance.user_model.loss import prediction_loss
from guidance.user_model.maml import adapt_stacked, forward, meta_loss, parameters


def train_supervised(
    model: nn.Module,
    data: Demonstrations | Recordings,
    epochs: int = 100,
    batch_size: int = 1000,
    lr: float = 1e-3,
    generator: torch.Generator | None = None,
    optimizer: torch.optim.Adam | None = None,
    done: int = 0,
) -> Iterator[dict[str, float]]:
    """Train one model for all users, without UA: Adam on Eq. 3.

    Args:
        model: state (..., 12) to mean and STD; changed in place.
        data: demonstrations of all users, taken together.
        epochs: passes over the data.
        batch_size: ticks of an update, drawn from all users and games.
        lr: learning rate of Adam.
        generator: source of the shuffling; the global one if None.
        optimizer, done: Adam and the number of completed epochs of a training that is resumed.

    Yields:
        After each epoch ``epoch`` (from 1) and ``loss``, the mean over its ticks, measured during the epoch.

    Raises:
        FloatingPointError: the loss or its gradient is no longer finite.
    """
    optimizer = optimizer or torch.optim.Adam(model.parameters(), lr)
    data = data.to(next(model.parameters()).dtype)
    for epoch in range(done + 1, epochs + 1):
        total, ticks = 0.0, 0
        for observation, action in data.batches(batch_size, generator):
            mean, std = model(observation)
            loss = prediction_loss(mean, std, action)
            optimizer.zero_grad()
            loss.backward()
            _step(optimizer, loss, epoch)
            total, ticks = total + loss.item() * len(action), ticks + len(action)
        yield {"epoch": epoch, "loss": total / ticks}


def train_maml(
    model: nn.Module,
    data: Demonstrations | Recordings,
    epochs: int = 200,
    block: int = 1000,
    inner_lr: float = 0.1,
    lr: float = 1e-3,
    steps: int = 1,
    first_order: bool = False,
    max_norm: float = math.inf,
    compiled: bool = False,
    generator: torch.Generator | None = None,
    optimizer: torch.optim.Adam | None = None,
    done: int = 0,
) -> Iterator[dict[str, float]]:
    """Train the parameters from which one gradient step adapts to a user: Adam on Eq. 2.

    A meta-step takes two blocks of every user. The paper does not define an epoch; here it is the meta-steps that use
    every block once: 360K ticks / (9 users x 2 x 1K) = 20.

    Args:
        model: state (..., 12) to mean and STD; changed in place, to theta.
        data: demonstrations of all users, two games or more each.
        epochs: passes over the data.
        block: ticks of D_demo and of D_valid of a user in a meta-step.
        inner_lr: alpha of Eq. 1.
        lr: learning rate of Adam.
        steps: inner gradient steps.
        first_order: leave the second derivatives out.
        max_norm: the norm, over all parameters, to which the gradient of Eq. 2 is clipped. The paper mentions no
            clipping, hence inf. Once the STD is small, 1 / ||sigma||^2 makes an inner step of 0.1 steep and the
            meta-gradient sometimes a hundred times its median, which sets training back; try 10.
        compiled: fuse the meta-step with torch.compile, which needs a C++ compiler and some 15 s once; the results
            differ in the last bits.
        generator: source of the pairing; the global one if None.
        optimizer, done: Adam and the number of completed epochs of a training that is resumed.

    Yields:
        After each epoch ``epoch`` (from 1), ``loss``, the mean over users and meta-steps of L(theta_adapt, D_valid),
        and ``loss_before``, the same without adaptation, L(theta, D_valid); both measured during the epoch.

    Raises:
        FloatingPointError: the loss or its gradient is no longer finite.
    """
    optimizer = optimizer or torch.optim.Adam(model.parameters(), lr)
    params, objective, users = parameters(model), partial(_data_loss, model), len(data)
    data = data.to(next(model.parameters()).dtype)

    def eq2(theta: TensorDict, demo: Samples, valid: Samples) -> Tensor:
        return meta_loss(theta, objective, demo, valid, inner_lr, steps, first_order)

    if compiled:
        torch.compiler.reset()  # or a sweep over sizes in one process exceeds the recompilation limit
    fused = torch.compile(grad_and_value(eq2)) if compiled else None
    for epoch in range(done + 1, epochs + 1):
        after, before = [], []
        for demo, valid in data.pairs(block, generator):
            with torch.no_grad():
                before.append(objective(params, valid).item())
            optimizer.zero_grad()
            if fused is None:
                loss = eq2(params, demo, valid)
                loss.backward()
            else:
                gradient, loss = fused(params.detach(), demo, valid)
                for name, parameter in model.named_parameters():
                    parameter.grad = gradient[tuple(name.split("."))]
            _step(optimizer, loss, epoch, max_norm)
            after.append(loss.item() / users)
        yield {"epoch": epoch, "loss": sum(after) / len(after), "loss_before": sum(before) / len(before)}


@torch.no_grad()
def adapt_to_user(
    model: nn.Module, params: TensorDict, observation: Tensor, action: Tensor, lr: float, steps: int = 1
) -> TensorDict:
    """User adaptation (UA): Eq. 1 for each of many users at once.

    Args:
        model: state (..., 12) to mean and STD; not changed.
        params: theta, the meta-trained parameters, usually ``parameters(model)``; not changed.
        observation: states of D_demo, (users, ticks, 12), a tensor or array of finite numbers.
        action: actions of D_demo, (users, ticks, 2), likewise.
        lr: alpha, the inner learning rate ``params`` were trained for.
        steps: gradient steps, likewise; one in the paper.

    Returns:
        Each user's parameters, batch size (users,), without a graph; for :func:`maml.forward_stacked`, or
        ``adapted[i]`` for one user.
    """
    dtype = next(iter(params.values(True, True))).dtype
    samples = as_tensor("observation", observation, 12, dtype, True), as_tensor("action", action, 2, dtype, True)
    return adapt_stacked(params, partial(_data_loss, model), samples, lr, steps)


def _data_loss(model: nn.Module, params: TensorDict, data: Samples) -> Tensor:
    """L(theta, D)."""
    observation, action = data
    mean, std = forward(model, params, observation)
    return prediction_loss(mean, std, action)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, epoch: int, max_norm: float = math.inf) -> None:
    norm = nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_norm)
    if not (loss.isfinite() and norm.isfinite()):  # before the step, which keeps the last finite model
        raise FloatingPointError(f"loss: {loss.item()}, gradient {norm.item()} in epoch {epoch}, must be finite")
    optimizer.step()
