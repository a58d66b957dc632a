"""The forces of many conditions and many users at once."""

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from airhockey_marl.experiment.validation import check_counts, check_rows, kind_of
from airhockey_marl.players.inference import make_inference
from guidance.forces.conditions import (
    ADAPTED,
    OPTIMAL,
    USER,
    CombinedGuidance,
    Condition,
    Guidance,
    GuidanceOutput,
    Prediction,
    SpringGuidance,
)
from guidance.study.models import Models

MODELS = (OPTIMAL, USER, ADAPTED)


class BatchedGuidance:
    """Answers for the games of several conditions and the same users, one game per condition and user.

    Games are ordered condition by condition: game c * users + u is user u's under condition c. Each is answered alike
    whichever others are asked about with it, to the last bit.

    Args:
        conditions: what to evaluate.
        users: how many there are.
        models: see `Models`.
        adapted: the users' own parameters, batch size (users,), or None if no condition has UA.
        lookahead_seconds: T_lookahead of Eq. 4.

    Raises:
        ValueError: a condition has UA and nobody's parameters are given, or the look-ahead is negative.
    """

    def __init__(
        self,
        conditions: Sequence[Condition],
        users: int,
        models: Models,
        adapted: TensorDict | None,
        lookahead_seconds: float,
    ) -> None:
        if not 0 <= lookahead_seconds < float("inf"):
            raise ValueError(f"guidance.lookahead = {lookahead_seconds} must be at least 0 seconds")
        check_counts(users=users)
        self.conditions, self.users, self.models = list(conditions), users, models
        self.lookahead_seconds = lookahead_seconds
        asked = frozenset().union(*(condition.guidance.models() for condition in conditions))
        if ADAPTED in asked and (adapted is None or adapted.batch_size != (users,)):
            raise ValueError(f"adapted: needs the parameters of each of the {users} users")
        on = models.device
        self._rows = {OPTIMAL: make_inference(models.optimal, device=on), USER: make_inference(models.user, device=on)}
        if adapted is not None:
            self._rows[ADAPTED] = make_inference(models.meta, adapted.flatten_keys(".").to_dict(), on)
        self._everything = np.arange(len(self.conditions) * users)
        self._plan = Plan(self.conditions, users, self._everything)

    @torch.no_grad()
    def __call__(self, state: np.ndarray, action: np.ndarray, games: np.ndarray | None = None) -> GuidanceOutput:
        """Force and weights for states (n, 12) in m and m/s and actions (n, 2), n = conditions x users.

        Args:
            games: (k,) int64, ascending: those to answer for, all of them if None.

        Returns:
            `GuidanceOutput` of float64 tensors: force (k, 2); weights (k,), not a number where a game has none.
        """
        for name, value, columns in (("state", state, 12), ("action", action, 2)):
            if np.shape(value) != (len(self._everything), columns) or value.dtype.kind != "f":
                shape = (len(self._everything), columns)
                raise ValueError(f"{name}: {kind_of(value)}, must be an array of floats of shape {shape}")
        games = self._everything if games is None else games
        if games is not self._plan.games and not np.array_equal(games, self._plan.games):
            check_rows("games", games, len(self._everything))
            if (np.diff(games) <= 0).any():
                raise ValueError(f"games: {games.tolist()}, must be ascending")
            self._plan = Plan(self.conditions, self.users, games)
        plan = self._plan
        hand, now = torch.from_numpy(action[games]).float(), torch.from_numpy(state[games]).float()
        targets = self._targets(now)

        pulls = [
            toward.pull(hand[rows], Prediction(targets.mean[asked], targets.std[asked]))
            for toward, rows, asked in plan.pulls
        ]
        answer = GuidanceOutput(torch.zeros(len(games), 2), *torch.full((3, len(games)), torch.nan))
        if pulls:
            force = torch.cat([force for force, _ in pulls])
            weight = torch.cat([hand.new_full((len(f),), torch.nan) if w is None else w for f, w in pulls])
            answer.force[plan.alone] = force[plan.alone_by]
            answer.w_unc_optimal[plan.optimal] = weight[plan.optimal_by]
            answer.w_unc_user[plan.user] = weight[plan.user_by]
            for combined, rows, optimal, user in plan.joins:
                answer.force[rows], similarity = combined.join(force[optimal], force[user])
                if similarity is not None:
                    answer.w_sim[rows] = similarity
        for guidance, rows, asked in plan.others:
            said = {name: Prediction(targets.mean[index], targets.std[index]) for name, index in asked.items()}
            for whole, part in zip(answer, guidance(now[rows], hand[rows], said), strict=True):
                if part is not None:
                    whole[rows] = part.float()
        return GuidanceOutput(*(part.double() for part in answer))

    def _targets(self, state: Tensor) -> Prediction:
        """Mean and STD (asked, 2) that the models say, one after the other, at the states (k, 12), looked ahead."""
        mean, std = [torch.empty(0, 2)], [torch.empty(0, 2)]
        for name, (rows, users) in self._plan.asked.items():
            ahead = self.models.lookahead_state(name, state[rows], self.lookahead_seconds).numpy()
            said = self._rows[name](ahead, users if name == ADAPTED else None)
            mean.append(torch.from_numpy(said[0]))
            std.append(torch.from_numpy(said[1]))
        return Prediction(torch.cat(mean), torch.cat(std))


