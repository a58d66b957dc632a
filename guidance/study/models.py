"""The trained models of the guidances, and their files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.files import save_tensors, sha256
from airhockey_marl.experiment.validation import as_tensor, check_numbers
from airhockey_marl.league.league import League
from airhockey_marl.league.league import load_model as load_user_model
from airhockey_marl.players.networks import GaussianPolicy
from guidance.forces.conditions import OPTIMAL
from guidance.forces.lookahead import Lookahead, moved_state
from guidance.user_model.data import action_ahead
from guidance.user_model.maml import parameters
from guidance.user_model.training import adapt_to_user

SHIPPED = Path(__file__).parents[1] / "pretrained"  # user models, in a folder per predictor


def check_predictor(name: str) -> None:
    """Raise a ValueError if there are no shipped user models of this name."""
    there = sorted(file.parent.name for file in SHIPPED.glob("*/meta.safetensors"))
    if name not in there:
        raise ValueError(f"guidance.predictor = {name} must be one of {', '.join(there)}")


def save_user_model(path: Path | str, model: GaussianPolicy, facts: dict) -> None:
    """Write a user prediction model with its metadata `facts` (any JSON)."""
    save_tensors(path, model.state_dict(), {**facts, **model.architecture})


@dataclass(frozen=True)
class Models:
    """The models of the guidances.

    Attributes:
        optimal: the optimal action model (OAHG).
        user: the user prediction model for people in general (UPHG without UA).
        meta: the meta-learned user prediction model, adapted to a user by UA.
        inner_lr: alpha of Eq. 1, with which `meta` was trained.
        ahead: prediction horizon of `user` and `meta` in s; 0 in the paper.
        hashes: SHA-256 of the file of each.
        device: where they are evaluated, see `airhockey_marl.players.inference.make_inference`.
    """

    optimal: GaussianPolicy
    user: GaussianPolicy
    meta: GaussianPolicy
    inner_lr: float
    hashes: dict[str, str]
    ahead: float = 0.0
    device: str = "cpu"

    @classmethod
    def load(
        cls, league: Path | str, generation: int, user: Path | str, meta: Path | str, device: str = "cpu"
    ) -> "Models":
        """Read the models from their files.

        Raises:
            ValueError: a file is missing or broken, or the league has no such generation.
        """
        (user_model, user_facts), (meta_model, facts) = load_user_model(user), load_user_model(meta)
        if "inner_lr" not in facts:
            raise ValueError(f"{meta} was not meta-learned: it has no inner_lr")
        for path, known in ((meta, facts), (user, user_facts)):
            for name, most in (("inner_lr", 1e3), ("ahead_s", 1.0)):
                check_numbers(0.0, at_most=most, **{f"{path}: {name}": known.get(name, 0.0)})
        ahead = {facts.get("ahead_s", 0.0), user_facts.get("ahead_s", 0.0)}
        if len(ahead) > 1:
            raise ValueError(f"{user} and {meta} predict different times ahead, {sorted(ahead)} s")
        return cls(
            optimal=League.load(league).player(generation),
            user=user_model,
            meta=meta_model,
            inner_lr=facts["inner_lr"],
            ahead=ahead.pop(),
            hashes={"league": sha256(league), "user": sha256(user), "meta": sha256(meta)},
            device=device,
        )

    def adapted_to(self, demonstrations: Sequence[tuple[Tensor, Tensor]]) -> TensorDict:
        """User adaptation (UA, Eq. 1): `meta` after one step on each user's own game.

        Args:
            demonstrations: per user the observations (ticks, 12) and actions (ticks, 2) of a game of any length, as
                tensors, arrays or tables of finite numbers.

        Returns:
            The adapted parameters, batch size (users,).
        """
        theta, table, adapted = parameters(self.meta), TableSpec(), []
        for user, (observation, action) in enumerate(demonstrations):
            x = as_tensor(f"demonstrations[{user}]: observation", observation, 12, finite=True)
            y = as_tensor(f"demonstrations[{user}]: action", action, 2, finite=True)
            then = action_ahead(x, y, self.ahead, table)
            adapted.append(adapt_to_user(self.meta, theta, x[None], then[None], self.inner_lr))
        return torch.cat(adapted)

    def horizon(self, model: str) -> float:
        """Seconds from a state to the action that a model predicts for it."""
        return 0.0 if model == OPTIMAL else self.ahead

    def lookahead_state(self, model: str, state: Tensor, lookahead: Lookahead) -> Tensor:
        """The looked-ahead state (..., 12) of Eq. 4 for one of the models, less the model's own horizon."""
        return moved_state(state, max(lookahead.seconds - self.horizon(model), 0.0), lookahead.reading)

    def target(self, model: str, hand: Tensor, mean: Tensor, state: Tensor, lookahead: Lookahead) -> Tensor:
        """The target of the spring toward a model's output, see `Lookahead.target`.

        Its moment is the state's and the model's own horizon: T_lookahead, or the horizon if that is longer.
        """
        return lookahead.target(hand, mean, state, max(lookahead.seconds, self.horizon(model)))
