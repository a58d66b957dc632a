"""The protocol of section 4.2 with simulated people, models and tables."""

import json
from collections import Counter
from dataclasses import replace
from io import StringIO
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import CONF
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import greedy
from guidance.forces.condition_specs import ConditionSpec
from guidance.forces.conditions import CombinedGuidance, Condition, NoGuidance, Spring, SpringGuidance, Thresholds
from guidance.forces.lookahead import Lookahead
from guidance.sessions.simulated_participant import SimulatedParticipant
from guidance.simulated_users import NO_ADVISORS, SimulatedUsers, sample_people
from guidance.simulated_users.ratings import SIGNALS
from guidance.statistics.codebook import tables_beside
from guidance.study.batched_guidance import BatchedGuidance
from guidance.study.games import no_force, play_games
from guidance.study.models import Models
from guidance.study.protocol import (
    Protocol,
    balance_note,
    counterbalanced_order,
    is_balanced,
    spawn_rng_states,
    williams_design,
)
from guidance.study.setup import StudySetup, manifest, study_hash
from guidance.study.study import Cohort, playing_order, run_studies, run_study

SHORT = Protocol(familiarization=0.2, rounds=2, extra_rounds=1, min_seconds=4, round_seconds=3)
SPRING, UT = Spring(50.0, 3.0, 0.075), Thresholds(0.3, 0.6)
NHG = Condition(ConditionSpec("nhg", "a", "NHG"), NoGuidance())
OAHG = Condition(ConditionSpec("oahg", "b", "OAHG (vanilla)"), SpringGuidance("optimal", SPRING))
UPHG_UA = Condition(ConditionSpec("uphg_ua", "e", "UPHG (UA)"), SpringGuidance("adapted", SPRING))
COMBHG = Condition(
    ConditionSpec("combhg_ut_ua_sc", "i", "CombHG (UT+UA+SC)"),
    CombinedGuidance(SpringGuidance("optimal", SPRING, UT), SpringGuidance("adapted", SPRING, UT), similarity=True),
)
KEY = ["user", "condition"]
SCALES = dict.fromkeys(SIGNALS, 1.0)


@pytest.fixture(scope="module")
def models() -> Models:
    torch.manual_seed(0)
    return Models(GaussianPolicy([16]), GaussianPolicy([16]), GaussianPolicy([16]), 0.1, {})


def opponent(observation: torch.Tensor) -> torch.Tensor:
    """Stays before its goal, in line with the puck."""
    return torch.stack([torch.full((len(observation),), -0.8), (2 * observation[:, 9]).clamp(-0.3, 0.3)], dim=1)


def setup_of(models, conditions, protocol=SHORT, adaptation=True) -> StudySetup:
    play = {"opponent": opponent, "variant": "comply_or_resist", "advisors": NO_ADVISORS, "adaptation": adaptation}
    models_and_course = {"models": models, "lookahead": Lookahead(0.1), "protocol": protocol}
    return StudySetup(conditions=conditions, **models_and_course, **play, rating_scales=SCALES)


def study(models, conditions, protocol=SHORT, people=3, seed=0, adaptation=True):
    return run_study(sample_people(people, 100), setup_of(models, conditions, protocol, adaptation), seed=seed).trials


def test_equal_seeds_give_equal_trials(models):
    first = study(models, [NHG, COMBHG])
    assert first.equals(study(models, [NHG, COMBHG]))
    assert not first.equals(study(models, [NHG, COMBHG], seed=1))


def test_no_force_is_nhg_bit_for_bit(models):
    """A spring without stiffness, weighed and combined as in (i), leaves no trace in anything that was played."""
    slack = SpringGuidance("optimal", Spring(0.0, 3.0, 0.075), UT)
    nothing = Condition(ConditionSpec("nothing", "a", "nothing"), CombinedGuidance(slack, slack, similarity=True))
    nhg, none = study(models, [NHG]), study(models, [nothing])
    played = [c for c in nhg.columns if not c.startswith("w_") and c != "condition"]
    assert nhg[played].equals(none[played])