class Plan:
    """Who asks which model, and which forces are computed together, for certain games of a `BatchedGuidance`.

    Springs of one kind pull all the hands that hang on them in one call, whatever the condition and the model: small
    calls cost what large ones do. Any other guidance than `SpringGuidance` and `CombinedGuidance` is asked by itself.

    Attributes:
        games: (k,) those that are played; a row is a place in it.
        asked: per model the rows that ask it, and whose games they are. Answers are numbered on from model to model.
        pulls: per kind of spring one of its kind, the rows it pulls and the answers it pulls them to. These forces are
            numbered on from kind to kind.
        alone, alone_by: rows that feel one force, and which.
        joins: per kind of combination one of its kind, the rows, and the optimal and the user's force of each.
        optimal, optimal_by, user, user_by: rows that have a W_unc of either model, and the force that it weighs.
        others: guidances that are asked by themselves: the rows, and per model the answers.
    """

    def __init__(self, conditions: Sequence[Condition], users: int, games: np.ndarray) -> None:
        self.games = games
        edges = np.searchsorted(games, np.arange(len(conditions) + 1) * users)
        playing = [
            (condition.guidance, np.arange(first, last))
            for condition, first, last in zip(conditions, edges[:-1], edges[1:], strict=True)
            if last > first
        ]

        answers = _Numbered()
        self.asked = {}
        for name in MODELS:
            asking = [rows for guidance, rows in playing if name in guidance.models()]
            for rows in asking:
                answers.add((name, rows[0]), len(rows))
            if asking:
                rows = np.concatenate(asking)
                self.asked[name] = rows, games[rows] % users

        kinds: dict[tuple, dict[tuple[SpringGuidance, int], np.ndarray]] = {}
        for guidance, rows in playing:
            for part in _springs(guidance):
                kinds.setdefault((part.spring, part.uncertainty), {})[part, rows[0]] = rows
        forces = _Numbered()
        self.pulls, weighed = [], {True: [], False: []}
        for springs in kinds.values():
            pulling = []
            for (part, first), rows in springs.items():
                pulling.append((rows, answers[part.model, first]))
                weighed[part.model == OPTIMAL].append((rows, forces.add((part, first), len(rows))))
            self.pulls.append((next(iter(springs))[0], *_joined(pulling, 2)))
        self.optimal, self.optimal_by = _joined(weighed[True], 2)
        self.user, self.user_by = _joined(weighed[False], 2)

        alone, together, self.others = [], {}, []
        for guidance, rows in playing:
            if not _springs(guidance):
                asked = {name: torch.from_numpy(answers[name, rows[0]]) for name in guidance.models()}
                self.others.append((guidance, torch.from_numpy(rows), asked))
            elif type(guidance) is CombinedGuidance:
                both = (forces[part, rows[0]] for part in (guidance.optimal, guidance.user))
                together.setdefault(guidance.similarity, []).append((guidance, rows, *both))
            else:
                alone.append((rows, forces[guidance, rows[0]]))
        self.alone, self.alone_by = _joined(alone, 2)
        self.joins = [(first[0][0], *_joined([pair[1:] for pair in first], 3)) for first in together.values()]


def _springs(guidance: Guidance) -> tuple[SpringGuidance, ...]:
    """The springs a guidance is made of, if it is one of ours."""
    parts = (guidance.optimal, guidance.user) if type(guidance) is CombinedGuidance else (guidance,)
    return parts if all(type(part) is SpringGuidance for part in parts) else ()


class _Numbered(dict):
    """Things and the numbers they have, counted on from one to the next."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def add(self, key: object, many: int) -> np.ndarray:
        self[key] = np.arange(self.count, self.count + many)
        self.count += many
        return self[key]


def _joined(parts: Sequence[Sequence[np.ndarray]], columns: int) -> tuple[Tensor, ...]:
    columns = zip(*parts, strict=True) if parts else [[np.empty(0, dtype=np.int64)]] * columns
    return tuple(torch.from_numpy(np.concatenate(column)) for column in columns)
