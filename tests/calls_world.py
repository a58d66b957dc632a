"""A sound call of every public function of `airhockey_marl` that takes tensors or numbers; see `tests.calls`."""

from functools import partial

import numpy as np
import torch
from tensordict import TensorDict

from airhockey_marl import (
    anchors,
    collecting,
    defence,
    env,
    inference,
    league,
    match,
    policy,
    ppo,
    precision,
    ratings,
    render,
    sac,
    samplers,
    seats,
    selfplay,
    shaping,
    table,
    tables,
    trpo,
)

torch.manual_seed(0)
POLICY, TABLE = policy.GaussianPolicy([4]), table.Table()
SEEN, ACTION, VALUE = torch.randn(6, 12), torch.randn(6, 2), torch.randn(6, 1)
STD = torch.rand(6, 2) + 0.1
TWO = tables.Tables(2)
LEAGUE = league.League(POLICY)
LEAGUE.add(POLICY)
LEAGUE.add(POLICY)
REST = match.confident(POLICY)
FLAGS = torch.zeros(2, 3, 1, dtype=torch.bool)
NEXT = {"observation": torch.randn(2, 3, 12), "reward": torch.zeros(2, 3, 1), "done": FLAGS, "terminated": FLAGS}
VIEW = TensorDict(
    {"observation": torch.randn(2, 3, 12), "action": torch.randn(2, 3, 2), "next": TensorDict(NEXT, [2, 3])}, [2, 3]
)
TRPO = dict(
    **{"max_kl": 0.01, "cg_steps": 2, "damping": 0.1, "fisher_share": 1.0, "backtracks": 2, "shrink": 0.5},
    **{"gae_lambda": 0.9, "critic": partial(policy.Critic, [4]), "critic_passes": 1, "critic_minibatch": 2},
    critic_lr=0.01,
)
PPO = dict(
    **{"clip": 0.2, "epochs": 1, "minibatch": 2, "lr": 0.01, "entropy_coefficient": 0.0, "critic_coefficient": 0.5},
    **{"max_grad_norm": 1.0, "gae_lambda": 0.9, "critic": partial(policy.Critic, [4])},
)
SAC = dict(
    **{"capacity": 9, "updates": 1, "minibatch": 2, "policy_lr": 0.01, "q_lr": 0.01, "temperature_lr": 0.01},
    **{"tau": 0.1, "temperature": 0.1, "target_entropy": -2.0, "outside_cost": 1.0, "q_hidden": [4]},
)
LEARNER = trpo.TRPO(**TRPO).learner(POLICY, 0.9)
SHAPING = dict.fromkeys(("position", "velocity", "shot", "approach"), 0.1)
SHAPED = shaping.Shaping(**SHAPING)
POOL = selfplay.Pool(LEAGUE, [], samplers.Latest(), 0.5)
PLAYED = precision.record(POLICY, REST, tables=2, seconds=0.2, seed=0)
SCORE, WINS = np.array([[[0, 0, 1], [3, 1, 0]], [[1, 3, 0], [0, 0, 1]]]), np.array([[0.0, 3.0], [1.0, 0.0]])
MANY = {name: tensor.detach().unsqueeze(0) for name, tensor in POLICY.named_parameters()}
FORTH, SHARED = {"decision_ticks": 2, "round_seconds": 0.2}, {"tables_per_pair": 1, "decision_ticks": 25}


class Onlooker:
    """A learner that learns nothing."""

    def update(self, view: TensorDict) -> dict[str, float]:
        return {"seen": 1.0}

    def parts(self) -> dict:
        return {}


CREW = collecting.Crew(
    collecting.Collecting(), {"backend": "batched", "tables": 2, **FORTH}, seed=0, policy=POLICY, batch=4
)
CREW.begin(LEAGUE.lineup([0]))
LIVED = CREW.play(POLICY.state_dict()).clone()
PRACTICE = selfplay.Practice(CREW, POLICY, SHAPED, 0.9)

