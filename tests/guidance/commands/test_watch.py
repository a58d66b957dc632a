"""A film of one person: what it shows is what was logged, what was logged is what was played."""

import sys
from dataclasses import replace
from math import atan2, degrees, remainder
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image, ImageChops

from airhockey_marl.envs.physics import TableSpec, action_range
from airhockey_marl.envs.rendering import SMOOTHING, View
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.players.networks import GaussianPolicy
from airhockey_marl.players.players import Player
from guidance.commands import watch
from guidance.display.film import MIN_WIDTH, FilmInfo, draw_frame, draw_play, draw_sheet, save_film
from guidance.display.scene import ARROW, PAPER, TARGETS
from guidance.forces.condition_specs import ConditionSpec
from guidance.forces.conditions import (
    CombinedGuidance,
    Condition,
    GuidanceOutput,
    NoGuidance,
    Spring,
    SpringGuidance,
    Thresholds,
)
from guidance.forces.equations import uncertainty_weight
from guidance.forces.lookahead import READINGS, Lookahead
from guidance.sessions.tick_log import ACTION, STATE, record_game
from guidance.simulated_users import NO_ADVISORS, SimulatedUsers, sample_people
from guidance.simulated_users.arm import HAND_REACH
from guidance.study.games import play_games
from guidance.study.models import Models
from guidance.study.protocol import Protocol, spawn_rng_states
from guidance.study.setup import StudySetup

TABLE, SPRING = TableSpec(), Spring(50.0, 3.0, HAND_REACH)
LOOKAHEAD = Lookahead(0.1)
NHG = Condition(ConditionSpec("nhg", "a", "NHG"), NoGuidance())
OAHG = Condition(ConditionSpec("oahg", "b", "OAHG (vanilla)"), SpringGuidance("optimal", SPRING))
SCENE = FilmInfo(TABLE, "OAHG (vanilla)", "simulated striker", "generation 25", frozenset({"optimal"}), False, 800)


def run(monkeypatch, folder: Path, *arguments: str) -> Path:
    """The command, for 2 s of play."""
    monkeypatch.setattr(sys, "argv", ["watch", "+preset=smoke", f"hydra.run.dir={folder}", *arguments])
    start_command(watch.__name__)
    return folder


def opponent(observation: torch.Tensor) -> torch.Tensor:
    """Stays before its goal, in line with the puck."""
    return torch.stack([torch.full((len(observation),), -0.8), (2 * observation[:, 9]).clamp(-0.3, 0.3)], dim=1)


@pytest.fixture(scope="module")
def models() -> Models:
    torch.manual_seed(0)
    return Models(GaussianPolicy([16]), GaussianPolicy([16]), GaussianPolicy([16]), 0.1, {})


def absent(observation: torch.Tensor) -> torch.Tensor:
    """Stays in a corner, and stirs a little with the puck."""
    return 0.1 * observation[:, 8:10] - 1.0


def play(
    models: Models,
    condition: Condition,
    seconds: float = 1.0,
    against: Player = opponent,
    lookahead: Lookahead = LOOKAHEAD,
) -> pd.DataFrame:
    users = SimulatedUsers(sample_people(1, 3), spawn_rng_states(3, [0], 0, 0), TABLE)
    protocol = Protocol(0, 1, 0, 0, 60)
    play = {"opponent": against, "variant": "comply_or_resist", "advisors": NO_ADVISORS, "table": TABLE}
    course = {"lookahead": lookahead, "protocol": protocol, "rating_scales": {}}
    setup = StudySetup(conditions=[condition], models=models, **course, **play)
    return record_game(users, setup, None, spawn_rng_states(3, [0], 0, 1), seconds)


def still(**values: float) -> pd.DataFrame:
    """One tick with everything at rest but for `values`, and targets that are no larger than a dot."""
    middle = {"own_x": -0.487, "other_x": 0.487, "optimal_y": 0.9, "predicted_y": -0.9}
    names = ("own", "other", "puck", "wanted", "force", *TARGETS, *(f"{model}_std" for model in TARGETS))
    row = dict.fromkeys(STATE, 0.0) | {f"{name}_{axis}": 0.0 for name in names for axis in "xy"} | middle
    row |= {"round": 1, "won": 0, "lost": 0, "goal": 0, "time_s": 0.02, "intention": "WAIT"}
    row |= dict.fromkeys(("w_unc_optimal", "w_unc_predicted", "w_sim"), float("nan"))
    return pd.DataFrame([row | values])


def changed(first: Image.Image, second: Image.Image) -> np.ndarray:
    """(n, 2) the pixels, right and down, in which two pictures differ visibly."""
    difference = np.asarray(ImageChops.difference(first, second)).max(axis=2)
    return np.argwhere(difference > 12)[:, ::-1]


def durations(film: Image.Image) -> list[int]:
    """Of its pictures, in ms."""
    found = []
    for picture in range(film.n_frames):
        film.seek(picture)
        found.append(film.info["duration"])
    return found


