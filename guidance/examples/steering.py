"""A second task for the same forces and the same meta-learning: following a point along a path (section 6.2).

    python -m guidance.examples.steering

The hand is to follow a moving point. The optimal action needs no learning here: it is the position of the point. Users
differ: they cut corners, run ahead or lag behind, and keep to one side. UPHG learns this from nine users with MAML
(Eq. 2) and adapts to each of twenty others with one gradient step on half a minute of play (Eq. 1). It is trained to
predict the hand .2 s ahead instead of being evaluated at a looked-ahead state, because in the short term every hand
follows its velocity. OAHG, UPHG and CombHG, with and without SC (Eq. 6, 7), push the hand with the spring of Eq. 4.
Prints the prediction error, the distance of the hand from the point, and the disagreement.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from functools import partial

import numpy as np
import torch
from torch import Generator, Tensor, nn

from guidance.forces.equations import combine, lookahead_state, similarity_weight, spring_force
from guidance.study.metrics import disagreement
from guidance.user_model.loss import prediction_loss
from guidance.user_model.maml import adapt_stacked, forward, forward_stacked, meta_loss, parameters

TICK, SUBSTEPS = 0.02, 10  # s, and steps of the arm in one
STIFFNESS, LIMIT, LOOKAHEAD = 40.0, 3.0, 0.1  # N/m, N, s: K T_lookahead is 0.8 of the least damping of a hand, 5 N s/m
AHEAD = 10  # prediction horizon of UPHG, ticks
INNER_LR, OUTER_LR, META_STEPS, BLOCK = 0.002, 0.002, 1500, 1000
TRAINING, PARTICIPANTS = 9, 20


class People:
    """n users, whose hands are pulled by a spring and a damper toward the intended position.

    Args:
        n: number of users.
        generator: of their parameters and noise.
    """

    def __init__(self, n: int, generator: Generator) -> None:
        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(n, *shape, generator=generator)

        self.generator = generator
        self.cut = uniform(0.6, 1.05, 2)  # share of the path's amplitude that they follow, per axis
        self.early = uniform(-0.12, 0.12, 1)  # s, lead over the point
        self.aside = uniform(-0.008, 0.008, 2)  # m
        self.arm = uniform(100.0, 250.0, 1), uniform(5.0, 12.0, 1)  # N/m, N s/m; the hand weighs 1 kg
        self.hand, self.velocity = torch.zeros(n, 2), torch.zeros(n, 2)

    def step(self, point: Tensor, force: Tensor) -> None:
        """Advance by a tick, given the points (n, 4) and forces (n, 2) in N."""
        intended = self.cut * (point[:, :2] + self.early * point[:, 2:]) + self.aside
        intended = intended + 0.003 * torch.randn(intended.shape, generator=self.generator)
        stiffness, damping = self.arm
        for _ in range(SUBSTEPS):
            pull = stiffness * (intended - self.hand) - damping * self.velocity + force
            self.velocity = self.velocity + TICK / SUBSTEPS * pull
            self.hand = self.hand + TICK / SUBSTEPS * self.velocity


def paths(n: int, ticks: int, generator: Generator) -> Tensor:
    """Points (ticks, n, 4) with position in m and velocity in m/s: sums of three slow sines per axis."""
    time = TICK * torch.arange(ticks)[:, None, None, None]
    speed = 0.5 + 2.0 * torch.rand(n, 2, 3, generator=generator)  # rad/s
    phase = 2 * torch.pi * torch.rand(n, 2, 3, generator=generator)
    size = 0.02  # m each
    place = size * torch.sin(speed * time + phase).sum(-1)
    velocity = size * (speed * torch.cos(speed * time + phase)).sum(-1)
    return torch.cat([place, velocity], dim=-1)


class UserModel(nn.Module):
    """Hand and point (..., 8) -> mean and STD (..., 2) of the future hand position, in m."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(8, 48), nn.ReLU(), nn.Linear(48, 48), nn.ReLU(), nn.Linear(48, 4))
        self.register_buffer("scale", torch.tensor([0.05, 0.05, 0.1, 0.1] * 2), persistent=False)

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        mean, spread = self.layers(state / self.scale).chunk(2, dim=-1)
        return 0.05 * mean, 0.05 * torch.sigmoid(spread)


def loss(model: nn.Module, params, data: tuple[Tensor, Tensor]) -> Tensor:
    """Eq. 3 in units of 5 cm, to have the magnitude it has in air hockey."""
    mean, std = forward(model, params, data[0])
    return prediction_loss(mean / 0.05, std / 0.05, data[1] / 0.05)


