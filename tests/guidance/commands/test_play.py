"""The game at the window: keys choose the guidance, play is recorded, the user model becomes the player's own."""

import json
import os
import signal
import sys
import time
from pathlib import Path
from string import ascii_lowercase
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pygame
import pytest
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.league.league import League
from guidance.commands import watch
from guidance.commands.play import KEYS, condition_keys
from guidance.forces.lookahead import READINGS, Lookahead
from guidance.haptics.devices.pointer import Mouse
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.screen import NullDisplay, SimulatedClock
from guidance.haptics.seat import RealTimePlayer
from guidance.haptics.servo import InProcessServo
from guidance.sessions.free_play import MIN_DEMONSTRATION_TICKS, FreePlay
from guidance.sessions.game import load_games, read_ticks
from guidance.sessions.tick_log import COLUMNS, demonstration
from guidance.simulated_users import SimulatedUsers, sample_people
from guidance.statistics.design import CONDITIONS
from guidance.study.models import Models
from guidance.study.protocol import spawn_rng_states
from guidance.study.setup import load_conditions
from guidance.user_model.recordings import read_recordings
from tests.processes import Command, start

TABLE = TableSpec()
LOOKAHEAD = Lookahead(0.1)


class Keys(NullDisplay):
    """No screen, but keys: (tick, key) pairs."""

    def __init__(self, clock: SimulatedClock, *pressed: tuple[int, str]) -> None:
        self.clock, self.pressed, self.moments = clock, list(pressed), []

    @property
    def next_frame(self) -> float:
        return self.pressed[0][0] * TABLE.tick if self.pressed else float("inf")

    def frame(self, moment) -> list[str]:
        self.moments.append((moment.title, moment.note))
        return [self.pressed.pop(0)[1]]


@pytest.fixture(scope="module")
def shipped():
    with initialize_config_dir(str(CONF), version_base=None):
        cfg = compose("evaluate")
    models = Models.load(cfg.models.league, cfg.models.generation, cfg.models.user, cfg.models.meta)
    conditions = {str(i + 1): condition for i, condition in enumerate(load_conditions(cfg))}
    return models, conditions, League.load(cfg.models.opponents)


def played(
    shipped,
    folder: Path,
    seconds: float,
    *pressed: tuple[int, str],
    seed: int = 3,
    lookahead: Lookahead = LOOKAHEAD,
) -> tuple[FreePlay, Keys]:
    models, conditions, opponents = shipped
    clock = SimulatedClock()
    person = SimulatedUsers(sample_people(1, seed), spawn_rng_states(seed, [0], 0, 0), TABLE)
    screen = Keys(clock, *pressed)
    seat = RealTimePlayer(
        InProcessServo(Simulated(person), SafetyLimits(force=6.0, slew=300.0)),
        screen,
        clock,
        TABLE.tick,
        breath=0.0,
        person=person,
    )
    game = FreePlay(conditions, models, opponents, 55, lookahead, 60.0, seat, spawn_rng_states(seed, [0], 0, 1), folder)
    game.run(conditions["1"], seconds)
    return game, screen


def test_keys_choose_guidances_and_every_stretch_is_a_recording(shipped, tmp_path):
    game, _ = played(shipped, tmp_path, 6.0, (100, "2"), (200, "3"), (250, "page up"))
    names = ["01nhg", "02oahg", "03oahgut", "04oahgut"]
    games = load_games(tmp_path)
    assert list(games) == names == list(game.games)
    tables = [read_ticks(games[name].file) for name in names]
    assert sum(map(len, tables)) == 300 and all(list(table) == list(COLUMNS) for table in tables)
    forces = [np.hypot(table["force_x"], table["force_y"]).mean() for table in tables]
    assert forces[0] == 0 and min(forces[1:]) > 0.01
    assert tables[0]["w_unc_optimal"].isna().all() and tables[2]["w_unc_optimal"].notna().all()
    felt = np.hypot(tables[1]["felt_x"], tables[1]["felt_y"])
    asked = np.hypot(tables[1]["force_x"], tables[1]["force_y"])
    assert (
        0.5 < felt.max() <= 6.0 * (1 + 1e-12) and np.mean(np.abs(felt - asked) < 1e-5) > 0.8
    )  # but where it changes too fast
    assert (
        games["04oahgut"].facts["opponent"] == "generation 60"
        and games["03oahgut"].facts["opponent"] == "generation 55"
    )
    summary, counts = game.summary().reset_index(drop=True), game.counts()
    assert list(summary["duration_s"].round(2)) == [len(table) * 0.02 for table in tables]
    assert list(counts["position"]) == list(range(1, len(tables) + 1)) and set(counts["condition"]) <= set(CONDITIONS)
    assert counts[["rounds_won", "rounds_lost", "rounds_undecided"]].sum(axis=1).equals(summary["rounds"].astype(int))
    assert (counts["shots_stopped"] / counts["shots_faced"]).equals(summary["defense_rate"])


