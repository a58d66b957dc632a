"""A second task for the same forces and the same meta-learning: following a point along a path (section 6.2).

    python -m guidance.examples.steering

A point wanders over the desk and the hand is to stay with it. The optimal action needs no learning here: it is the
point's own place (a fixed reference). People have their ways, though: they cut corners, run ahead or lag behind, and
keep to one side. UPHG learns those from nine of them with MAML (Eq. 2) and adapts to each of twenty others with one
gradient step on half a minute of play (Eq. 1). It is taught where the hand will be in .2 s, rather than asked about a
looked-ahead state: at once a hand is where its velocity takes it, whosever it is. OAHG, UPHG and both, with and without
SC (Eq. 6, 7), push the hand with the spring of Eq. 4. Prints how well people are predicted, how far from the point the
hand is, and how much the force is against the hand's own motion.
"""

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
AHEAD = 10  # ticks after the state, at which UPHG predicts the hand
INNER_LR, OUTER_LR, META_STEPS, BLOCK = 0.002, 0.002, 1500, 1000
TRAINING, PARTICIPANTS = 9, 20


class People:
    """n people with a hand at the desk: a spring and a damper toward where they want it to be.

    Args:
        n: how many.
        generator: draws who they are, and their noise.
    """

    def __init__(self, n: int, generator: Generator) -> None:
        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(n, *shape, generator=generator)

        self.generator = generator
        self.cut = uniform(0.6, 1.05, 2)  # share of the path's size that they follow, per axis
        self.early = uniform(-0.12, 0.12, 1)  # s that they run ahead
        self.aside = uniform(-0.008, 0.008, 2)  # m
        self.arm = uniform(100.0, 250.0, 1), uniform(5.0, 12.0, 1)  # N/m, N s/m; the hand weighs 1 kg
        self.hand, self.velocity = torch.zeros(n, 2), torch.zeros(n, 2)

    def step(self, point: Tensor, force: Tensor) -> None:
        """A tick: see the point (n, 4), feel the force (n, 2) in N, move the hand."""
        wanted = self.cut * (point[:, :2] + self.early * point[:, 2:]) + self.aside
        wanted = wanted + 0.003 * torch.randn(wanted.shape, generator=self.generator)
        stiffness, damping = self.arm
        for _ in range(SUBSTEPS):
            pull = stiffness * (wanted - self.hand) - damping * self.velocity + force
            self.velocity = self.velocity + TICK / SUBSTEPS * pull
            self.hand = self.hand + TICK / SUBSTEPS * self.velocity


def paths(n: int, ticks: int, generator: Generator) -> Tensor:
    """Points (ticks, n, 4) with place in m and velocity in m/s: sums of three slow sines per axis."""
    time = TICK * torch.arange(ticks)[:, None, None, None]
    speed = 0.5 + 2.0 * torch.rand(n, 2, 3, generator=generator)  # rad/s
    phase = 2 * torch.pi * torch.rand(n, 2, 3, generator=generator)
    size = 0.02  # m each
    place = size * torch.sin(speed * time + phase).sum(-1)
    velocity = size * (speed * torch.cos(speed * time + phase)).sum(-1)
    return torch.cat([place, velocity], dim=-1)


class UserModel(nn.Module):
    """Hand and point (..., 8) -> mean and STD (..., 2) of where this person will have the hand, in m."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(8, 48), nn.ReLU(), nn.Linear(48, 48), nn.ReLU(), nn.Linear(48, 4))
        self.register_buffer("scale", torch.tensor([0.05, 0.05, 0.1, 0.1] * 2), persistent=False)

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        mean, spread = self.layers(state / self.scale).chunk(2, dim=-1)
        return 0.05 * mean, 0.05 * torch.sigmoid(spread)


def loss(model: nn.Module, params, data: tuple[Tensor, Tensor]) -> Tensor:
    """Eq. 3, in units of 5 cm: so it is of the size it has in air hockey."""
    mean, std = forward(model, params, data[0])
    return prediction_loss(mean / 0.05, std / 0.05, data[1] / 0.05)


@torch.no_grad()
def play(people: People, path: Tensor, guidance=None) -> dict[str, Tensor]:
    """Let people follow their points (ticks, n, 4).

    Returns:
        `state` (n, ticks, 8) at the beginning of each tick but the last, and `action` (n, ticks, 2), where the hand is
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
    """MAML on what nine people do without guidance: D_demo is a block of one game, D_valid of another."""
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

    def oahg(state: Tensor) -> Tensor:  # toward where the point will be
        return spring_force(state[:, :2], lookahead_state(state, LOOKAHEAD)[:, 4:6], STIFFNESS, LIMIT)

    def uphg(state: Tensor) -> Tensor:  # toward where this person will have the hand
        mean, _ = forward_stacked(model, adapted, state[:, None])
        return spring_force(state[:, :2], mean[:, 0], STIFFNESS, LIMIT)

    def both(state: Tensor) -> Tensor:
        return combine(oahg(state), uphg(state))

    def similar(state: Tensor) -> Tensor:
        one, other = oahg(state), uphg(state)
        return similarity_weight(one, other)[:, None] * combine(one, other)

    return {"NHG": None, "OAHG": oahg, "UPHG (UA)": uphg, "CombHG (UA)": both, "CombHG (UA+SC)": similar}


@torch.no_grad()
def prediction_errors(model: nn.Module, adapted, game: dict[str, Tensor]) -> dict[str, float]:
    """Root mean square error in m of the model before UA, after, and after UA to the neighbor, in a new game."""

    def error(mean: Tensor) -> float:
        return (mean - game["action"]).square().sum(-1).mean().sqrt().item()

    said = forward_stacked(model, adapted, game["state"])[0]
    neighbors = forward_stacked(model, adapted[torch.arange(len(adapted)) - 1], game["state"])[0]
    return {"before UA": error(model(game["state"])[0]), "after": error(said), "somebody else's": error(neighbors)}


def run(seed: int = 0, seconds: float = 60.0) -> tuple[dict[str, float], dict[str, dict[str, np.ndarray]]]:
    """Train, adapt, and let twenty people play a game under each guidance.

    Returns:
        How well they are predicted, see `prediction_errors`; and per guidance `error` and `disagreement` (people,).
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
    found = {name: play(people, path, guidance) for name, guidance in guidances(model, adapted).items()}
    measures = {name: {key: game[key].numpy() for key in ("error", "disagreement")} for name, game in found.items()}
    return prediction_errors(model, adapted, found["NHG"]), measures


def main() -> None:
    torch.set_num_threads(1)
    predicted, games = run()
    print("error of the model, mm:", ", ".join(f"{name} {1000 * error:.2f}" for name, error in predicted.items()))
    print(f"\n{'':16}{'error, mm':>12}{'disagreement, N':>18}")
    for name, game in games.items():
        print(f"{name:16}{1000 * game['error'].mean():>12.1f}{game['disagreement'].mean():>18.3f}")


if __name__ == "__main__":
    main()
