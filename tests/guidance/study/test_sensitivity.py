"""Populations under other assumptions."""

import re

import numpy as np
import pytest
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from guidance.simulated_users import Population, sample_people
from guidance.study.sensitivity import latin_hypercube, scale_assumptions

PARAMETERS = list(OmegaConf.load(CONF / "replicate.yaml").sensitivity.parameters)
SPREADS = {  # how widely people or measurements spread, not what they are like
    *("stiffening_shape", "rating_gain_log_sd", "rating_bias_sd", "rating_noise", "delay_noise"),
    "archetypes",
}


def test_every_slice_of_every_range_is_used_once():
    factors = latin_hypercube(["a", "b", "c"], 40, 1.5, seed=0)
    slices = np.floor(40 * (np.log(factors) / np.log(1.5) + 1) / 2)
    assert all(sorted(slices[name]) == list(range(40)) for name in factors)
    assert factors.equals(latin_hypercube(["a", "b", "c"], 40, 1.5, seed=0))
    assert not factors.equals(latin_hypercube(["a", "b", "c"], 40, 1.5, seed=1))


def test_no_change_leaves_people_as_they_are():
    usual = Population.usual()
    same = scale_assumptions(usual, dict.fromkeys(PARAMETERS, 1.0))
    assert np.array_equal(sample_people(20, 3, usual), sample_people(20, 3, same))


def test_each_assumption_changes_people_and_stays_valid():
    usual = Population.usual()
    before = sample_people(30, 3, usual)
    for name in PARAMETERS:
        for factor in (1 / 1.5, 1.5):
            people = sample_people(30, 3, scale_assumptions(usual, {name: factor}))
            assert not np.array_equal(before, people), name


def test_laws_keep_their_shape_and_shares_their_limit():
    usual = Population.usual()
    law = scale_assumptions(usual, {"dwell": 1.4}).dwell
    assert law == pytest.approx((1.4 * 0.21, 0.2, 1.4 * 0.15, 1.4 * 0.30, -0.3))
    assert scale_assumptions(usual, {"resistance": 1.5}).resistance.scale == 1.0
    assert scale_assumptions(usual, {"aim_widest": 1.5}).aim_widest == 1.0
    before, after = usual.worth["near_smash"], scale_assumptions(usual, {"worth.near_smash": np.e}).worth["near_smash"]
    assert after[0] == pytest.approx(before[0] + 1) and list(after[1:]) == list(before[1:])


def test_what_is_assumed_is_what_is_marked_so():
    """The list in conf/replicate.yaml is that of the numbers with an [A] in conf/users/default.yaml."""
    marked, section = set(), False
    for line in (CONF / "users" / "default.yaml").read_text(encoding="utf-8").splitlines():
        if line.strip().startswith("#"):
            section = "all [A]" in line or (section and "# --" not in line)
        elif match := re.match(r"  (  )?(\w+): *([^#]*)(.*)", line):
            nested, name, value, comment = match.groups()
            if value.strip() and (section or re.search(r"(?<!clip )(?<!log-sd )\[A\]", comment)):
                marked.add(f"worth.{name}" if nested else name)
    assert set(PARAMETERS) == marked - SPREADS


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: latin_hypercube(["a"], 0, 1.5, 0), r"sensitivity\.points = 0"),
        (lambda: latin_hypercube(["a"], 3, 1.0, 0), r"sensitivity\.largest = 1\.0"),
        (lambda: latin_hypercube(["a", "a"], 3, 1.5, 0), "a more than once"),
        (lambda: scale_assumptions(Population.usual(), {"courage": 1.1}), "courage is not a parameter"),
        (lambda: scale_assumptions(Population.usual(), {"worth.courage": 1.1}), r"worth\.courage is not a parameter"),
        (lambda: scale_assumptions(Population.usual(), {"archetypes": 1.1}), "archetypes is not a parameter"),
    ],
)
def test_wrong_settings_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