@pytest.mark.parametrize("reading", READINGS)
def test_what_is_recorded_agrees_under_every_reading(shipped, tmp_path, reading):
    """Hand, target and force of the record are those of Eq. 4."""
    game, _ = played(shipped, tmp_path, 2.0, (1, "2"), lookahead=Lookahead(0.1, reading))
    ticks, spring = read_ticks(game.games["02oahg"].file), shipped[1]["2"].guidance.spring
    pairs = (ticks[[f"{name}_x", f"{name}_y"]] for name in ("hand", "optimal", "force"))
    hand, target, force = (torch.tensor(pair.to_numpy()) for pair in pairs)
    assert torch.allclose(force, spring.force(hand / spring.reach, target), atol=1e-5) and len(ticks) > 90


def test_every_condition_has_a_key_that_exists():
    """Also the tenth, and those whose letters the window has for something else."""
    letters = ascii_lowercase
    conditions = [SimpleNamespace(letter=letter) for letter in letters]
    keys = condition_keys(conditions)
    assert list(keys.values()) == conditions and set(keys).isdisjoint(KEYS)
    assert list(keys)[:10] == [*"123456789", "j"] and all(keys[key].letter == key for key in "jklmnpqst")
    pygame.init()
    assert all(pygame.key.name(pygame.key.key_code(key)) == key for key in keys)


def test_the_same_keys_give_the_same_bytes(shipped, tmp_path):
    for name in ("one", "other"):
        played(shipped, tmp_path / name, 4.0, (50, "2"), (120, "8"))
    for file in sorted((tmp_path / "one").glob("*.tsv")):
        assert file.read_bytes() == (tmp_path / "other" / file.name).read_bytes()


def test_a_guidance_with_ua_waits_for_the_players_own_game(shipped, tmp_path):
    enough = MIN_DEMONSTRATION_TICKS
    game, screen = played(
        shipped,
        tmp_path,
        (enough + 150) * TABLE.tick,
        (100, "9"),  # refused
        (101, "x"),
        (150, "a"),  # too early
        (151, "x"),
        (enough + 50, "a"),
        (enough + 51, "x"),
        (enough + 60, "9"),
        (enough + 62, "x"),
    )
    notes = [note for _, note in screen.moments]
    assert any("needs a model of you" in note for note in notes) and any("s more" in note for note in notes)
    assert any("the user model is yours now" in note for note in notes)
    assert list(game.games) == ["01nhg", "02nhg", "03combhgutuasc"]
    models = shipped[0]
    own = models.adapted_to([demonstration(read_ticks(game.games["01nhg"].file))])
    for adapted, again in zip(game.adapted.values(True, True), own.values(True, True), strict=True):
        assert torch.equal(adapted, again)  # what was learned from is what was recorded
    ticks = read_ticks(game.games["03combhgutuasc"].file)
    assert ticks["w_sim"].notna().all() and game.games["03combhgutuasc"].facts["adapted"]
    general = read_ticks(game.games["01nhg"].file)
    assert len(general) == enough + 51 and not game.games["01nhg"].facts["adapted"]


def test_unguided_play_is_data_of_ones_own(shipped, tmp_path):
    game, _ = played(shipped, tmp_path / "anna", 12.0, (200, "2"), (300, "1"))
    found, facts = read_recordings(tmp_path, 50)
    assert list(found.people) == ["anna"] == [*read_recordings(game.games["01nhg"].file, 50)[0].people]
    assert facts["games"] == 2 and facts["left_out"]["games_with_guidance"] == 1
    for (observation, action), name in zip(found.people["anna"], ("01nhg", "03nhg"), strict=True):
        recorded = demonstration(read_ticks(game.games[name].file))
        assert torch.equal(observation, recorded[0]) and torch.equal(action, recorded[1])