def test_a_run_with_adaptation_leaves_film_sheet_and_log(monkeypatch, tmp_path):
    run(monkeypatch, tmp_path, "condition=combhg_ut_ua_sc", "speed=0.5", "frames_per_second=10")
    ticks = pd.read_csv(tmp_path / "watch.csv")
    assert np.allclose(ticks["time_s"], 0.02 * np.arange(1, 101))
    weights = ticks[["w_unc_optimal", "w_unc_predicted", "w_sim"]]
    assert ((weights >= 0) & (weights <= 1)).all(axis=None) and weights["w_unc_predicted"].nunique() > 10
    with Image.open(tmp_path / "watch.gif") as film, Image.open(tmp_path / "watch.png") as sheet:
        lengths = durations(film)
        goal = ticks["goal"].to_numpy() != 0
        assert film.width == 800 and sheet.width == 1200 and sheet.height > 900
        # equal pictures are one that is shown for longer
        assert sum(lengths) == 200 * (~goal[4::5]).sum() + 800 * goal.sum()


def test_the_same_seed_gives_the_same_bytes_and_nhg_no_force(monkeypatch, tmp_path):
    first, second, other = (
        run(monkeypatch, tmp_path / name, "condition=nhg", "frames_per_second=5", f"seed={seed}")
        for name, seed in (("first", 1), ("second", 1), ("other", 2))
    )
    for name in ("watch.csv", "watch.gif", "watch.png"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
        assert (first / name).read_bytes() != (other / name).read_bytes()
    ticks = pd.read_csv(first / "watch.csv")
    assert (ticks[["force_x", "force_y"]] == 0).all(axis=None)
    assert ticks[["w_unc_optimal", "w_unc_predicted", "w_sim"]].isna().all(axis=None)
    assert ticks["hand_x"].nunique() > 50 and ticks["optimal_std_x"].gt(0).all()


def test_the_log_is_the_game_of_the_study(models):
    """The same person, streams and condition in the study's own loop: the same states tick by tick, over goals too."""
    states = []

    def forces(state: np.ndarray, action: np.ndarray, games: np.ndarray) -> GuidanceOutput:
        states.append(np.concatenate([state[0], HAND_REACH * action[0]]))
        return GuidanceOutput(torch.zeros(1, 2, dtype=torch.float64))

    users = SimulatedUsers(sample_people(1, 3), spawn_rng_states(3, [0], 0, 0), TABLE)
    play_games(users, absent, forces, Protocol(40, 1, 0, 0, 60), TABLE, spawn_rng_states(3, [0], 0, 1))
    ticks, seen = play(models, NHG, 40, absent), np.array(states)[:2000]
    assert np.array_equal(ticks[[*STATE, "hand_x", "hand_y"]], seen)
    acted = ticks["goal"] == 0  # with a new round the hand is back at the center
    assert np.array_equal(HAND_REACH * ticks.loc[acted, ACTION].to_numpy()[:-1], seen[1:, 12:][acted[:-1]])
    assert 0 < ticks[["won", "lost"]].iloc[-1].sum() == ticks["goal"].abs().sum() == ticks["round"].iloc[-1] - 1


@pytest.mark.parametrize("reading", READINGS)
def test_the_force_in_the_log_follows_from_hand_and_target_in_the_log(models, reading):
    ticks = play(models, OAHG, lookahead=Lookahead(0.1, reading))
    pairs = {name: torch.tensor(ticks[[f"{name}_x", f"{name}_y"]].to_numpy()) for name in ("hand", "optimal", "force")}
    assert ticks["round"].iloc[-1] == 1
    expected = SPRING.force(pairs["hand"] / HAND_REACH, pairs["optimal"])
    assert torch.allclose(pairs["force"], expected, atol=1e-5) and pairs["force"].abs().max() > 0.1
    assert (ticks["hand_x"] - play(models, NHG)["hand_x"]).abs().max() > 0.001  # and it was felt


def test_the_weights_in_the_log_follow_from_the_stds_in_the_log(models):
    low, high = Thresholds(0.1, 0.9), Thresholds(0.3, 1.5)
    both = CombinedGuidance(
        SpringGuidance("optimal", SPRING, low), SpringGuidance("user", SPRING, high), similarity=True
    )
    ticks = play(models, Condition(ConditionSpec("both", "i", "both"), both))
    for name, limits in (("optimal", low), ("predicted", high)):
        std = torch.tensor(ticks[[f"{name}_std_x", f"{name}_std_y"]].to_numpy())
        expected = uncertainty_weight(std, limits.low, limits.high).numpy()
        assert np.allclose(ticks[f"w_unc_{name}"], expected, atol=1e-5) and 0.01 < expected.mean() < 0.99
    assert ticks["w_sim"].between(0, 1).all() and ticks["w_sim"].nunique() > 10


@pytest.mark.parametrize("force", [(2.0, 0.0), (0.0, 1.0), (-1.5, 1.5), (1.0, -2.5)])
def test_the_arrow_points_where_the_force_does_and_is_as_long(force):
    view = View(TABLE, 800)
    paddle = np.array(view.pixel(-0.487, 0)) / SMOOTHING
    plain, pushed = (draw_play(still(force_x=x, force_y=y), 0, SCENE, 800) for x, y in ((0, 0), force))
    arrow = changed(plain, pushed) + 0.5 - paddle
    right, down = arrow.mean(axis=0)
    assert abs(remainder(degrees(atan2(-down, right) - atan2(force[1], force[0])), 360)) < 3
    length = ARROW * np.hypot(*force) * view.scale / SMOOTHING
    assert abs(np.hypot(*arrow.T).max() - length) < 4


@pytest.mark.parametrize("model", TARGETS)
def test_the_ellipse_reaches_one_std_from_the_target(model):
    std, half = np.array([0.5, 0.3]), action_range(TABLE)[1]
    at = {f"{model}_y": 0.0}
    plain = draw_play(still(**at), 0, SCENE, 800)
    drawn = draw_play(still(**at, **{f"{model}_std_x": std[0], f"{model}_std_y": std[1]}), 0, SCENE, 800)
    pixels = changed(plain, drawn)
    wide, high = pixels.max(axis=0) - pixels.min(axis=0) + 1
    scale = View(TABLE, 800).scale / SMOOTHING
    assert abs(wide - 2 * std[0] * half[0] * scale) < 3 and abs(high - 2 * std[1] * half[1] * scale) < 3


@pytest.mark.parametrize("used", TARGETS)
def test_the_film_has_the_colors_of_its_pictures(tmp_path, used):
    stds = {f"{model}_std_{axis}": 0.3 for model in TARGETS for axis in "xy"}
    ticks = pd.concat([still(**stds, force_x=2.0, w_sim=0.5)] * 2, ignore_index=True)
    scene = replace(SCENE, guiding_models=frozenset({used}))
    save_film(tmp_path / "film.gif", ticks, scene, 1, 20)
    with Image.open(tmp_path / "film.gif") as film:
        off = np.abs(np.asarray(film.convert("RGB"), dtype=int) - np.asarray(draw_frame(ticks, 0, scene), dtype=int))
    assert np.quantile(off.max(axis=2), 0.99) <= 8


def test_a_target_off_the_table_stays_in_the_picture_and_an_unused_one_is_pale():
    for x, y in ((-5, -5), (5, 5)):
        picture = np.asarray(draw_play(still(optimal_x=x, optimal_y=y), 0, SCENE, 800))
        assert np.all(picture == TARGETS["optimal"], axis=2).sum() > 20
    used, unused = (
        draw_play(still(), 0, replace(SCENE, guiding_models=used), 800) for used in (frozenset(TARGETS), frozenset())
    )
    dark, pale = (np.all(np.asarray(picture) == TARGETS["predicted"], axis=2).any() for picture in (used, unused))
    assert dark and not pale


@pytest.mark.parametrize("width", [MIN_WIDTH, 800, 1200])
def test_every_text_fits(width):
    """Nothing is written at the right edge, whatever the longest names are, and all weights find room."""
    unused = replace(
        SCENE, guiding_models=frozenset(), width=width, title="CombHG (UT+UA+SC)", player="simulated all-round"
    )
    ticks = still(w_unc_optimal=1.0, w_unc_predicted=0.0, w_sim=0.5, intention="SMASH_BANK_RIGHT")
    for scene in (unused, replace(unused, is_adapted=True, guiding_models=frozenset(TARGETS))):
        pixels = np.asarray(draw_frame(ticks, 0, scene))
        for part in (pixels[:60], pixels[-60:]):
            assert (part[:, -4:] == PAPER).all() and (part[:, :4] == PAPER).all()


def two_goals() -> pd.DataFrame:
    """200 ticks: the other scores in tick 50, the person in tick 150."""
    ticks = pd.concat([still()] * 200, ignore_index=True)
    ticks.loc[50:, "lost"], ticks.loc[51:, "round"], ticks.loc[50, "goal"] = 1, 2, -1
    ticks.loc[150:, "won"], ticks.loc[151:, "round"], ticks.loc[150, "goal"] = 1, 3, 1
    return ticks


def test_the_sheet_ends_with_the_persons_first_goal():
    ticks, sheet = two_goals(), draw_sheet(two_goals(), SCENE)
    for index, shown in ((20, False), (150, True), (151, False)):
        moved = ticks.copy()
        moved.loc[index, "puck_x"] = 0.9
        assert bool(len(changed(sheet, draw_sheet(moved, SCENE)))) == shown


def test_a_goal_stays(tmp_path):
    ticks = two_goals()
    ticks["puck_x"] = np.linspace(-0.5, 0.5, 200)  # no two pictures alike
    save_film(tmp_path / "film.gif", ticks.iloc[30:70].reset_index(drop=True), SCENE, 10, 200)
    with Image.open(tmp_path / "film.gif") as film:
        assert durations(film) == [200, 200, 800, 200, 200]
