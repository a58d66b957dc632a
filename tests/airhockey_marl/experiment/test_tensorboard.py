"""TensorBoard shows only documented tags, and the same values as the files of the runs."""

import fnmatch
import io
import json
import re

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from PIL import Image
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter

from airhockey_marl.evaluation import league_report
from airhockey_marl.experiment.files import load_tensors
from airhockey_marl.experiment.tensorboard import COMMON_TAGS, SCORES, add_picture, open_writer, tensorboard_dir
from airhockey_marl.players.scripted import SCRIPTED_PLAYERS
from airhockey_marl.self_play import league_training
from guidance.commands import meta_train
from guidance.forces.conditions import GuidanceOutput
from guidance.statistics import tensorboard as study
from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.tensorboard import BINS, Histograms
from tests.processes import smoke

SIZES = {"scalars": 0, "histograms": 0, "images": 0, "tensors": 0}
# of each command, the module with its tags, and the folder of the event file that has the run's header
COMMANDS = {
    "train": (league_training, "."),
    "league_report": (league_report, "."),
    "meta_train": (meta_train, "maml"),
    "evaluate": (study, "."),
}
SCORED = ("train", "meta_train", "evaluate")


def events_of(folder, part: str = ".") -> EventAccumulator:
    return EventAccumulator(str(tensorboard_dir(folder) / part), size_guidance=SIZES).Reload()


@pytest.mark.parametrize("name", COMMANDS)
def test_exactly_the_tags_that_a_command_logs_are_documented(runs, name):
    documented = {**COMMANDS[name][0].TAGS, **COMMON_TAGS}
    logged = set()
    for folder in {file.parent for file in (runs / name).rglob("events*")}:
        tags = EventAccumulator(str(folder), size_guidance=SIZES).Reload().Tags()
        for tag in (tag for kind in ("scalars", "histograms", "images", "tensors") for tag in tags[kind]):
            if not tag.startswith(("_hparams_/", "custom_scalars__")):  # TensorBoard's own
                patterns = [pattern for pattern in documented if fnmatch.fnmatchcase(tag, pattern)]
                assert patterns, tag
                logged |= set(patterns)
    assert logged == set(documented)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_card_is_the_resolved_configuration(runs, name):
    (card,) = events_of(runs / name, COMMANDS[name][1]).Tensors("card/text_summary")
    shown = yaml.safe_load(card.tensor_proto.string_val[0].decode())
    written = yaml.safe_load((runs / name / ".hydra" / "config.yaml").read_text())
    assert shown["seed"] == written["seed"] and set(shown) <= set(written)
    assert "${" not in str(shown)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_tags_are_explained_on_the_text_page(runs, name):
    (names,) = events_of(runs / name, COMMANDS[name][1]).Tensors("names/text_summary")
    rows = re.findall(r"^\| `(.*?)` \| (.*) \|$", names.tensor_proto.string_val[0].decode(), re.MULTILINE)
    texts = {**COMMANDS[name][0].TAGS, **COMMON_TAGS}
    assert rows == [(tag.removesuffix("/text_summary"), text) for tag, text in texts.items()]


@pytest.mark.parametrize("name", SCORED)
def test_the_hparams_page_finds_settings_and_scores(runs, name):
    events = events_of(runs / name, SCORES)
    hparams = {
        tag: HParamsPluginData.FromString(events.SummaryMetadata(tag).plugin_data.content)
        for tag in events.summary_metadata
        if tag.startswith("_hparams_/")
    }
    assert set(hparams) == {"_hparams_/session_start_info", "_hparams_/session_end_info"}
    settings = hparams["_hparams_/session_start_info"].session_start_info.hparams
    assert not [key for key in settings if key.endswith(("threads", "_partial_"))]
    assert settings["seed"].number_value == {"train": 0, "meta_train": 4, "evaluate": 3}[name]
    scores = {tag.removeprefix("score/"): events.Scalars(tag) for tag in events.Tags()["scalars"]}
    assert all(len(events) == 1 for events in scores.values())
    if name == "evaluate":
        trials = pd.read_csv(runs / "evaluate" / "trials.csv")
        assert scores["win_rate"][0].value == pytest.approx(trials.groupby("condition")["win_rate"].mean().mean())
        return
    card = json.loads((runs / name / "card.json").read_text())
    if name == "train":
        said = {
            f"{'against' if member in SCRIPTED_PLAYERS else 'generation'}_{member}": share
            for member, share in card["win_rate_of_last_against"].items()
        }
        assert {events[0].step for events in scores.values()} == {2000}
    else:
        said = card["on_nine_others"]
    assert {score: events[0].value for score, events in scores.items()} == pytest.approx(said, abs=1e-3)


