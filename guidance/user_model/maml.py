"""Model-agnostic meta-learning (MAML): Eq. 1 and Eq. 2, for any module and any loss.

The core is functional. The parameters of a model are a TensorDict, a loss is a function of them, and :func:`adapt`
returns new ones through which gradients of any order flow; the model is never written to. Users are a leading dimension
that ``torch.vmap`` runs over, so the adapted parameters of nine users are one TensorDict of batch size (9,)::

    params = parameters(model)


    def loss(params, data):
        observation, action = data
        return mse_loss(forward(model, params, observation), action)


    meta_loss(params, loss, demo, valid, lr=0.1).backward()  # demo, valid: (users, ticks, ...)
    adapted = adapt_stacked(params, loss, demo, lr=0.1)  # (users,)
    forward_stacked(model, adapted, observation)  # (users, ticks, 12) -> (users, ticks, 2)

:class:`MAML` offers the same step as two verbs, clone and adapt, for loops over users in the manner of learn2learn.

Source: section 3.2.3 of the paper; Finn, Abbeel and Levine, ICML 2017.
"""

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.func import functional_call, grad
from torch.utils._pytree import tree_leaves

from airhockey_marl.experiment.validation import kind_of

Loss = Callable[[TensorDict], Tensor]
"""L(theta): parameters to a scalar."""

DataLoss = Callable[[TensorDict, Any], Tensor]
"""L(theta, D): parameters and one user's data (any tree of tensors) to a scalar."""


def parameters(model: nn.Module) -> TensorDict:
    """The parameters of ``model``, nested like its modules.

    They are the model's own tensors, not copies, so an optimizer of ``model.parameters()`` sees their gradients. Unlike
    ``TensorDict.from_module`` it leaves out buffers (a gradient step must not change a constant) and names a parameter
    that two modules share only once (copies would diverge).
    """
    return TensorDict(dict(model.named_parameters())).unflatten_keys(".")


def forward(model: nn.Module, params: TensorDict, *inputs: Tensor) -> Any:
    """``model(*inputs)`` under ``params``; parameters missing from ``params`` keep the model's values.

    Not ``with params.to_module(model)``, which leaves its parameters in the model when the call raises.

    """
    return functional_call(model, params.flatten_keys(".").to_dict(), inputs)


def forward_stacked(model: nn.Module, params: TensorDict, *inputs: Tensor) -> Any:
    """Every user's model on that user's inputs, in one batched call.

    Args:
        model: any module; not changed.
        params: stacked parameters of batch size (users,), as from :func:`adapt_stacked`.
        inputs: tensors (users, n, ...).

    Returns:
        What the model returns, with the leading dimension users: (users, n, ...).
    """
    _require_tensors(inputs=inputs)
    return torch.vmap(partial(forward, model))(params, *inputs)


def adapt(params: TensorDict, loss: Loss, lr: float, steps: int = 1, first_order: bool = False) -> TensorDict:
    """Gradient descent on ``loss``: Eq. 1, theta_adapt = theta - alpha grad L(theta, D_demo).

    Differentiable with respect to ``params`` and to tensors that ``loss`` captures; call it under ``torch.no_grad()``
    to build no graph.

    Args:
        params: theta, from :func:`parameters` or from an earlier adaptation; not changed.
        loss: L(., D_demo).
        lr: alpha > 0, the inner learning rate.
        steps: gradient steps >= 1, one in the paper.
        first_order: treat the inner gradient as a constant, which saves the second derivatives (FOMAML).

    Returns:
        theta_adapt, shaped like ``params``.

    Raises:
        ValueError: ``lr`` or ``steps`` out of range.
    """
    _require_rate(lr)
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(f"steps: {steps}, must be a whole number of at least 1")
    for _ in range(steps):
        params = _descend(params, grad(loss)(params), lr, first_order)
    return params


