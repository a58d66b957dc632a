"""The forces of many guidances and many users, evaluated in one call per tick."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.players.inference import make_inference
from guidance.forces.conditions import (
    ADAPTED,
    OPTIMAL,
    USER,
    CombinedGuidance,
    Guidance,
    GuidanceOutput,
    Prediction,
    SpringGuidance,
)
from guidance.forces.lookahead import Lookahead
from guidance.study.models import Models

MODELS = (OPTIMAL, USER, ADAPTED)


class BatchedGuidance:
    """The forces of one game per guidance and user.

    Game c * users + u is user u's under guidance c. The output for a game is bit-identical whichever other games are
    evaluated with it. Small tensor operations cost as much as large ones, so every model is evaluated once per tick
    for all games that need it, and every kind of spring once for all hands; any other guidance is called by itself.

    Args:
        guidances: (c,) the guidances, of conditions or others.
        users: number of users.
        models: see `Models`.
        adapted: the users' own parameters, batch size (users,), or None if no guidance has UA.
        lookahead: T_lookahead of Eq. 4 and its reading.
    """

    def __init__(
        self,
        guidances: Sequence[Guidance],
        users: int,
        models: Models,
        adapted: TensorDict | None,
        lookahead: Lookahead,
    ) -> None:
        self.guidances, self.users, self.models = list(guidances), users, models
        self.lookahead = lookahead
        self._all = np.arange(len(self.guidances) * users)
        self._queries = self._masks(lambda guidance: guidance.models())
        if ADAPTED in self._queries and (adapted is None or adapted.batch_size != (users,)):
            raise ValueError(f"adapted: needs the parameters of each of the {users} users")
        self._inference = {
            OPTIMAL: make_inference(models.optimal, device=models.device),
            USER: make_inference(models.user, device=models.device),
        }
        if adapted is not None:
            weights = adapted.flatten_keys(".").to_dict()
            self._inference[ADAPTED] = make_inference(models.meta, weights, models.device)
        self._springs = {}  # a spring of each kind -> mask (models, games) of the targets it pulls toward
        for part, mask in self._masks(springs_of).items():
            kind = replace(part, model=OPTIMAL)
            masks = self._springs.setdefault(kind, np.zeros((len(MODELS), len(mask)), dtype=bool))
            masks[MODELS.index(part.model)] = mask
        self._index_games(self._all)

    def _masks(self, keys_of: Callable[[Guidance], Iterable[Hashable]]) -> dict[Hashable, np.ndarray]:
        """The mask (games,) of the games whose guidance has a key, by key."""
        keys = [set(keys_of(guidance)) for guidance in self.guidances]
        return {
            key: np.repeat([key in own for own in keys], self.users) for key in sorted(set().union(*keys), key=repr)
        }

    def _index_games(self, games: np.ndarray) -> None:
        """Turn the masks into indices for these games, which change only when one is over, not in every tick.

        A row is a place in `games`, a target a place in (models, games).
        """
        self._games = games.copy()
        self._rows = {name: mask[games].nonzero()[0] for name, mask in self._queries.items()}
        targets = {spring: mask[:, games].ravel().nonzero()[0] for spring, mask in self._springs.items()}
        self._targets_of = {spring: torch.from_numpy(index) for spring, index in targets.items() if len(index)}
        edges = np.searchsorted(games, np.arange(len(self.guidances) + 1) * self.users)
        single, pairs, self._others = [], {}, []
        for guidance, first, last in zip(self.guidances, edges[:-1], edges[1:], strict=True):
            if first == last:
                continue
            rows = torch.arange(first, last)
            targets = [MODELS.index(part.model) * len(games) + rows for part in springs_of(guidance)]
            if len(targets) == 1:
                single.append(torch.stack([rows, *targets]))
            elif targets:
                pairs.setdefault(guidance.similarity, (guidance, []))[1].append(torch.stack([rows, *targets]))
            else:
                self._others.append((guidance, rows))
        self._single = torch.cat(single, dim=1) if single else torch.empty(2, 0, dtype=torch.int64)
        self._pairs = [(guidance, torch.cat(index, dim=1)) for guidance, index in pairs.values()]

    @torch.no_grad()
    def __call__(self, state: np.ndarray, action: np.ndarray, games: np.ndarray | None = None) -> GuidanceOutput:
        """Force and weights for states (n, 12) in m and m/s and actions (n, 2), n = guidances x users.

        Args:
            games: (k,) int64, ascending: the games to evaluate, all of them if None.

        Returns:
            `GuidanceOutput` of float64 tensors: force (k, 2); weights (k,), NaN where a guidance has none.
        """
        games = self._all if games is None else games
        if not np.array_equal(games, self._games):
            self._index_games(games)
        now, hand = (torch.from_numpy(value[games]).float() for value in (state, action))
        targets = self._predict(now, hand, games)
        force, weight = self._pull(hand, targets)
        w_optimal, w_user, w_adapted = weight.unflatten(0, (len(MODELS), -1))
        w_user = torch.where(w_user.isnan(), w_adapted, w_user)
        output = GuidanceOutput(torch.zeros(len(games), 2), w_optimal, w_user, torch.full((len(games),), torch.nan))
        rows, index = self._single
        output.force[rows] = force[index]
        for guidance, (rows, optimal, user) in self._pairs:
            output.force[rows], w_sim = guidance.join(force[optimal], force[user])
            if w_sim is not None:
                output.w_sim[rows] = w_sim
        for guidance, rows in self._others:
            predictions = {
                name: Prediction(*(part.unflatten(0, (len(MODELS), -1))[MODELS.index(name), rows] for part in targets))
                for name in guidance.models()
            }
            result = guidance(now[rows], hand[rows], predictions)
            for total, part in zip(output, result, strict=True):
                if part is not None:
                    total[rows] = part.float()
        return GuidanceOutput(*(part.double() for part in output))

    def _predict(self, state: Tensor, hand: Tensor, games: np.ndarray) -> Prediction:
        """Target and STD (targets, 2) for states (k, 12) and hands (k, 2); NaN where a game needs no such model."""
        mean, std = np.full((2, len(MODELS) * len(games), 2), np.nan, dtype=np.float32)
        ahead: dict[float, Tensor] = {}  # the looked-ahead states, by the horizon of the models
        for name, rows in self._rows.items():
            if len(rows):
                horizon = self.models.horizon(name)
                if horizon not in ahead:
                    ahead[horizon] = self.models.lookahead_state(name, state, self.lookahead)
                users = games[rows] % self.users if name == ADAPTED else None
                target = MODELS.index(name) * len(games) + rows
                output, std[target] = self._inference[name](ahead[horizon].numpy()[rows], users)
                mean[target] = self.models.target(
                    name, hand[rows], torch.from_numpy(output), state[rows], self.lookahead
                )
        return Prediction(torch.from_numpy(mean), torch.from_numpy(std))

    def _pull(self, hand: Tensor, targets: Prediction) -> tuple[Tensor, Tensor]:
        """Forces (targets, 2) of the springs toward the targets, and their W_unc (targets,); NaN where none."""
        mean, std = targets
        force, weight = torch.full_like(mean, torch.nan), torch.full((len(mean),), torch.nan)
        for spring, index in self._targets_of.items():
            force[index], w_unc = spring.pull(hand[index % len(hand)], Prediction(mean[index], std[index]))
            if w_unc is not None:
                weight[index] = w_unc
        return force, weight


def springs_of(guidance: Guidance) -> tuple[SpringGuidance, ...]:
    """The one spring of OAHG and UPHG, the two of CombHG; none of any other guidance."""
    parts = (guidance.optimal, guidance.user) if type(guidance) is CombinedGuidance else (guidance,)
    are_springs = all(type(part) is SpringGuidance for part in parts)
    return parts if are_springs and len({part.model for part in parts}) == len(parts) else ()