def test_the_hparams_page_of_all_runs_has_every_commands_settings_and_scores(runs):
    """As TensorBoard gathers them: what differs comes first, and the scores are the only metrics."""
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(runs)).Reload()
    gathered = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(runs))))
    tags = gathered.hparams_metadata(RequestContext(), "")
    page = gathered.experiment_from_metadata(RequestContext(), "", True, tags, None)
    settings = [info.name for info in page.hparam_infos]
    assert settings[:2] == ["hidden", "seed"]
    assert {"gamma", "maml.inner_lr", "guidance.lookahead.seconds"} <= set(settings)
    metrics = {metric.name.tag for metric in page.metric_infos}
    assert metrics == {tag for name in SCORED for tag in events_of(runs / name, SCORES).Tags()["scalars"]}
    assert {"score/against_striker", "score/after_ua_loss", "score/replicated"} <= metrics


def test_training_logs_matches_a_film_and_a_heat_map(runs):
    events, matches = events_of(runs / "train"), pd.read_csv(runs / "train" / "matches.csv")
    for opponent, rows in matches.groupby("opponent"):
        decided = rows[rows["won"] + rows["lost"] > 0]
        shown = [e for e in events.Scalars(f"win_rate_against/{opponent}") if np.isfinite(e.value)]
        assert [e.step for e in shown] == [1000 * generation for generation in decided["generation"]]
        assert [e.value for e in shown] == pytest.approx(list(decided["won"] / (decided["won"] + decided["lost"])))
    for name, kind in (("film", "GIF"), ("win_rates", "PNG")):
        images = events.Images(f"league/{name}")
        assert [image.step for image in images] == [1000, 2000]
        assert images[0].encoded_image_string != images[1].encoded_image_string
        for image in images:
            with Image.open(io.BytesIO(image.encoded_image_string)) as picture:
                assert picture.format == kind and picture.size == (image.width, image.height)
                assert name != "film" or picture.n_frames > 100


def test_pictures_do_not_change_the_league(runs, tmp_path):
    smoke("airhockey_marl.train", "pictures_every=0", f"hydra.run.dir={tmp_path}/train")
    first, second = (load_tensors(folder / "train" / "state.safetensors") for folder in (runs, tmp_path))
    assert all(torch.equal(tensor, second[0][name]) for name, tensor in first[0].items())
    for name in ("league.safetensors", "matches.csv"):
        assert (runs / "train" / name).read_bytes() == (tmp_path / "train" / name).read_bytes()
    shown, again = (events_of(folder / "train") for folder in (runs, tmp_path))
    assert again.Tags()["images"] == [] and again.Tags()["scalars"] == shown.Tags()["scalars"]
    assert [e.value for e in again.Scalars("update/kl")] == [e.value for e in shown.Scalars("update/kl")]


def test_pictures_after_the_last_checkpoint_of_a_killed_run_are_purged(tmp_path):
    def png(shade: int) -> bytes:
        Image.new("RGB", (2, 1), (shade,) * 3).save(content := io.BytesIO(), "PNG")
        return content.getvalue()

    for purge_step, shades in ((1, (10, 20, 30)), (2, (25, 35))):  # resumed after step 1
        with open_writer(tmp_path, purge_step) as board:
            for step, shade in enumerate(shades, start=purge_step):
                add_picture(board, "league/film", png(shade), step)
    shown = EventAccumulator(str(tmp_path), size_guidance=SIZES).Reload().Images("league/film")
    assert [(image.step, image.encoded_image_string) for image in shown] == [(1, png(10)), (2, png(25)), (3, png(35))]


def test_meta_training_logs_the_loss_of_every_epoch(runs):
    for name, tags in (("maml", {"maml/loss", "maml/loss_before"}), ("supervised", {"supervised/loss"})):
        events = events_of(runs / "meta_train", name)
        assert set(events.Tags()["scalars"]) == tags
        for tag in tags:
            assert [event.step for event in events.Scalars(tag)] == [1, 2]
            assert all(np.isfinite(event.value) for event in events.Scalars(tag))


