"""Arrays of one's own, in whatever form they come: converted, or refused in one line that names the argument."""

import re
from math import inf, nan

import numpy as np
import pandas as pd
import pytest
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.envs.world import World
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import make_inference
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import greedy
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
from guidance.forces.equations import combine, lookahead_state, similarity_weight, spring_force, uncertainty_weight
from guidance.study.models import Models
from guidance.user_model.data import Demonstrations, Recordings, action_ahead, round_starts
from guidance.user_model.evaluation import model_predictor, prediction_metrics
from guidance.user_model.loss import prediction_loss
from guidance.user_model.maml import adapt_stacked, forward, forward_stacked, meta_loss, parameters
from guidance.user_model.training import adapt_to_user, train_maml, train_supervised

torch.manual_seed(0)
POLICY, TABLE = GaussianPolicy([8]), TableSpec()
THETA, LEAGUE, INFER = parameters(POLICY), League(POLICY), make_inference(POLICY)
LEAGUE.add(POLICY)
MODELS = Models(POLICY, POLICY, POLICY, 0.1, {}, ahead=0.04)
TWO_MODELS = {name: torch.stack([tensor, tensor]) for name, tensor in POLICY.named_parameters()}
ADAPTED = MODELS.adapted_to([(torch.zeros(9, 12), torch.zeros(9, 2))] * 2)


def loss(theta, data):
    return prediction_loss(*forward(POLICY, theta, data[0]), data[1])


def train(trainer, data):
    torch.manual_seed(0)
    options = {"block": 10} if trainer is train_maml else {}
    return next(trainer(GaussianPolicy([4]), data, **options))["loss"]


CALLS = {  # of arrays of the shapes that the function makes
    "policy": lambda f: POLICY(f(5, 12)),
    "stacked policy": lambda f: POLICY.forward_stacked(TWO_MODELS, f(2, 5, 12)),
    "opponents": lambda f: LEAGUE.opponent_batch([0, "striker"])(f(4, 12)),
    "player": lambda f: greedy(POLICY)(f(5, 12)),
    "script": lambda f: SCRIPTED_PLAYERS["striker"](f(5, 12)),
    "inference": lambda f: INFER(f(5, 12)),
    "world": lambda f: World(5).step(f(5, 2, 2)),
    "world's observation": lambda f: World(5).observe(0, f(5, 12)),
    "adapted_to": lambda f: MODELS.adapted_to([(f(30, 12), f(30, 2))])["head", "bias"],
    "adapt_to_user": lambda f: adapt_to_user(POLICY, THETA, f(2, 30, 12), f(2, 30, 2), 0.1)["head", "bias"],
    "forward": lambda f: forward(POLICY, THETA, f(5, 12)),
    "forward_stacked": lambda f: forward_stacked(POLICY, ADAPTED, f(2, 5, 12)),
    "adapt_stacked": lambda f: adapt_stacked(THETA, loss, (f(2, 5, 12), f(2, 5, 2)), 0.1)["head", "bias"],
    "meta_loss": lambda f: meta_loss(THETA, loss, (f(2, 5, 12), f(2, 5, 2)), (f(2, 5, 12), f(2, 5, 2)), 0.1),
    "prediction_loss": lambda f: prediction_loss(*POLICY(torch.ones(5, 12)), f(5, 2)),
    "train_maml": lambda f: train(train_maml, Demonstrations(f(2, 2, 30, 12), f(2, 2, 30, 2))),
    "train_supervised": lambda f: train(train_supervised, Demonstrations(f(2, 2, 30, 12), f(2, 2, 30, 2))),
    "recordings": lambda f: train(train_maml, Recordings({"p1": [(f(30, 12), f(30, 2)), (f(30, 12), f(30, 2))]})),
    "round_starts": lambda f: round_starts(f(5, 12), TABLE),
    "action_ahead": lambda f: action_ahead(f(5, 12), f(5, 2), 0.04, TABLE),
    "prediction_metrics": lambda f: prediction_metrics(model_predictor(POLICY), f(30, 12), f(30, 2), 0.1, TABLE),
    "lookahead_state": lambda f: lookahead_state(f(5, 12), 0.1),
    "spring_force": lambda f: spring_force(f(5, 2), f(5, 2), 1.0, 1.0),
    "uncertainty_weight": lambda f: uncertainty_weight(f(5, 2), 0.1, 0.2),
    "combine": lambda f: combine(f(5, 2), f(5, 2)),
    "similarity_weight": lambda f: similarity_weight(f(5, 2), f(5, 2)),
}


