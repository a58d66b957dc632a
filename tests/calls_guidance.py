"""A sound call of every public function of `guidance` that takes tensors or numbers; see `tests.calls`."""

import copy

import numpy as np
import torch

from airhockey_marl import inference
from guidance import (
    conditions,
    dataset,
    demonstrations,
    forces,
    games,
    guide,
    histograms,
    maml,
    metrics,
    models,
    prediction,
    rounds,
    sensitivity,
    stats,
    study,
    styles,
    ticks,
    user_model,
)
from guidance.users import anchors as rods
from guidance.users import laboratory, people, rating, sampling
from guidance.users.intention import Intention
from guidance.users.mentors import NO_MENTORS
from tests.calls_world import ACTION, POLICY, SEEN, STD, TABLE

REST = inference.steady(POLICY)
PEOPLE, STREAMS = sampling.sample_people(2, 0), sampling.personal_streams(2, 0)
WHO = {"table": TABLE, "variant": "V1", "mentors": NO_MENTORS}
USERS = people.Users(PEOPLE, STREAMS)
RINK = games.Rink(USERS, REST, TABLE, STREAMS)
PROTOCOL = {"familiarisation": 0.1, "rounds": 1, "extra_rounds": 0, "min_seconds": 0.0, "round_seconds": 0.1}
SPRING = {"stiffness": 50.0, "limit": 3.0, "reach": 0.075}
MODELS = models.Models(POLICY, POLICY, POLICY, 0.1, {})
TOWARD = conditions.Toward("optimal", conditions.Spring(**SPRING), conditions.Thresholds(0.1, 0.2))
OAHG = conditions.Condition("oahg_ut", "c", "OAHG (UT)", TOWARD)
COMBINED = conditions.Combined(TOWARD, TOWARD, True)
BOTH = {"optimal": conditions.Target(ACTION, STD), "user": conditions.Target(ACTION, STD)}
GUIDE = guide.Guide([OAHG], 2, MODELS, None, 0.1)
STATE, HAND, ALL = np.zeros((2, 12)), np.zeros((2, 2)), np.arange(2)
THETA, PAIR, LOSS = maml.parameters(POLICY), torch.zeros(2, 5), lambda theta, data: theta["head", "bias"].sum()
DEMO = user_model.Demonstrations(torch.randn(2, 2, 5, 12), torch.randn(2, 2, 5, 2))
SHARED = {"observation": DEMO.observation[0], "action": DEMO.action[0]}
GAME, DONE = torch.randn(40, 12), torch.randn(40, 2)
STILL = prediction.persistence(GAME, DONE, TABLE)
PLAY = np.random.default_rng(0).normal(size=(12, 10))
MARKS, FELT = laboratory.resting_marks((2, 1), 12), np.zeros((2, 1, 12, 2))
REACHES = laboratory.Reaches(
    laboratory.Record(np.zeros((2, 1, 12, 2)), np.ones((2, 1, 12, 2)), np.zeros((2, 1, 12, 2)), np.zeros((2, 1, 12))),
    *(np.zeros((2, 1), int), np.ones((2, 1)), np.zeros((2, 1, 12))),
)


LEARNER = maml.MAML(POLICY, 0.1)


def still(state: np.ndarray) -> np.ndarray:
    return np.zeros((len(state), 2))