def test_without_adaptation_a_condition_is_played_alike_alone_and_among_others(models):
    """To the last bit, models and springs included."""
    together = study(models, [NHG, OAHG, UPHG_UA, COMBHG], adaptation=False)
    for condition in (NHG, OAHG, UPHG_UA, COMBHG):
        alone = study(models, [condition], adaptation=False)
        assert together[together["condition"] == condition.name].reset_index(drop=True).equals(alone)


def test_people_who_adapt_bring_what_they_have_learned(models):
    """A game before which there was no force is played as alone; under a force after another one, it is not."""
    conditions = [NHG, OAHG, COMBHG]
    together = study(models, conditions, people=6)
    alone = pd.concat([study(models, [condition], people=6) for condition in conditions]).set_index(KEY)
    for _, games in together.sort_values("position").set_index(KEY).groupby("user"):
        had_force = False
        for key, game in games.iterrows():
            if not had_force:
                assert game.equals(alone.loc[key])
            elif key[1] != "nhg":
                assert game["mean_disagreement"] != alone.loc[key, "mean_disagreement"]
            had_force |= key[1] != "nhg"
    assert together["position"].nunique() > 3


def test_the_order_matters_to_people_who_adapt_and_to_no_others(models, monkeypatch):
    """The same people and random numbers in two orders."""
    forward = {on: study(models, [OAHG, COMBHG], adaptation=on) for on in (True, False)}
    monkeypatch.setattr("guidance.study.study.counterbalanced_order", lambda *args: 10 - counterbalanced_order(*args))
    backward = {on: study(models, [OAHG, COMBHG], adaptation=on) for on in (True, False)}
    assert forward[False].drop(columns="position").equals(backward[False].drop(columns="position"))
    assert (forward[True]["mean_disagreement"] != backward[True]["mean_disagreement"]).all()


def test_conditions_follow_each_other_in_the_order_of_trials_csv(models):
    mine = replace(OAHG, spec=replace(OAHG.spec, name="mine", letter="k"))
    cohort, conditions = Cohort(sample_people(5, 1), 1), [NHG, OAHG, COMBHG, mine]
    trials = run_studies([cohort], setup_of(models, conditions))[0].trials
    names = [condition.name for condition in conditions]
    for user, places in enumerate(playing_order(cohort, conditions)):
        games = trials[trials["user"] == f"S{user + 1:02d}"].sort_values("position")
        assert list(games["condition"]) == [names[place] for place in places]
        assert names[places[-1]] == "mine"


def test_forces_are_reported_game_by_game_in_every_wave(models):
    """`on_forces` sees each scored and unscored tick of each game once, whether or not people adapt."""
    ticks = {}
    for adaptation in (True, False):
        seen, progress = np.zeros(9, dtype=int), []

        def count(output, games, seen=seen):
            assert len(output.force) == len(games) and (np.diff(games) > 0).all()
            seen[games] += 1

        def tell(stage, share, progress=progress):
            progress.append(share)

        setup = setup_of(models, [NHG, OAHG, OAHG], Protocol(0.2, 1, 0, 0, 1.0), adaptation)
        run_study(sample_people(3, 100), setup, seed=0, on_forces=count, progress=tell)
        assert progress == sorted(progress) and progress[-1] == 1.0
        ticks[adaptation] = seen
    assert ticks[False].tolist() == [60] * 9  # of nobody who scores; 10 before it is scored
    assert ticks[True].tolist() == [60] * 9


def test_a_study_is_played_alike_alone_and_beside_others(models):
    """A hundred people are enough for the kernels to run on several threads."""
    cohorts = [Cohort(sample_people(n, n), n) for n in (3, 100, 4)]
    setup = setup_of(models, [NHG, OAHG, COMBHG])
    for cohort, tables in zip(cohorts, run_studies(cohorts, setup), strict=True):
        alone = run_studies([cohort], setup)[0]
        assert tables.trials.equals(alone.trials) and tables.counts.equals(alone.counts)