def numbers(*shape: int) -> np.ndarray:
    """Whole numbers, which every kind can hold."""
    return np.random.default_rng(0).integers(0, 2, shape)


KINDS = {
    **{str(dtype)[6:]: lambda *s, t=dtype: torch.tensor(numbers(*s)).to(t) for dtype in (torch.float64, torch.int64)},
    **{f"numpy {kind}": lambda *s, k=kind: numbers(*s).astype(k) for kind in ("f2", "f4", "f8", ">f8", "g", "i8")},
    "pandas": lambda *s: pd.DataFrame(numbers(*s).astype(float)) if len(s) == 2 else numbers(*s).astype(float),
    "pandas Int64": lambda *s: pd.DataFrame(numbers(*s), dtype="Int64") if len(s) == 2 else numbers(*s),
    "list": lambda *s: numbers(*s).tolist(),
    "missing": lambda *s: np.where(numbers(*s) == 1, pd.NA, 0.5),
    "text": lambda *s: numbers(*s).astype(str),
    "ragged": lambda *s: [[1.0], *numbers(*s).tolist()],
}
NO_NUMBERS = {"missing", "text", "ragged"}
ARRAYS_ONLY = {"inference", "world", "world's observation"}  # compiled
TENSORS_ONLY = {"forward_stacked", "adapt_stacked", "meta_loss", "lookahead_state", "spring_force"}
TENSORS_ONLY |= {"uncertainty_weight", "combine", "similarity_weight"}
ARGUMENTS = "observation|actions?|out|inputs|demo|valid|state|position|std|optimal|first"
NAMED = rf"^(demonstrations\[0\]: |p1: )?({ARGUMENTS}): [^\n]+$"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("call", CALLS)
def test_own_arrays_are_converted_or_refused_by_name(call, kind):
    if kind in NO_NUMBERS or call in ARRAYS_ONLY | TENSORS_ONLY:
        try:
            CALLS[call](KINDS[kind])
        except ValueError as error:
            assert re.match(NAMED, str(error)), error
        else:
            assert kind not in NO_NUMBERS
    else:
        result, expected = CALLS[call](KINDS[kind]), CALLS[call](lambda *shape: torch.tensor(numbers(*shape)).float())
        torch.testing.assert_close(result, expected, check_dtype=False)


@pytest.mark.parametrize("value", [nan, inf])
def test_demonstrations_with_missing_values_are_refused(value):
    observation, action = np.zeros((1, 30, 12)), np.zeros((1, 30, 2))
    action[0, 3, 1] = value
    with pytest.raises(ValueError, match=r"^action: 1 values are not finite, all must be$"):
        adapt_to_user(POLICY, THETA, observation, action, 0.1)
    with pytest.raises(ValueError, match=r"^demonstrations\[0\]: action: 1 values are not finite, all must be$"):
        MODELS.adapted_to([(observation[0], action[0])])


def test_rounds_of_play_that_was_read_as_float64_start_where_they_did():
    """-0.487 m of float32 is another number of float64."""
    start = torch.tensor([-TABLE.length / 4, 0, 0, 0, TABLE.length / 4, 0, 0, 0, 0, 0.1, 0.5, 0.2])
    for observation in (start, start.double(), start.numpy().astype(float)):
        assert round_starts(observation, TABLE)
