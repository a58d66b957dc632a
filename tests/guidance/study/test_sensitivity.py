"""Populations under other assumptions."""

import re

import numpy as np
import pytest
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from guidance.simulated_users import Population, sample_people
from guidance.study.replication import latin_hypercube, scale_assumptions

PARAMETERS = list(OmegaConf.load(CONF / "users" / "default.yaml").assumed)


def test_every_slice_of_every_range_is_used_once():
    factors = latin_hypercube(["a", "b", "c"], 40, 1.5, seed=0)
    slices = np.floor(40 * (np.log(factors) / np.log(1.5) + 1) / 2)
    assert all(sorted(slices[name]) == list(range(40)) for name in factors)
    assert factors.equals(latin_hypercube(["a", "b", "c"], 40, 1.5, seed=0))
    assert not factors.equals(latin_hypercube(["a", "b", "c"], 40, 1.5, seed=1))


def test_factors_of_one_change_nobody():
    usual = Population.default()
    same = scale_assumptions(usual, dict.fromkeys(PARAMETERS, 1.0))
    assert np.array_equal(sample_people(20, 3, usual), sample_people(20, 3, same))


def test_each_assumption_changes_people_and_stays_valid():
    usual = Population.default()
    before = sample_people(30, 3, usual)
    for name in PARAMETERS:
        for factor in (1 / 1.5, 1.5):
            people = sample_people(30, 3, scale_assumptions(usual, {name: factor}))
            assert not np.array_equal(before, people), name


def test_scaled_distributions_keep_their_shape_and_proportions_their_limit():
    usual = Population.default()
    law = scale_assumptions(usual, {"dwell": 1.4})["dwell"]
    assert law == pytest.approx((1.4 * 0.21, 0.2, 1.4 * 0.15, 1.4 * 0.30, -0.3))
    assert scale_assumptions(usual, {"resistance": 1.5})["resistance"].scale == 1.0
    assert scale_assumptions(usual, {"max_aim": 1.5})["max_aim"] == 1.0
    scaled = scale_assumptions(usual, {"utility_weights.near_smash": np.e})
    before, after = (population["utility_weights"]["near_smash"] for population in (usual, scaled))
    assert after[0] == pytest.approx(before[0] + 1) and list(after[1:]) == list(before[1:])


def test_the_assumed_parameters_are_those_tagged_so():
    tagged, table = [], None
    for line in (CONF / "users" / "default.yaml").read_text(encoding="utf-8").splitlines():
        if match := re.match(r"( {4,6})(\w+):([^#]*)(.*)", line):
            indent, name, value, comment = match.groups()
            table = table if len(indent) == 6 else name
            if "[A]" in comment and value.strip():
                tagged.append(f"{table}.{name}" if len(indent) == 6 else name)
    assert sorted(PARAMETERS) == sorted(tagged)
    assert OmegaConf.load(CONF / "replicate.yaml")._get_node("sensitivity")._get_node("parameters")._value() == (
        "${users.assumed}"
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: latin_hypercube(["a", "a"], 3, 1.5, 0), "a more than once"),
        (lambda: scale_assumptions(Population.default(), {"courage": 1.1}), "courage is not a parameter"),
        (
            lambda: scale_assumptions(Population.default(), {"utility_weights.courage": 1.1}),
            r"utility_weights\.courage is not a parameter",
        ),
        (lambda: scale_assumptions(Population.default(), {"archetypes": 1.1}), "archetypes is not a parameter"),
    ],
)
def test_wrong_settings_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