def adapt_stacked(
    params: TensorDict, loss: DataLoss, demo: Any, lr: float, steps: int = 1, first_order: bool = False
) -> TensorDict:
    """Eq. 1 for every user, from the same ``params``.

    Args:
        params: theta.
        loss: L(theta, D) for one user.
        demo: D_demo of all users: a tensor, tuple or TensorDict whose tensors are (users, ...).
        lr, steps, first_order: see :func:`adapt`.

    Returns:
        The adapted parameters stacked, batch size (users,).
    """
    _require_tensors(demo=demo)

    def adapt_one(data: Any) -> TensorDict:
        return adapt(params, lambda theta: loss(theta, data), lr, steps, first_order)

    return torch.vmap(adapt_one)(demo)


def meta_loss(
    params: TensorDict, loss: DataLoss, demo: Any, valid: Any, lr: float, steps: int = 1, first_order: bool = False
) -> Tensor:
    """The objective of meta-learning: Eq. 2, the sum over users of L(theta_adapt, D_valid).

    Args:
        params: theta; the gradient of the result with respect to it is the meta-gradient.
        loss: L(theta, D) for one user.
        demo: D_demo of all users, tensors (users, ...).
        valid: D_valid of the same users in the same order, tensors (users, ...).
        lr, steps, first_order: see :func:`adapt`.
    """
    _require_tensors(valid=valid)
    return torch.vmap(loss)(adapt_stacked(params, loss, demo, lr, steps, first_order), valid).sum()


class MAML:
    """A model that learns to adapt, with the two verbs of learn2learn: ``clone`` and ``adapt``.

    ::

        maml, optimizer = MAML(model, lr=0.1), Adam(model.parameters())
        for demo, valid in users:
            learner = maml.clone()
            learner.adapt(loss(learner(demo.x), demo.y))
            loss(learner(valid.x), valid.y).backward()
        optimizer.step()

    ``meta_loss`` computes the same for all users at once.

    Attributes:
        model: the module; never changed by adaptation.
        params: the parameters this learner uses, at first those of the model.
    """

    def __init__(self, model: nn.Module, lr: float, first_order: bool = False):
        _require_rate(lr)
        self.model, self.lr, self.first_order = model, lr, first_order
        self.params = parameters(model)

    def clone(self) -> "MAML":
        """A learner that starts from these parameters; its adaptation does not change this one."""
        return copy.copy(self)  # a shallow copy suffices: adapt replaces params and never writes into them

    def adapt(self, loss: Tensor) -> None:
        """One gradient step (Eq. 1) on a scalar loss computed with this learner.

        Raises:
            ValueError: ``loss`` is not a scalar with a gradient.
        """
        if not isinstance(loss, Tensor) or loss.ndim or not loss.requires_grad:
            got = f"shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
            raise ValueError(f"loss: {got}, must be a scalar that requires grad")
        names = list(self.params.keys(include_nested=True, leaves_only=True))
        leaves = [self.params[name] for name in names]
        gradients = torch.autograd.grad(loss, leaves, create_graph=not self.first_order, materialize_grads=True)
        gradient = TensorDict(dict(zip(names, gradients, strict=True)))
        self.params = _descend(self.params, gradient, self.lr, self.first_order)

    def __call__(self, *inputs: Tensor) -> Any:
        """The model with the parameters of this learner."""
        return forward(self.model, self.params, *inputs)


def _descend(params: TensorDict, gradient: TensorDict, lr: float, first_order: bool) -> TensorDict:
    if first_order:
        gradient = gradient.detach()
    # Leaf by leaf: arithmetic on whole TensorDicts does not pass through vmap.
    return params.apply(lambda p, g: p - lr * g, gradient)


def _require_tensors(**trees: Any) -> None:
    for name, tree in trees.items():
        for leaf in tree_leaves(tree):
            if not isinstance(leaf, Tensor):
                raise ValueError(f"{name}: {kind_of(leaf)}, must be tensors, such as torch.as_tensor makes")


def _require_rate(lr: float) -> None:
    if not 0 < lr < math.inf:
        raise ValueError(f"lr: {lr}, must be positive and finite")
