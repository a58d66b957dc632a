"""Playstyle and person can be identified from a game, but not for people without spread."""

import numpy as np
import pytest
import torch

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import greedy_player
from guidance.simulated_users import Population, load_advisors, sample_people
from guidance.simulated_users.population import LogNormal
from guidance.simulated_users.validation.playstyles import (
    FEATURES,
    classify_styles,
    features,
    identification_rate,
    shot_velocities,
)
from guidance.study.demonstrations import collect_demonstrations, results_by_skill
from guidance.study.setup import PlaySetup

TABLE = TableSpec()
EACH, TICKS = 10, 3000


@pytest.fixture(scope="module")
def setup() -> PlaySetup:
    opponent = League.load(CONF.parent / "airhockey_marl/pretrained/opponents.safetensors").player(25)
    advisors = load_advisors(CONF.parent / "guidance/pretrained/advisors.safetensors")
    return PlaySetup(opponent=greedy_player(opponent), variant="comply_or_resist", advisors=advisors)


def games(population: Population, seed: int, setup: PlaySetup) -> tuple[np.ndarray, list[np.ndarray]]:
    """Archetypes (n,), and the features (n, 10) of each of two games."""
    people = np.concatenate(
        [sample_people(EACH, seed + i, population, a) for i, a in enumerate(population["archetypes"])]
    )
    data = collect_demonstrations(people, setup, 2, TICKS, seed)
    return people["archetype"], [features(data.observation[:, game], TABLE) for game in (0, 1)]


def test_games_identify_playstyle_and_person(setup):
    population = Population.default()
    style, (known, _) = games(population, 4000, setup)
    others, (one, another) = games(population, 4500, setup)
    assert np.mean(classify_styles(known, style, one) == others) > 0.4  # chance is 1 of 6
    assert identification_rate(one, another) > 0.15  # chance is 1 of 60


def test_games_of_identical_people_identify_neither(setup):
    default = Population.default()
    same = {k: value._replace(log_sd=0.0) for k, value in default.parameters.items() if isinstance(value, LogNormal)}
    alike = {name: [0.5] * 6 for name in default["archetypes"]}
    population = Population.default(**same, archetypes=alike, trait_concentration=np.inf, skill_sd=0.0)
    style, (known, _) = games(population, 4000, setup)
    others, (one, another) = games(population, 4500, setup)
    assert np.mean(classify_styles(known, style, one) == others) < 0.4
    assert identification_rate(one, another) < 0.1


@pytest.mark.slow
def test_more_skill_wins_more_and_stops_more(setup):
    found = results_by_skill(Population.default(), 90, setup, 0)
    won, stopped = ([np.nanmean(v) for name, v in found.items() if name.startswith(w)] for w in ("rounds", "shots"))
    assert won[0] < won[2] and stopped[0] < stopped[1] < stopped[2]
    assert won[0] - 0.02 < won[1] < won[2] + 0.02


def test_a_shot_is_counted_once_and_only_if_it_goes_forward():
    seen = np.zeros((6, 12))
    seen[:, 0], seen[:, 8] = -0.5, -0.42
    seen[3:, 10] = 2.0  # struck forward
    assert shot_velocities(seen, TABLE).tolist() == [[2.0, 0.0]]
    seen[3:, 10] = -2.0
    assert len(shot_velocities(seen, TABLE)) == 0
    seen[3:, 10], seen[:, 8] = 2.0, 0.4  # far from the paddle: somebody else's
    assert len(shot_velocities(seen, TABLE)) == 0


def test_features_of_made_up_play():
    ticks = 1000
    seen = torch.zeros(2, ticks, 12)
    wave = torch.linspace(0, 60, ticks).sin()
    seen[..., 0] = torch.tensor([-0.8, -0.2])[:, None]
    seen[..., 8], seen[..., 9] = 0.5, 0.3 * wave
    seen[1, :, 1] = 0.1 * wave
    found = dict(zip(FEATURES, features(seen, TABLE).T, strict=True))
    assert found["depth"] == pytest.approx([-0.8, -0.2])
    assert found["lateral_tracking"] == pytest.approx([0.0, 1.0])
    assert found["pressing"] == pytest.approx([0.0, 1.0])
    assert found["shots_per_minute"] == pytest.approx([0.0, 0.0])
