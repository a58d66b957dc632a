"""The sinusoid regression of Finn et al. (2017, section 5.1) with `guidance.user_model.maml`: curves from ten points.

    python -m guidance.examples.sinusoid          # 10,000 meta-steps, a minute or two
    python -m guidance.examples.sinusoid 70000    # as many as in the original

Prints the mean squared error on unseen curves before and after steps of adaptation.
"""

import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from functools import partial

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss
from tqdm import trange

from guidance.user_model.maml import adapt_stacked, forward, meta_loss, parameters

Points = tuple[Tensor, Tensor]
"""x (curves, n, 1) and y (curves, n, 1)."""

INNER_LR, OUTER_LR, POINTS, CURVES = 0.01, 0.001, 10, 25


def sinusoids(curves: int, generator: Generator, demo: int = POINTS, valid: int = POINTS) -> tuple[Points, Points]:
    """D_demo and D_valid of curves y = a sin(x - b) with a in [0.1, 5], b in [0, pi] and x in [-5, 5]."""
    amplitude = 0.1 + 4.9 * torch.rand(curves, 1, 1, generator=generator)
    phase = math.pi * torch.rand(curves, 1, 1, generator=generator)

    def sample(n: int) -> Points:
        x = 10 * torch.rand(curves, n, 1, generator=generator) - 5
        return x, amplitude * torch.sin(x - phase)

    return sample(demo), sample(valid)


def network() -> nn.Module:
    """Two hidden layers of 40 ReLU."""
    return nn.Sequential(nn.Linear(1, 40), nn.ReLU(), nn.Linear(40, 40), nn.ReLU(), nn.Linear(40, 1))


def error(model: nn.Module, params, data: Points) -> Tensor:
    """L(theta, D), the mean squared error."""
    return mse_loss(forward(model, params, data[0]), data[1])


def train(model: nn.Module, meta_steps: int, generator: Generator) -> None:
    """Adam on Eq. 2, 25 curves a step, one inner step of 0.01; in place."""
    params, optimizer = parameters(model), torch.optim.Adam(model.parameters(), OUTER_LR)
    for _ in trange(meta_steps, disable=None):
        demo, valid = sinusoids(CURVES, generator)
        optimizer.zero_grad()
        meta_loss(params, partial(error, model), demo, valid, INNER_LR).backward()
        optimizer.step()


@torch.no_grad()
def errors_after(model: nn.Module, steps: list[int], curves: int = 600, seed: int = 2) -> dict[int, float]:
    """Mean squared error on 100 new points of unseen curves, by number of adaptation steps on ten points."""
    params, loss = parameters(model), partial(error, model)
    demo, valid = sinusoids(curves, Generator().manual_seed(seed), valid=100)
    errors = {}
    for count in steps:
        adapted = adapt_stacked(params, loss, demo, INNER_LR, count) if count else params.expand(curves)
        errors[count] = torch.vmap(loss)(adapted, valid).mean().item()
    return errors


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("meta_steps", type=int, nargs="?", default=10_000)
    meta_steps = parser.parse_args().meta_steps
    torch.manual_seed(0)
    torch.set_num_threads(1)
    model = network()
    train(model, meta_steps, Generator().manual_seed(1))
    for steps, mse in errors_after(model, [0, 1, 2, 5, 10]).items():
        print(f"after {steps:2d} steps: {mse:.2f}")


if __name__ == "__main__":
    main()