def test_shuffled_adaptation_changes_ua_and_nothing_else(models):
    cohorts = [Cohort(sample_people(n, n), n) for n in (3, 2)]
    setup = setup_of(models, [NHG, OAHG, UPHG_UA], adaptation=False)
    pairs = zip(run_studies(cohorts, setup), run_studies(cohorts, setup, shuffled_adaptation=True), strict=True)
    for (own, _), (shuffled, _) in pairs:
        ua = own["condition"] == "uphg_ua"
        assert own[~ua].equals(shuffled[~ua])
        assert (own.loc[ua, "mean_disagreement"] != shuffled.loc[ua, "mean_disagreement"]).all()


def test_nine_orders_are_balanced_over_multiples_of_eighteen():
    assert is_balanced(36, 9) and not is_balanced(20, 9) and is_balanced(20, 4)


def test_an_order_that_is_not_balanced_is_noted():
    assert balance_note(20, 1) is None and balance_note(36, 9) is None and balance_note(20, 10) is None
    assert balance_note(20, 9) == "the order of 9 conditions is balanced over multiples of 18 people"
    assert balance_note(25, 10) == "the order of 10 conditions is balanced over multiples of 10 people"
    assert balance_note(20, 9, others=1).endswith("18 people, and the others come after them")


def test_a_condition_beyond_the_nine_comes_after_them(models):
    mine, other = (replace(OAHG, spec=replace(OAHG.spec, name=n, letter=k)) for n, k in (("mine", "k"), ("other", "j")))
    trials = study(models, [NHG, mine, other])
    assert (trials["position"][trials["condition"] == "mine"] == 11).all()
    assert (trials["position"][trials["condition"] == "other"] == 10).all()
    assert trials["position"][trials["condition"] == "nhg"].le(9).all()


def test_rows_and_columns_are_those_of_trials_csv(models):
    trials = study(models, [NHG, UPHG_UA, COMBHG])
    assert list(trials.columns) == [
        *("user", "condition", "position", "win_rate", "mean_smash_speed", "defense_rate", "mean_disagreement"),
        *("helpfulness", "naturalness", "controllability", "comfort", "rounds", "duration_s"),
        *("w_unc_optimal_mean", "w_unc_optimal_sd", "w_unc_user_mean", "w_unc_user_sd", "w_sim_mean", "w_sim_sd"),
        "seed",
    ]
    assert list(trials["user"].unique()) == ["S01", "S02", "S03"] and len(trials) == 9
    nhg, ua, comb = (trials[trials["condition"] == c.name] for c in (NHG, UPHG_UA, COMBHG))
    assert nhg["mean_disagreement"].isna().all() and ua["mean_disagreement"].notna().all()
    assert nhg["w_sim_mean"].isna().all() and ua["w_unc_user_mean"].isna().all()
    assert comb[["w_unc_optimal_mean", "w_unc_user_mean", "w_sim_mean"]].notna().all(axis=None)
    assert trials[["helpfulness", "naturalness", "controllability", "comfort"]].isin(range(1, 8)).all(axis=None)


def test_counts_agree_with_the_rates_and_rounds(models):
    tables = run_study(sample_people(8, 100), setup_of(models, [NHG, OAHG]), seed=0)
    trials, counts = tables
    assert counts[["user", "condition"]].equals(trials[["user", "condition"]])
    assert counts[["rounds_won", "rounds_lost", "rounds_undecided"]].sum(axis=1).equals(trials["rounds"])
    assert (counts["rounds_won"] / (counts["rounds_won"] + counts["rounds_lost"])).equals(trials["win_rate"])
    assert (counts["shots_stopped"] / counts["shots_faced"]).equals(trials["defense_rate"])
    assert (counts["smashes"] == 0).equals(trials["mean_smash_speed"].isna())
    assert trials["win_rate"].notna().any() and trials["defense_rate"].notna().any()


