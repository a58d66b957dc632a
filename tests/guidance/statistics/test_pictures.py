"""Pictures of studies with few people, many conditions and long names."""

import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

from airhockey_marl.experiment.html import template
from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.figures import figure6, means_beside, robustness_map
from guidance.statistics.groups import Group
from guidance.statistics.replication_report import NAMES
from guidance.statistics.report import screen_table, write_report
from guidance.statistics.robustness import findings_over, outcomes_of
from tests import ROOT
from tests.guidance.statistics.test_report import synthetic_trials
from tests.pictures import faults

LONG = "A guidance with a very long name that a student has given it, because it does many things, by turns"
MANIFEST = {"conditions": [{"name": "mine", "letter": "q", "label": LONG}]}


def with_others(trials: pd.DataFrame) -> pd.DataFrame:
    """The trials with four conditions more, three of this project and one of the manifest."""
    own = trials[trials["condition"] == "oahg_ut"]
    others = [own.assign(condition=name) for name in ("product", "blended", "approach_gated", "mine")]
    return pd.concat([trials, *others], ignore_index=True)


@pytest.fixture(scope="module")
def few() -> Group:
    """Three people, with rates of 0 and 1 and a rating of 1."""
    rates = np.random.default_rng(0).integers(0, 2, 27).astype(float)
    return Group(synthetic_trials(users=3).assign(helpfulness=1.0, win_rate=rates), {})


@pytest.fixture(scope="module")
def many() -> Group:
    return Group(with_others(synthetic_trials(users=6)), MANIFEST)


def test_axes_show_what_is_possible(few):
    axes = dict(zip(METRICS, figure6(few).axes, strict=True))
    for name, metric in METRICS.items():
        low, high = axes[name].get_ylim()
        assert low >= 0 and (high <= 1.02 or not metric.unit.startswith("share"))
        assert all(bar.get_height() > low for bar in axes[name].containers[0] if name == "helpfulness")


@pytest.mark.parametrize("draw", [figure6, lambda group: means_beside(group, Group(group.trials, MANIFEST))])
def test_every_condition_is_in_the_legend_by_its_label(few, many, draw):
    for group, labels in ((few, []), (many, ["(j) Product of Gaussians (UA)", f"(q) {LONG}"])):
        figure = draw(group)
        assert not faults(figure)
        legend = [" ".join(text.get_text().split()) for text in figure.legends[0].get_texts()]
        assert {f"({c.letter}) {c.label}" for c in CONDITIONS.values()} | set(labels) <= set(legend)


def test_the_map_of_findings_explains_itself():
    groups = {name: NAMES.get(name, f"other assumptions, {name}") for name in (*NAMES, "comply_or_resist")}
    outcomes = [outcomes_of(synthetic_trials(n, 6)).assign(group=name, study=0) for n, name in enumerate(groups)]
    figure = robustness_map(findings_over(pd.concat(outcomes, ignore_index=True)), groups)
    assert not faults(figure)
    titles = [" ".join(tick.get_text().split()) for tick in figure.axes[0].get_xticklabels()]
    assert titles == list(groups.values())
    assert len(figure.legends[0].get_texts()) == len(CONDITIONS)


def test_screen_tables_hold_any_name_and_number(many):
    trials = many.trials.assign(mean_smash_speed=1e300, mean_disagreement=-0.0)
    lines = screen_table(Group(trials, MANIFEST)).splitlines()
    assert {len(line) for line in lines} == {len(lines[0])}


class Tables(HTMLParser):
    """Collects tables of a page that are not alone in a box that scrolls."""

    def __init__(self) -> None:
        super().__init__()
        self.before, self.tables, self.outside = None, 0, []

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables += 1
            if self.before != ("div", [("class", "scroll")]):
                self.outside.append(self.getpos())
        self.before = tag, attrs


def test_tables_never_widen_a_page(few, many, tmp_path):
    write_report(many.trials, tmp_path, MANIFEST, few)
    page = Tables()
    page.feed((tmp_path / "report.html").read_text())
    assert page.tables > 10 and not page.outside
    templates = [path for package in ("guidance", "airhockey_marl") for path in (ROOT / package).rglob("*.html")]
    assert len(templates) > 8
    for path in templates:
        page = Tables()
        page.feed(re.sub(r"{[{%].*?[%}]}", "", path.read_text(), flags=re.DOTALL))
        assert not page.outside, path
    base = template(ROOT / "guidance", "base.html").render()
    assert ".scroll { overflow-x: auto; }" in base


@pytest.mark.parametrize("people", [True, False])
def test_the_scale_is_of_as_many_participants_as_there_are(people, tmp_path):
    write_report(synthetic_trials(users=6), tmp_path, {"participants": "people"} if people else {})
    assert "For scale, with 6 participants" in (tmp_path / "report.html").read_text()