def test_the_league_report_logs_the_values_in_its_files(runs):
    folder = runs / "league_report"
    events, ratings = events_of(folder), pd.read_csv(folder / "ratings.csv", dtype={"member": str})
    ratings = ratings[ratings["source"] == "payoff"].set_index("member")["rating"].to_dict()
    generations = [event.value for event in events.Scalars("rating/generation")]
    assert generations == pytest.approx([ratings.pop(str(generation)) for generation in range(3)], abs=0.01)
    assert set(ratings) == set(SCRIPTED_PLAYERS)
    for member, rating in ratings.items():
        assert [e.value for e in events.Scalars(f"rating/{member}")] == pytest.approx([rating], abs=0.01)
    for name in ("payoff.png", "rating.png", "precision.png", "match.gif"):
        (image,) = events.Images(f"report/{name.partition('.')[0]}")
        assert image.step == 2000 and image.encoded_image_string == (folder / name).read_bytes()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_layout_shows_scalars_that_are_logged(runs, name):
    events = events_of(runs / name, COMMANDS[name][1])
    (logged,) = events.Tensors("custom_scalars__config__")
    layout = Layout.FromString(logged.tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for page in layout.category for chart in page.chart}
    assert charts == {title: tags for page in COMMANDS[name][0].LAYOUT.values() for title, tags in page.items()}
    folders = {file.parent for file in (runs / name).rglob("events*")}
    scalars = {tag for folder in folders for tag in EventAccumulator(str(folder)).Reload().Tags()["scalars"]}
    for title, patterns in charts.items():
        for pattern in patterns:
            assert any(re.fullmatch(pattern, tag) for tag in scalars), (title, pattern)


def test_a_study_logs_means_forces_and_weights(runs):
    events = events_of(runs / "evaluate")
    means = pd.read_csv(runs / "evaluate" / "trials.csv").groupby("condition")[list(METRICS)].mean()
    shown = {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    for place, condition in enumerate(CONDITIONS, start=1):
        for metric, mean in means.loc[condition].dropna().items():
            assert shown.pop(f"study/{metric}/{condition}") == [(place, pytest.approx(mean, rel=1e-5))]
    assert not shown
    (table,) = events.Tensors("means/text_summary")
    (row,) = [line for line in table.tensor_proto.string_val[0].decode().splitlines() if "(b) OAHG " in line]
    assert row.startswith("    ") and f" {means.loc['oahg', 'mean_disagreement']:.2f} |" in row
    force = {tag.split("/")[1]: events.Histograms(tag)[0].histogram_value for tag in histograms(events, "force")}
    assert len(force) == 9 and force["nhg"].sum == 0 and force["nhg"].max == pytest.approx(6 / BINS)
    assert force["oahg"].num > 500 and 0.5 < force["oahg"].sum / force["oahg"].num < 6
    assert len(histograms(events, "w_sim")) == 2 and len(histograms(events, "w_unc_user")) == 2
    assert events.Images("figure/figure6")[0].width > 500


def histograms(events: EventAccumulator, signal: str) -> list[str]:
    return [tag for tag in events.Tags()["histograms"] if tag.startswith(f"{signal}/")]


class Named:
    def __init__(self, name):
        self.name = name


def histograms_of(counts: Histograms, folder) -> EventAccumulator:
    with SummaryWriter(str(folder)) as writer:
        counts.log(writer)
    return EventAccumulator(str(folder)).Reload()


def test_histograms_count_every_output_once(tmp_path):
    counts = Histograms([Named("one"), Named("other")], 2, largest_force=3.0)
    nan = float("nan")
    force = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, -1.5]], dtype=torch.float64)
    counts.add(GuidanceOutput(force, w_sim=torch.tensor([nan, nan, 0.25], dtype=torch.float64)), np.array([0, 1, 3]))
    assert counts.counts["force"].sum(axis=1).tolist() == [2, 1]
    assert counts.counts["force"][0].nonzero()[0].tolist() == [0, BINS - 1]
    assert counts.sums["force"].tolist() == [[3.0, 9.0], [1.5, 2.25]]
    events = histograms_of(counts, tmp_path)
    assert set(events.Tags()["histograms"]) == {"force/one", "force/other", "w_sim/other"}
    value = events.Histograms("w_sim/other")[0].histogram_value
    assert value.num == 1 and value.min <= 0.25 <= value.max


def test_a_spring_with_a_force_limit_of_zero_has_a_histogram(tmp_path):
    counts = Histograms([Named("one")], 2, largest_force=0.0)
    counts.add(GuidanceOutput(torch.zeros(2, 2, dtype=torch.float64)), np.array([0, 1]))
    value = histograms_of(counts, tmp_path).Histograms("force/one")[0].histogram_value
    assert value.num == 2 and value.min == value.max == 0.0