def test_tables_for_other_programs(models):
    tables = run_study(sample_people(3, 100), setup_of(models, [OAHG, NHG]), seed=0)
    specs = {condition.name: condition.spec for condition in (NHG, OAHG)}
    manifest = {"study_hash": "ab", "config": {"users": {"withdrawn": ["comfort"]}}}
    texts = tables_beside(*tables, specs, manifest)
    wide = pd.read_csv(StringIO(texts["trials_wide.csv"]), float_precision="round_trip").set_index("user")
    for row in tables.trials.to_dict("records"):
        for name in ("win_rate", "comfort", "duration_s", "w_sim_mean", "position"):
            assert wide.loc[row["user"], f"{name}_{row['condition']}"] == pytest.approx(row[name], abs=0, nan_ok=True)
    assert list(wide.columns[:2]) == ["position_nhg", "position_oahg"] and len(wide) == 3
    for name, table in zip(("trials.json", "counts.json"), tables, strict=True):
        codebook = json.loads(texts[name])
        assert list(codebook["columns"]) == list(table) and codebook["study"]["withdrawn"] == ["comfort"]
        for column, entry in codebook["columns"].items():
            assert {"description", "unit", "type"} <= set(entry)
            least, largest = entry.get("minimum", -np.inf), entry.get("maximum", np.inf)
            assert entry["type"] == "text" or table[column].dropna().between(least, largest).all()
    comfort = json.loads(texts["trials.json"])["columns"]["comfort"]
    assert comfort["description"].startswith("PROXY") and (comfort["minimum"], comfort["maximum"]) == (1, 7)


def test_a_game_has_its_rounds_and_its_extra_rounds_only_while_it_is_short():
    people = sample_people(4, 100)

    def play(protocol):
        users = SimulatedUsers(people, spawn_rng_states(0, range(4), 0, 0))
        return play_games(users, opponent, no_force, protocol, TableSpec(), spawn_rng_states(0, range(4), 0, 1))

    timed = Protocol(familiarization=0, rounds=2, extra_rounds=3, min_seconds=0, round_seconds=0.5)
    games = play(timed)
    assert (games.rounds == 2).all()
    longer = play(Protocol(0, 2, 3, 1e6, 0.5))
    assert (longer.rounds == 5).all() and (longer.seconds > games.seconds).all()
    some = play(Protocol(0, 2, 3, 1.2, 0.5))  # over as soon as 1.2 s are played, after 2 rounds at least
    assert ((some.rounds >= 2) & (some.rounds <= 5) & (some.seconds >= 1.2 - 1e-9)).all()


def test_demonstrations_are_the_scored_play():
    people = sample_people(3, 100)
    users = SimulatedUsers(people, spawn_rng_states(0, range(3), 0, 0))
    protocol = Protocol(1.0, 2, 0, 0, 1.0)
    games = play_games(users, opponent, no_force, protocol, TableSpec(), spawn_rng_states(0, range(3), 0, 1), True)
    for seconds, (observation, action) in zip(games.seconds, games.demonstrations, strict=True):
        assert len(observation) == len(action) == round(seconds / 0.02)
        assert observation.shape[1] == 12 and action.abs().max() <= 1


def test_guidance_really_guides():
    """A model that always wants the right front corner pulls hands there that do not learn to resist."""
    corner = GaussianPolicy([4])
    with torch.no_grad():
        corner.head.weight.zero_()
        corner.head.bias[:] = torch.tensor([1.0, -1.0, -3.0, -3.0])
    models = Models(corner, corner, corner, 0.1, {})
    n, people = 30, sample_people(30, 100)

    def mean_action(condition):
        users = SimulatedUsers(people, spawn_rng_states(0, range(n), 0, 0), adaptation=False)
        guide = BatchedGuidance([condition.guidance], n, models, None, Lookahead(0.1))
        protocol = Protocol(0, 1, 0, 0, 20)
        games = play_games(users, opponent, guide, protocol, TableSpec(), spawn_rng_states(0, range(n), 0, 1), True)
        return torch.cat([action for _, action in games.demonstrations]).mean(0)

    shift = mean_action(OAHG) - mean_action(NHG)
    assert shift[0] > 0.01 and shift[1] < -0.01