def test_a_mouse_plays_where_it_points(shipped, tmp_path):
    models, conditions, opponents = shipped
    clock, mouse = SimulatedClock(), Mouse()
    seat = RealTimePlayer(InProcessServo(mouse, SafetyLimits()), NullDisplay(), clock, TABLE.tick, breath=0.0)
    game = FreePlay(conditions, models, opponents, 0, LOOKAHEAD, 60.0, seat, spawn_rng_states(1, [0], 0, 1), tmp_path)
    mouse.point(0.03, -0.06)
    game.run(conditions["1"], 1.0)
    ticks = read_ticks(game.games["01nhg"].file)
    assert np.allclose(ticks[["action_x", "action_y"]].iloc[-1], [0.4, -0.8], atol=1e-6)
    game = FreePlay(
        conditions, models, opponents, 0, LOOKAHEAD, 60.0, seat, spawn_rng_states(1, [0], 0, 1), tmp_path / "pushed"
    )
    game.run(conditions["2"], 4.0)
    ticks = read_ticks(game.games["01oahg"].file)
    pulled = ticks[["action_x", "action_y"]].to_numpy() - [0.4, -0.8]
    asked = ticks[["force_x", "force_y"]].to_numpy()
    assert np.abs(pulled).max() > 0.05  # guidance is felt as a pull on the cursor
    still = np.abs(np.diff(asked, axis=0)).max(axis=1) < 0.3
    assert np.mean(np.sum(pulled[1:] * asked[1:], axis=1)[still] > 0) > 0.7  # mostly toward where it pulls


def test_what_was_played_is_shown_again(shipped, tmp_path, monkeypatch):
    played(shipped, tmp_path / "play", 4.0, (100, "2"))
    for name, arguments, label in (
        ("last", [f"run={tmp_path}/play"], "OAHG (vanilla)"),
        ("first", [f"run={tmp_path}/play", "game=01nhg", "start=0.5"], "NHG"),
        ("file", [f"run={tmp_path}/play/task-airhockey_acq-01nhg_beh.tsv"], "NHG"),
    ):
        monkeypatch.setattr(sys, "argv", ["watch", "seconds=1", f"hydra.run.dir={tmp_path}/{name}", *arguments])
        start_command(watch.__name__)
        ticks = pd.read_csv(tmp_path / name / "watch.csv")
        assert len(ticks) == 50 and (tmp_path / name / "watch.gif").stat().st_size > 10_000
        assert (ticks["force_x"].abs().sum() > 0) == label.startswith("OAHG")
    assert pd.read_csv(tmp_path / "first" / "watch.csv")["time_s"].iloc[0] == 0.52


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run={folder}/play", "game=07nhg"], "game = 07nhg must be one of 01nhg"),
        (["run={folder}/play", "start=50"], "start = 50"),
        (["run={folder}/nowhere"], "nowhere"),
        (["run={folder}/play", "start=-1"], "start = -1 must be a finite number of at least 0"),
    ],
)
def test_what_was_not_played_is_refused(shipped, tmp_path, monkeypatch, capsys, arguments, message):
    played(shipped, tmp_path / "play", 0.4)
    arguments = [argument.format(folder=tmp_path) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["watch", f"hydra.run.dir={tmp_path}/run", *arguments])
    with pytest.raises(SystemExit) as stopped:
        start_command(watch.__name__)
    shown = capsys.readouterr().err
    assert stopped.value.code == 2 and shown.count("\n") == 1 and message in shown


def test_the_command_plays_in_real_time_and_says_how_it_went(tmp_path):
    done = start("guidance", "play", "device=simulated", "seconds=2", "breath=0", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    (game,) = load_games(tmp_path).values()
    assert len(read_ticks(game.file)) == 100
    assert "01 NHG, generation 55" in done.stdout and f"again: airhockey watch run={tmp_path}" in done.stdout
    description = json.loads(game.file.with_suffix(".json").read_text())
    assert description["felt_x"]["Units"] == "N"


def test_who_is_told_to_end_ends_well(tmp_path):
    command = Command("guidance", "play", "device=simulated", "seconds=600", f"hydra.run.dir={tmp_path}")
    while not list(tmp_path.glob("*_beh.tsv")) and command.poll() is None:
        time.sleep(0.01)
    time.sleep(0.5)
    os.kill(command.pid, signal.SIGTERM)
    done = command.wait()
    assert done.returncode == 0 and "again: airhockey watch" in done.stdout, done.stderr
    (game,) = load_games(tmp_path).values()
    assert len(read_ticks(game.file)) == pytest.approx(game.results["duration_s"] / TABLE.tick)