MEMORY = sac.Memory(9)
MEMORY.extend(VIEW)

CALLS = [
    # airhockey_marl: the world
    (tables.Tables, {"n": 2}),
    (TWO.seed, {"seed": 0}),
    (TWO.new_rounds, {"which": np.ones(2, bool)}),
    (TWO.step, {"actions": np.zeros((2, 2, 2)), "ticks": 1, "rows": np.arange(2)}),
    (TWO.observe, {"seat": 0, "out": np.zeros((2, 12))}),
    (env.steps_of, {"round_seconds": 1.0, "table": TABLE, "decision_ticks": 1}),
    (env.AirHockey, FORTH),
    (env.AirHockey().reset, {"seed": 0}),
    (env.AirHockeyTables, {"n": 2, "seed": 0, **FORTH}),
    (env.make_env, {"backend": "batched", "tables": 2, "seed": 0, **FORTH}),
    (render.draw_table, {"bodies": np.zeros((3, 4)), "table": TABLE, "width": 64}),
    # who plays
    (POLICY.forward, {"observation": SEEN}),
    (POLICY.inputs.forward, {"observation": SEEN}),
    (POLICY.forward_each, {"weights": MANY, "observation": SEEN[None]}),
    (policy.Critic([4]).forward, {"observation": SEEN}),
    (policy.relu_layers, {"inputs": 12, "hidden": [4]}),
    (inference.RowByRow(POLICY).__call__, {"observation": SEEN.numpy(), "which": np.zeros(6, np.int64)}),
    (inference.AllAtOnce(POLICY).__call__, {"observation": SEEN.numpy(), "which": np.zeros(6, np.int64)}),
    (anchors.ANCHORS["striker"].__call__, {"observation": SEEN}),
    (LEAGUE.generation, {"index": 0}),
    (LEAGUE.until, {"index": 0}),
    (LEAGUE.player, {"index": 0}),
    (LEAGUE.lineup([0, "striker"]).forward, {"observation": SEEN}),
    (LEAGUE.lineup([0, "striker"]).part, {"first": 1, "last": 3, "of": 4}),
    (seats.Sampling(POLICY).forward, {"observation": SEEN}),
    (seats.Seat(POLICY).forward, {"observation": SEEN}),
    (samplers.DeltaUniform, {"delta": 0.5}),
    (samplers.Curriculum, {"first": samplers.Latest(), "then": samplers.Latest(), "generation": 1}),
    # who wins
    (match.play_rounds, {"left": REST, "right": REST, "tables": 2, "rounds": 1, "seed": 0, **FORTH}),
    (match.play_matches, {"left": REST, "right": REST, "matches": 2, "tables": 1, "rounds": 1, "seed": 0, **FORTH}),
    (match.play_match, {"left": REST, "right": REST, "rounds": 2, "seed": 0, **FORTH}),
    (defence.defence, {"player": REST, "attacker": REST, "rounds": 2, "seed": 0, **FORTH}),
    (precision.record, {"policy": POLICY, "opponent": REST, "tables": 2, "seconds": 0.2, "seed": 0, **FORTH}),
    (precision.seconds_to_goal, {"observation": SEEN.numpy(), "table": TABLE}),
    (precision.precision, {"play": PLAYED, "seed": 0}),
    (precision.std_map, {"play": PLAYED, "toward": True, "least": 1}),
    (ratings.Share.of, {"successes": 1, "trials": 2}),
    (ratings.play_pairs, {"league": LEAGUE, "pairs": [(0, 1)], "rounds": 1, "seed": 0, **SHARED}),
    (ratings.payoff, {"league": LEAGUE, "members": [0, 1], "rounds": 1, "seed": 0, **SHARED}),
    (ratings.win_rates, {"score": SCORE}),
    (ratings.rate, {"wins": WINS, "reference": 0, "prior_rounds": 1.0}),
    (ratings.gains, {"members": [0, 1], "wins": WINS, "over": 0}),
    (ratings.misfit, {"wins": WINS, "rating": np.zeros(2)}),
    # who learns
    (trpo.conjugate_gradient, {"matvec": lambda x: x, "b": torch.ones(3), "steps": 2, "tolerance": 1e-9}),
    (trpo.log_prob, {"mean": ACTION, "std": STD, "action": ACTION}),
    (trpo.kl_divergence, {"mean": ACTION, "std": STD, "new_mean": ACTION, "new_std": STD}),
    (trpo.FisherVectorProduct, {"policy": POLICY, "observation": SEEN, "damping": 0.1}),
    (trpo.FisherVectorProduct(POLICY, SEEN, 0.1).__call__, {"vector": torch.ones(72)}),
    (trpo.advantages, {"critic": LEARNER.critic, "view": VIEW, "gamma": 0.9, "gae_lambda": 0.9}),
    (trpo.TRPO, TRPO),
    (trpo.TRPO(**TRPO).learner, {"policy": POLICY, "gamma": 0.9}),
    (trpo.TrustRegion, {"settings": trpo.TRPO(**TRPO), "policy": POLICY, "gamma": 0.9}),
    (LEARNER.improve_policy, {"observation": SEEN, "action": ACTION, "advantage": VALUE[:, 0]}),
    (LEARNER.fit_critic, {"observation": SEEN, "target": VALUE}),
    (ppo.PPO, PPO),
    (ppo.PPO(**PPO).learner, {"policy": POLICY, "gamma": 0.9}),
    (ppo.ClippedSurrogate, {"settings": ppo.PPO(**PPO), "policy": POLICY, "gamma": 0.9}),
    (sac.SAC, SAC),
    (sac.SAC(**SAC).learner, {"policy": POLICY, "gamma": 0.9}),
    (sac.SoftActorCritic, {"settings": sac.SAC(**SAC), "policy": POLICY, "gamma": 0.9}),
    (sac.QNetwork([4]).forward, {"observation": SEEN, "action": ACTION}),
    (sac.Memory, {"capacity": 9}),
    (MEMORY.sample, {"number": 2}),
    (shaping.Shaping, SHAPING),
    (SHAPED.potential, {"observation": SEEN}),
    (
        SHAPED.reward,
        {"observation": SEEN, "following": SEEN, "terminated": torch.zeros(6, 1, dtype=torch.bool), "gamma": 0.9},
    ),
    (shaping.fading, {"generation": 1, "generations": 2}),
    (shaping.on_goal, {"observation": SEEN}),
    (collecting.Collecting, {"kind": "multisync", "workers": 2}),
    (
        collecting.Crew,
        {
            "how": collecting.Collecting(),
            "env": {"backend": "batched", "tables": 2, **FORTH},
            "seed": 0,
            "policy": POLICY,
            "batch": 4,
        },
    ),
    (seats.learner_view, {"data": LIVED, "shaping": SHAPED, "strength": 1.0, "gamma": 0.9}),
    (selfplay.Practice, {"crew": CREW, "policy": POLICY, "shaping": SHAPED, "gamma": 0.9}),
    (
        PRACTICE.generation,
        {"learner": Onlooker(), "opponents": LEAGUE.lineup([0]), "steps": 4, "strength": 1.0},
    ),
    (selfplay.goals_of, {"play": LIVED, "members": 2}),
    (selfplay.Pool, {"league": LEAGUE, "anchors": [], "sampler": samplers.Latest(), "memory": 0.5}),
    (POOL.draw, {"number": 2, "rng": np.random.default_rng(0)}),
    (POOL.remember, {"members": [0, 1], "goals": np.ones((2, 2), np.int64)}),
    (
        selfplay.results_against,
        {"player": POLICY, "opponents": LEAGUE.lineup([0]), "rounds": 1, "seed": 0, "decision_ticks": 25},
    ),
]