def test_batched_guidance_is_ordered_by_condition_then_user(models):
    adapted = models.adapted_to([(torch.randn(9, 12), torch.randn(9, 2))] * 4)
    guide = BatchedGuidance([c.guidance for c in (NHG, OAHG, COMBHG)], 4, models, adapted, Lookahead(0.0))
    state, action = np.random.default_rng(0).normal(size=(2, 12, 12))
    action = action[:, :2]
    guided = guide(state, action)
    assert guided.force.shape == (12, 2) and not guided.force[:4].any()
    mean = greedy(models.optimal)(torch.from_numpy(state[4:8]).float())
    expected = SPRING.force(torch.from_numpy(action[4:8]).float(), mean)
    assert torch.allclose(guided.force[4:8].float(), expected, atol=1e-6)
    assert guided.w_sim[:8].isnan().all() and guided.w_sim[8:].isfinite().all()


def test_adapted_parameters_are_required_by_ua():
    torch.manual_seed(0)
    model = GaussianPolicy([4])
    with pytest.raises(ValueError, match="adapted"):
        BatchedGuidance([UPHG_UA.guidance], 2, Models(model, model, model, 0.1, {}), None, Lookahead(0.1))


def test_a_run_is_frozen_only_with_all_nine_if_people_adapt(monkeypatch):
    def is_frozen(*overrides: str) -> bool:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            cfg = compose("evaluate", overrides=list(overrides))
        fixed = {"studies": {"pilot": study_hash(cfg, {})}, "seed": cfg.seed}
        monkeypatch.setattr("guidance.study.setup.frozen_study", lambda: fixed)
        return manifest(cfg, {}, "", 0.0)["frozen"]

    assert is_frozen() and is_frozen("beyond=[product]")
    assert not is_frozen("condition=nhg") and is_frozen("condition=nhg", "users.adaptation=off")


def test_a_simulated_participant_takes_what_is_learned_into_the_next_game():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("lab", overrides=["device=simulated"])
    person = SimulatedParticipant(sample_people(2, 100), 1, 0, cfg.users)
    seat = SimpleNamespace(hand=SimpleNamespace(device=SimpleNamespace()))
    for _ in range(100):
        person.users.step(np.zeros((1, 12)), np.array([[1.0, 0.0]]))
    before, learned = person.users, person.users.learned
    person.begin_game(seat, 3)
    assert seat.person is seat.hand.device.users is person.users is not before
    assert learned.any() and np.array_equal(person.users.learned, learned)
    cfg.users.adaptation = "off"
    fixed = SimulatedParticipant(sample_people(2, 100), 1, 0, cfg.users)
    for _ in range(100):
        fixed.users.step(np.zeros((1, 12)), np.array([[1.0, 0.0]]))
    assert not fixed.users.learned.any()


@pytest.mark.parametrize("conditions", [2, 4, 9])
def test_a_williams_design_balances_order_and_what_comes_before(conditions):
    design = williams_design(conditions)
    assert all(sorted(row) == list(range(conditions)) for row in design)
    at = Counter((position, c) for row in design for position, c in enumerate(row))
    before = Counter((a, b) for row in design for a, b in pairwise(row))
    assert set(at.values()) == {len(design) // conditions}
    assert len(before) == conditions * (conditions - 1) and len(set(before.values())) == 1


def test_orders_are_balanced_over_a_multiple_of_the_design():
    position = counterbalanced_order(36, 9, seed=0)
    assert position.shape == (36, 9) and all(sorted(row) == list(range(1, 10)) for row in position)
    assert all(Counter(position[:, c]) == Counter(dict.fromkeys(range(1, 10), 4)) for c in range(9))


@pytest.mark.parametrize(
    ("field", "value"), [("rounds", 0), ("familiarization", -1), ("extra_rounds", -1), ("round_seconds", 0)]
)
def test_wrong_protocols_are_named(field, value):
    settings = {"familiarization": 0, "rounds": 1, "extra_rounds": 0, "min_seconds": 0, "round_seconds": 1}
    with pytest.raises(ValueError, match=rf"study\.{field} = {value}"):
        Protocol(**{**settings, field: value})