CALLS = [
    # the equations
    (forces.lookahead, {"state": SEEN, "seconds": 0.1}),
    (forces.spring_force, {"position": ACTION, "target": ACTION, "stiffness": 50.0, "limit": 3.0}),
    (forces.uncertainty_weight, {"std": STD, "low": 0.1, "high": 0.2}),
    (forces.combine, {"optimal": ACTION, "user": ACTION}),
    (forces.similarity_weight, {"first": ACTION, "second": ACTION}),
    (maml.adapt, {"params": THETA, "loss": lambda theta: LOSS(theta, None), "lr": 0.1, "steps": 1}),
    (maml.adapt_each, {"params": THETA, "loss": LOSS, "demo": (PAIR,), "lr": 0.1, "steps": 1}),
    (maml.meta_loss, {"params": THETA, "loss": LOSS, "demo": (PAIR,), "valid": (PAIR,), "lr": 0.1, "steps": 1}),
    (maml.MAML, {"model": POLICY, "lr": 0.1}),
    (LEARNER.adapt, {"loss": LEARNER(SEEN)[0].sum()}),
    (user_model.Demonstrations, {"observation": DEMO.observation, "action": DEMO.action}),
    (DEMO.batches, {"size": 2}),
    (DEMO.pairs, {"block": 2}),
    (user_model.prediction_loss, {"mean": ACTION, "std": STD, "action": ACTION}),
    (
        user_model.train_supervised,
        {"model": copy.deepcopy(POLICY), "data": DEMO, "epochs": 1, "batch_size": 9, "lr": 0.01, "done": 0},
    ),
    (
        user_model.train_maml,
        {
            **{"model": copy.deepcopy(POLICY), "data": DEMO, "epochs": 1, "block": 2, "inner_lr": 0.01, "lr": 0.01},
            **{"steps": 1, "max_norm": 1.0, "done": 0},
        },
    ),
    (user_model.adapt_to_user, {"model": POLICY, "params": THETA, **SHARED, "lr": 0.1, "steps": 1}),
    # the conditions
    (conditions.Spring, SPRING),
    (TOWARD.spring.force, {"action": ACTION, "target": ACTION}),
    (conditions.Thresholds, {"low": 0.1, "high": 0.2}),
    (TOWARD.__call__, {"action": ACTION, "targets": BOTH}),
    (TOWARD.pull, {"action": ACTION, "target": BOTH["user"]}),
    (COMBINED.__call__, {"action": ACTION, "targets": BOTH}),
    (COMBINED.join, {"optimal": ACTION, "user": ACTION}),
    (conditions.Product("optimal", "user", TOWARD.spring).__call__, {"action": ACTION, "targets": BOTH}),
    (conditions.Blended(TOWARD, TOWARD).__call__, {"action": ACTION, "targets": BOTH}),
    (ticks.Overheard(TOWARD, frozenset()).__call__, {"action": ACTION, "targets": BOTH}),
    (MODELS.anticipated, {"model": "optimal", "state": SEEN, "seconds": 0.1}),
    (guide.Guide, {"conditions": [OAHG], "users": 2, "models": MODELS, "adapted": None, "lookahead_seconds": 0.1}),
    (GUIDE.__call__, {"state": STATE, "action": HAND, "games": ALL}),
    (ticks.overheard_guide, {"condition": OAHG, "models": MODELS, "adapted": None, "lookahead_seconds": 0.1}),
    (histograms.Histograms, {"conditions": [OAHG], "users": 2, "largest_force": 3.0}),
    (histograms.Histograms([OAHG], 2, 3.0).add, {"guided": GUIDE(STATE, HAND), "games": ALL}),
    # games and studies
    (games.Protocol, PROTOCOL),
    (games.Rink, {"participants": USERS, "opponent": REST, "table": TABLE, "serves": STREAMS}),
    (RINK.new_rounds, {"which": np.ones(2, bool)}),
    (RINK.tick, {"games": ALL}),
    (games.Schedule, {"n": 2, "protocol": games.Protocol(**PROTOCOL), "tick_seconds": 0.02}),
    (games.Schedule(2, games.Protocol(**PROTOCOL), 0.02).tick, {"goals": np.zeros(2, np.int64)}),
    (games.streams, {"seed": 0, "users": [0], "condition": 0, "purpose": 0}),
    (
        games.play_games,
        {
            **{"participants": USERS, "opponent": REST, "forces": games.no_force, "table": TABLE, "serves": STREAMS},
            "protocol": games.Protocol(**PROTOCOL),
        },
    ),
    (demonstrations.collect, {"people": PEOPLE, "opponent": REST, "games": 1, "ticks": 2, "seed": 0, **WHO}),
    (dataset.people_table, {"people": PEOPLE, "archetypes": [str(number) for number in range(9)]}),
    (metrics.new_sheets, {"n": 2}),
    (metrics.disagreement, {"force": np.ones((2, 2)), "action_change": np.ones((2, 2))}),
    (metrics.results, {"sheets": metrics.new_sheets(2)}),
    (metrics.Moments, {"n": 2}),
    (metrics.Moments(2).add, {"games": ALL, "values": np.ones(2)}),
    (stats.reference_points, {"n": 20}),
    (study.williams, {"conditions": 3}),
    (study.balanced, {"users": 6, "conditions": 3}),
    (study.order_of, {"users": 6, "conditions": 3, "seed": 0}),
    (sensitivity.latin_hypercube, {"parameters": ["x"], "points": 3, "largest": 1.5, "seed": 0}),
    # what is made of play
    (rounds.round_begins, {"observation": GAME, "table": TABLE}),
    (rounds.hand_speed, {"observation": GAME, "action": DONE, "table": TABLE}),
    (rounds.action_ahead, {"observation": GAME, "action": DONE, "seconds": 0.1, "table": TABLE}),
    (prediction.paddle, {"observation": GAME, "table": TABLE}),
    (prediction.persistence, {"observation": GAME, "action": DONE, "table": TABLE}),
    (prediction.extrapolation, {"observation": GAME, "action": DONE, "table": TABLE}),
    (prediction.ahead, {"observation": GAME, "seconds": 0.1, "table": TABLE}),
    (prediction.by_model, {"model": POLICY, "ahead": 0.1}),
    (
        prediction.predictors,
        {"user": POLICY, "meta": POLICY, "lr": 0.1, "seen": GAME, "action": DONE, "table": TABLE, "ahead": 0.1},
    ),
    (prediction.judge, {"predictor": STILL, "observation": GAME, "action": DONE, "seconds": 0.1, "table": TABLE}),
    (prediction.reliability, {"predictor": STILL, "observation": GAME, "action": DONE, "bins": 2}),
    (prediction.interval, {"values": np.ones(3), "confidence": 0.9}),
    (styles.blows, {"observation": GAME.numpy(), "table": TABLE}),
    (styles.features, {"observation": GAME[None], "table": TABLE}),
    (styles.told_apart, {"known": PLAY, "styles": np.arange(12) % 2, "unseen": PLAY}),
    (styles.recognised, {"one": PLAY, "another": PLAY + 0.01 * PLAY[::-1]}),
    # simulated people
    (sampling.sample_people, {"n": 2, "seed": 0}),
    (sampling.training_people, {"seed": 0}),
    (sampling.personal_streams, {"n": 2, "seed": 0}),
    (people.Users, {"people": PEOPLE, "streams": STREAMS}),
    (USERS.new_round, {"which": np.ones(2, bool)}),
    (USERS.new_game, {"which": np.ones(2, bool)}),
    (USERS.step, {"state": STATE, "force": HAND, "rows": ALL}),
    (rating.signals, {"tallies": np.zeros(2, rating.TALLY)}),
    (rating.appraisals, {"scaled": np.ones((2, 8))}),
    (rating.answers, {"people": PEOPLE, "z": np.ones((2, 4)), "streams": STREAMS}),
    (rods.play_anchor, {"people": PEOPLE, "opponent": still, "anchor": "oracle", "seconds": 0.1, "seed": 0}),
    (
        rods.play_pushed,
        {"people": PEOPLE, "opponent": still, "push": lambda users, tick: HAND, "ticks": 2, "seed": 0, **WHO},
    ),
    (laboratory.observe, {"people": PEOPLE, "task": Intention.REACH, "marks": MARKS, "force": FELT, "seed": 0}),
    (laboratory.marks_at, {"places": np.zeros((2, 3, 2)), "since": np.zeros((2, 3)), "ticks": 4}),
    (laboratory.resting_marks, {"shape": (2, 1), "ticks": 4}),
    (laboratory.onset, {"speed": np.ones((2, 4)), "start": np.zeros(2, int)}),
    (laboratory.reaction_times, {"people": PEOPLE, "trials": 1, "seed": 0}),
    (laboratory.reaches, {"people": PEOPLE, "trials": 1, "seed": 0}),
    (REACHES.movement_time, {"width": 0.01}),
    (laboratory.timing_errors, {"people": PEOPLE, "trials": 1, "seed": 0}),
    (laboratory.mechanics, {"people": PEOPLE, "trials": 1, "seconds": 1.5, "seed": 0}),
    (laboratory.push_response, {"people": PEOPLE, "newtons": 1.0, "seconds": 0.1, "seed": 0}),
]
