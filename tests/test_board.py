"""What TensorBoard shows: names from the vocabulary alone, and the values that the runs wrote elsewhere."""

import fnmatch
import json
import re

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter

from airhockey_marl.board import LAYOUT, VOCABULARY, board_of
from guidance.conditions import Guided
from guidance.histograms import BINS, Histograms
from guidance.stats import METRICS
from tests.test_cli import smoke

SIZES = {"scalars": 0, "histograms": 0, "images": 0, "tensors": 0}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A league and a study of the smallest kind, from the commands."""
    folder = tmp_path_factory.mktemp("runs")
    smoke("airhockey_marl.train", f"hydra.run.dir={folder}/train")
    smoke("guidance.evaluate", "seed=3", f"hydra.run.dir={folder}/evaluate")
    return folder


def events_of(folder) -> EventAccumulator:
    return EventAccumulator(str(board_of(folder)), size_guidance=SIZES).Reload()


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_every_tag_is_in_the_vocabulary(runs, name):
    tags = events_of(runs / name).Tags()
    shown = [tag for kind in ("scalars", "histograms", "images", "tensors") for tag in tags[kind]]
    own = [tag for tag in shown if not tag.startswith(("_hparams_/", "custom_scalars__"))]  # TensorBoard's
    assert len(own) > 10
    for tag in own:
        assert any(fnmatch.fnmatchcase(tag, known) for known in VOCABULARY), tag


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_the_card_is_the_resolved_configuration(runs, name):
    (card,) = events_of(runs / name).Tensors("card/text_summary")
    shown = yaml.safe_load(card.tensor_proto.string_val[0].decode())
    written = yaml.safe_load((runs / name / ".hydra" / "config.yaml").read_text())
    assert shown["seed"] == written["seed"] and set(shown) <= set(written)
    assert "${" not in str(shown)


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_settings_and_scores_are_on_the_hparams_page(runs, name):
    events = events_of(runs / name)
    found = {
        tag: HParamsPluginData.FromString(events.SummaryMetadata(tag).plugin_data.content)
        for tag in events.summary_metadata
        if tag.startswith("_hparams_/")
    }
    settings = found["_hparams_/session_start_info"].session_start_info.hparams
    assert settings["seed"].number_value == (0 if name == "train" else 3)
    metrics = {metric.name.tag for metric in found["_hparams_/experiment"].experiment.metric_infos}
    assert metrics and metrics <= set(events.Tags()["scalars"])
    if name == "train":
        card = json.loads((runs / "train" / "card.json").read_text())
        (score,) = events.Scalars("score/against_0")
        assert score.step == 2000 and score.value == pytest.approx(card["win_rate_of_last_against"]["0"])


def test_the_layout_shows_what_there_is(runs):
    events = events_of(runs / "train")
    (logged,) = events.Tensors("custom_scalars__config__")
    layout = Layout.FromString(logged.tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for page in layout.category for chart in page.chart}
    assert charts == {title: tags for page in LAYOUT.values() for title, (_, tags) in page.items()}
    for title in ("rounds won against", "trust region", "STD of actions", "critic"):
        assert any(re.fullmatch(tag, name) for tag in charts[title] for name in events.Tags()["scalars"]), title


def test_a_study_shows_its_means_forces_and_weights(runs):
    events = events_of(runs / "evaluate")
    means = pd.read_csv(runs / "evaluate" / "trials.csv").groupby("condition")[list(METRICS)].mean().stack()
    shown = {tuple(tag.split("/")[1:]): events.Scalars(tag)[0].value for tag in events.Tags()["scalars"]}
    for (condition, metric), mean in means.dropna().items():
        assert shown[metric, condition] == pytest.approx(mean, rel=1e-5)
    force = {tag.split("/")[1]: events.Histograms(tag)[0].histogram_value for tag in histograms(events, "force")}
    assert len(force) == 9 and force["nhg"].sum == 0 and force["nhg"].max == pytest.approx(3 / BINS)
    assert force["oahg"].num > 500 and 0.5 < force["oahg"].sum / force["oahg"].num < 3
    assert len(histograms(events, "w_sim")) == 2 and len(histograms(events, "w_unc_user")) == 2
    assert events.Images("figure/figure6")[0].width > 500


def histograms(events: EventAccumulator, signal: str) -> list[str]:
    return [tag for tag in events.Tags()["histograms"] if tag.startswith(f"{signal}/")]


def test_histograms_count_every_answer_once(tmp_path):
    class Named:
        def __init__(self, name):
            self.name = name

    counts = Histograms([Named("one"), Named("other")], 2, largest_force=3.0)
    nan = float("nan")
    force = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, -1.5]], dtype=torch.float64)
    counts.add(Guided(force, w_sim=torch.tensor([nan, nan, 0.25], dtype=torch.float64)), np.array([0, 1, 3]))
    assert counts.counts["force"].sum(axis=1).tolist() == [2, 1]
    assert counts.counts["force"][0].nonzero()[0].tolist() == [0, BINS - 1]
    assert counts.sums["force"].tolist() == [[3.0, 9.0], [1.5, 2.25]]
    with SummaryWriter(str(tmp_path)) as writer:
        counts.log(writer)
    events = EventAccumulator(str(tmp_path)).Reload()
    assert set(events.Tags()["histograms"]) == {"force/one", "force/other", "w_sim/other"}
    value = events.Histograms("w_sim/other")[0].histogram_value
    assert value.num == 1 and value.min <= 0.25 <= value.max


def test_a_spring_that_is_clipped_to_nothing_has_a_histogram_too(tmp_path):
    class Named:
        name = "one"

    counts = Histograms([Named()], 2, largest_force=0.0)
    counts.add(Guided(torch.zeros(2, 2, dtype=torch.float64)), np.array([0, 1]))
    with SummaryWriter(str(tmp_path)) as writer:
        counts.log(writer)
    value = EventAccumulator(str(tmp_path)).Reload().Histograms("force/one")[0].histogram_value
    assert value.num == 2 and value.min == value.max == 0.0