@torch.no_grad()
def play(people: People, path: Tensor, guidance=None) -> dict[str, Tensor]:
    """Follow the points (ticks, n, 4).

    Returns:
        `state` (n, ticks, 8) at the beginning of each tick but the last, and `action` (n, ticks, 2), the hand
        AHEAD ticks later; `error` (n,) m from the point, root mean square; `disagreement` (n,) N, mean.
    """
    people.hand, people.velocity = path[0, :, :2].clone(), torch.zeros_like(people.hand)
    states, actions, against = [], [], []
    for point in path:
        states.append(torch.cat([people.hand, people.velocity, point], dim=-1))
        force = torch.zeros_like(people.hand) if guidance is None else guidance(states[-1])
        before = people.hand
        people.step(point, force)
        actions.append(people.hand)
        against.append(torch.from_numpy(disagreement(force.numpy(), (people.hand - before).numpy())))
    state, action = torch.stack(states, 1), torch.stack(actions, 1)
    return {
        "state": state[:, : -AHEAD + 1],
        "action": action[:, AHEAD - 1 :],
        "error": (action - path[:, :, :2].transpose(0, 1)).square().sum(-1).mean(1).sqrt(),
        "disagreement": torch.stack(against, 1).mean(1),
    }


def meta_train(model: nn.Module, generator: Generator) -> None:
    """MAML on unguided play of nine users: D_demo is a block of one game, D_valid of another."""
    people = People(TRAINING, generator)
    games = [play(people, paths(TRAINING, 2 * BLOCK, generator)) for _ in range(4)]
    params, optimizer = parameters(model), torch.optim.Adam(model.parameters(), OUTER_LR)
    for _ in range(META_STEPS):
        one, other = torch.randperm(len(games), generator=generator)[:2]
        first = int(torch.randint(BLOCK, (1,), generator=generator))
        demo, valid = (
            (games[game]["state"][:, first : first + BLOCK], games[game]["action"][:, first : first + BLOCK])
            for game in (one, other)
        )
        optimizer.zero_grad()
        meta_loss(params, partial(loss, model), demo, valid, INNER_LR).backward()
        nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()


def guidances(model: nn.Module, adapted) -> dict:
    """The guidances by name: states (n, 8) -> forces (n, 2)."""

    def oahg(state: Tensor) -> Tensor:  # toward the looked-ahead point
        return spring_force(state[:, :2], lookahead_state(state, LOOKAHEAD)[:, 4:6], STIFFNESS, LIMIT)

    def uphg(state: Tensor) -> Tensor:  # toward the predicted hand
        mean, _ = forward_stacked(model, adapted, state[:, None])
        return spring_force(state[:, :2], mean[:, 0], STIFFNESS, LIMIT)

    def combhg(state: Tensor) -> Tensor:
        return combine(oahg(state), uphg(state))

    def combhg_sc(state: Tensor) -> Tensor:
        one, other = oahg(state), uphg(state)
        return similarity_weight(one, other)[:, None] * combine(one, other)

    return {"NHG": None, "OAHG": oahg, "UPHG (UA)": uphg, "CombHG (UA)": combhg, "CombHG (UA+SC)": combhg_sc}


@torch.no_grad()
def prediction_errors(model: nn.Module, adapted, game: dict[str, Tensor]) -> dict[str, float]:
    """Root mean square error in m in a new game: before UA, after UA, and after UA to another user."""

    def error(mean: Tensor) -> float:
        return (mean - game["action"]).square().sum(-1).mean().sqrt().item()

    own = forward_stacked(model, adapted, game["state"])[0]
    neighbors = forward_stacked(model, adapted[torch.arange(len(adapted)) - 1], game["state"])[0]
    return {"before UA": error(model(game["state"])[0]), "after": error(own), "somebody else's": error(neighbors)}


def run(seed: int = 0, seconds: float = 60.0) -> tuple[dict[str, float], dict[str, dict[str, np.ndarray]]]:
    """Train, adapt to twenty users, and play a game under each guidance.

    Returns:
        Errors of the model, see `prediction_errors`; and per guidance `error` and `disagreement` (people,).
    """
    generator = Generator().manual_seed(seed)
    torch.manual_seed(seed)
    model = UserModel()
    meta_train(model, generator)
    people = People(PARTICIPANTS, generator)
    demo = play(people, paths(PARTICIPANTS, 1500, generator))
    with torch.no_grad():
        data = demo["state"], demo["action"]
        adapted = adapt_stacked(parameters(model), partial(loss, model), data, INNER_LR)
    path = paths(PARTICIPANTS, round(seconds / TICK), generator)
    games = {name: play(people, path, guidance) for name, guidance in guidances(model, adapted).items()}
    measures = {name: {key: game[key].numpy() for key in ("error", "disagreement")} for name, game in games.items()}
    return prediction_errors(model, adapted, games["NHG"]), measures


def main() -> None:
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    predicted, games = run()
    print("error of the model, mm:", ", ".join(f"{name} {1000 * error:.2f}" for name, error in predicted.items()))
    print(f"\n{'':16}{'error, mm':>12}{'disagreement, N':>18}")
    for name, game in games.items():
        print(f"{name:16}{1000 * game['error'].mean():>12.1f}{game['disagreement'].mean():>18.3f}")


if __name__ == "__main__":
    main()
