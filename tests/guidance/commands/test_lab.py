"""The experiment, whole: a simulated person takes the seat, at a window and without one; nothing finished is lost."""

import json
import os
import signal
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pygame
import pytest

from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.config import CONF
from guidance.commands import evaluate, lab, play, report
from guidance.display.drawing import DEJAVU
from guidance.display.window import MIN_WIDTH, Window
from guidance.haptics.screen import SimulatedClock
from guidance.sessions.bids import Records
from guidance.sessions.game import read_ticks
from guidance.simulated_users.ratings import RATINGS
from tests.processes import Command, start

# people who do not adapt: no game of theirs depends on another
SMOKE = ["device=simulated", "window=false", "+preset=smoke", "users.adaptation=off"]


def here(module: ModuleType, *arguments: str) -> tuple[int, str, str]:
    """Run a command in this process, which saves seconds of imports: exit code, standard output and error."""
    said, complained, code = StringIO(), StringIO(), 0
    try:
        with redirect_stdout(said), redirect_stderr(complained):
            start_command(module.__name__, arguments)
    except SystemExit as stopped:
        code = stopped.code
    return code, said.getvalue(), complained.getvalue()


def take_part(folder: Path, participant: str, *more: str) -> tuple[int, str, str]:
    where = f"records={folder}/records", f"hydra.run.dir={folder}/run"
    return here(lab, *SMOKE, f"participant={participant}", *where, *more)


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> Path:
    """The records of two simulated people."""
    folder = tmp_path_factory.mktemp("lab")
    for label in ("S1", "S2"):
        code, said, complained = take_part(folder, label)
        assert code == 0, complained
        assert f"{label}: 9 of 9 games are played and rated." in said
    return folder


def test_a_session_is_the_study_of_simulated_people_in_another_seat(two):
    """The same order and columns as `evaluate`; and where no force differs in its course, the same game to the bit."""
    assert here(evaluate, "+preset=smoke", "users.adaptation=off", f"hydra.run.dir={two}/study")[0] == 0
    session, study = pd.read_csv(two / "records" / "trials.csv"), pd.read_csv(two / "study" / "trials.csv")
    study["user"] = study["user"].map({"S01": "S1", "S02": "S2"})
    study = study.dropna(subset="user")
    assert list(session) == list(study) and len(session) == len(study) == 18
    both = session.merge(study, on=["user", "condition"], suffixes=("", "_study"))
    assert (both["position"] == both["position_study"]).all() and (both["seed"] == 2021).all()
    unguided = both[both["condition"] == "nhg"]
    for name in ("win_rate", "mean_smash_speed", "defense_rate", "rounds", "duration_s", *RATINGS):
        assert np.array_equal(unguided[name], unguided[f"{name}_study"], equal_nan=True), name
    assert both["mean_disagreement"].isna().equals(both["mean_disagreement_study"].isna())
    counts = pd.read_csv(two / "records" / "counts.csv").merge(session, on=["user", "condition"], validate="1:1")
    assert len(counts) == 18 and counts["shots_faced"].sum() > 0
    np.testing.assert_allclose(counts["shots_stopped"] / counts["shots_faced"], counts["defense_rate"], rtol=1e-12)
    codebook = json.loads((two / "records" / "trials.json").read_text())
    assert list(codebook["columns"]) == list(session) and codebook["study"]["participants"] == "simulated people"
    assert "PROXY" in codebook["columns"]["comfort"]["description"]


def test_what_is_recorded_says_what_was_played(two):
    trials = pd.read_csv(two / "records" / "trials.csv").set_index(["user", "condition"])
    file = next((two / "records" / "sub-S1" / "beh").glob("*acq-oahgut_run-*_beh.tsv"))
    ticks, about = read_ticks(file), json.loads(file.with_suffix(".json").read_text())
    game = ticks[ticks["scored"] == 1]
    row = trials.loc["S1", "oahg_ut"]
    assert game["round"].max() == row["rounds"] and len(game) * 0.02 == pytest.approx(row["duration_s"])
    assert len(ticks) - len(game) == 50  # the familiarization, 1 s in this preset
    assert np.isclose(game["w_unc_optimal"].mean(), row["w_unc_optimal_mean"])
    assert about["Condition"] == "oahg_ut" and about["Ratings"] == {name: row[name] for name in RATINGS}
    assert about["Facts"]["title"] == "OAHG (UT)" and about["Facts"]["questions"].keys() == set(RATINGS)
    assert (about["Facts"]["pauses"], about["Facts"]["faults"], about["Facts"]["late_ticks"]) == (0, [], 0)
    assert (ticks["held"] == 1).all()
    assert "oahg" not in json.dumps(json.loads((two / "records" / "participants.json").read_text())).lower()


def test_the_report_takes_the_records_as_they_are(two):
    code, _, complained = here(report, f"runs={two}/records", f"out={two}/report", f"hydra.run.dir={two}/r")
    assert code == 0, complained
    assert (two / "report" / "report.html").is_file()


def test_somebody_withdraws(two):
    """Whatever else the command says: who wants to go need not know the study's configuration."""
    folder = two / "records"
    nowhere = here(lab, "participant=S1", "withdraw=true", f"records={two}/nowhere", f"hydra.run.dir={two}/run")
    assert nowhere[0] == 2 and "holds no study" in nowhere[2] and not (two / "nowhere").exists()
    code, _, complained = take_part(two, "S3", "withdraw=true")
    assert code == 2 and "withdraw = S3 must be one of those enrolled: S1, S2" in complained
    assert take_part(two, "new")[0] == 0
    (label,) = {path.name for path in folder.glob("sub-*")} - {"sub-S1", "sub-S2"}
    place = pd.read_csv(folder / "participants.tsv", sep="\t").set_index("participant_id")["place"]
    assert place[label] == 2
    who = f"participant={label.removeprefix('sub-')}", "withdraw=true"
    assert here(lab, *who, f"records={folder}", f"hydra.run.dir={two}/run", "device=mouse", "opponent=3")[0] == 0
    left = "".join(path.read_text() for path in folder.rglob("*") if path.is_file())
    assert not (folder / label).exists() and label.removeprefix("sub-") not in left
    assert set(pd.read_csv(folder / "trials.csv")["user"]) == {"S1", "S2"}


def test_a_session_that_is_killed_goes_on_and_ends_like_one_that_was_not(two, tmp_path):
    """At whatever moment it is."""
    session = session_of_s1(tmp_path)
    beh, rng, kills = tmp_path / "records" / "sub-S1" / "beh", np.random.default_rng(0), 0
    for wanted in rng.permutation(10)[:6]:  # games that are there when it is killed, and some time after
        if len(list(beh.glob("*run-[0-9]_beh.json"))) > wanted:
            continue
        command = Command(*session)
        while len(list(beh.glob("*run-[0-9]_beh.json"))) <= wanted and command.poll() is None:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.3))
        command.kill()
        kills += 1
    assert kills >= 2
    ends_alike(session, tmp_path, two)


def session_of_s1(folder: Path) -> list[str]:
    records, run = f"records={folder}/records", f"hydra.run.dir={folder}/run"
    return ["guidance", "lab", *SMOKE, "participant=S1", records, run]


def ends_alike(session: list[str], folder: Path, two: Path) -> None:
    """Go on with the session of S1 in this folder, to its end: its games are those of S1 in `two`."""
    done = start(*session)
    assert done.returncode == 0 and "9 of 9" in done.stdout, done.stderr
    again, whole = (pd.read_csv(place / "records" / "trials.csv") for place in (folder, two))
    pd.testing.assert_frame_equal(again, whole[whole["user"] == "S1"].reset_index(drop=True))
    files = list((folder / "records" / "sub-S1" / "beh").glob("*run-[0-9]_beh.tsv"))
    assert len(files) >= 9
    for file in files:
        assert file.read_bytes() == (two / "records" / "sub-S1" / "beh" / file.name).read_bytes()


@pytest.mark.slow
def test_twenty_kills_of_a_session_leave_no_trace(two, tmp_path):
    """At random moments, from before the first record on; a session that ends all the same is followed by another."""
    rng, kills, sessions, went_on = np.random.default_rng(1), 0, 1, 0
    while kills < 20:
        folder = tmp_path / f"{sessions}"
        session = session_of_s1(folder)
        beh = folder / "records" / "sub-S1" / "beh"
        before = len(list(beh.glob("*")))
        command = Command(*session)
        while rng.random() < 0.9995 and len(list(beh.glob("*"))) == before and command.poll() is None:
            time.sleep(0.01)  # seldom before it plays at all
        time.sleep(rng.uniform(0.0, 0.5))
        status = command.kill()
        if status == 0:
            ends_alike(session, folder, two)
            sessions += 1
            continue
        assert status == -signal.SIGKILL, command.stderr.read_text()
        kills, went_on = kills + 1, went_on + (before > 0)
    ends_alike(session, folder, two)
    assert went_on >= 10


class Reader(Window):
    """A window before which somebody presses the right keys: it remembers what it showed.

    Attributes:
        answer: keys that are pressed on a page that has them, before any other of its keys.
        leave_at: s, when escape is pressed in a game.
    """

    answer: tuple[str, ...] = ("y", "return")
    leave_at: float = float("inf")

    def __init__(self, *how, **more) -> None:
        super().__init__(*how, **more)
        self.read, self.titles, self.clocks = [], set(), {}
        Reader.last = self

    def press(self, *keys: str) -> None:
        for key in keys:
            text = key if len(key) == 1 else ""
            code = pygame.key.key_code(key)
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=code, unicode=text, mod=0))

    def page(self, page) -> str:
        self.read.append((page.title, page.text))
        return super().page(page)

    def _part(self, page) -> str:
        self.press(next(key for key in (*self.answer, *page.keys) if key in page.keys))
        return super()._part(page)

    def _wait(self) -> None:
        assert self.clock.now() < 3600, "a page waits for ever"
        super()._wait()

    def ask(self, items) -> dict[str, int]:
        self.read.append((items.title, " ".join(items.items.values())))
        self.press("3", "4", "5", "6", "return")
        return super().ask(items)

    def write_down(self, page) -> str:
        self.press("o", "k", "return")
        return super().write_down(page)

    def frame(self, moment) -> list[str]:
        self.titles.add(moment.title)
        self.clocks[moment.title] = moment.seconds
        if moment.title == self.texts["practice.running"] and self.clock.now() > 1.0:
            self.press("return")
        if self.clock.now() > self.leave_at:
            self.press("escape")
        return super().frame(moment)


@pytest.fixture
def at_a_window(monkeypatch, tmp_path):
    """P1's session at a window, as the command holds it, but for the clock."""
    monkeypatch.setattr("guidance.haptics.screen.WallClock", SimulatedClock)
    monkeypatch.setattr("guidance.display.window.Window", Reader)

    def session(*more: str, **habits) -> tuple[Reader, str]:
        for name, value in habits.items():
            monkeypatch.setattr(Reader, name, value)
        where = f"records={tmp_path}/records", f"hydra.run.dir={tmp_path}/run"
        how = "device=simulated", "+preset=smoke", "participant=P1", "breath=0.2", f"width={MIN_WIDTH}"
        code, said, complained = here(lab, *how, *where, *more)
        assert code == 0, complained
        return Reader.last, said

    return session, tmp_path / "records"


def test_who_does_not_consent_plays_nothing(at_a_window):
    session, folder = at_a_window
    window, said = session(answer=("n",))
    assert "P1 does not take part" in said and [title for title, _ in window.read] == ["Before you take part"]
    assert not list(folder.glob("sub-*")) and "P1" not in (folder / "participants.tsv").read_text()
    assert json.loads((folder / "manifest.json").read_text())["withdrawals"] == 0
    assert "P1" not in "".join(path.read_text() for path in folder.parent.rglob("*") if path.is_file())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signals_before_the_consent_leave_nobody_enrolled(at_a_window, monkeypatch, number):
    """However many, and also while what is there of the person is deleted."""
    session, folder = at_a_window
    withdraw, before = Records.withdraw, signal.getsignal(number)

    def signaled(*arguments, **options):
        os.kill(os.getpid(), number)
        return withdraw(*arguments, **options)

    monkeypatch.setattr(Records, "withdraw", signaled)
    _, said = session(page=signaled)
    assert "P1 does not take part" in said
    assert not list(folder.glob("sub-*")) and "P1" not in (folder / "participants.tsv").read_text()
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("others", [("1_01", "10_1"), ("12e3", "12000"), ("true", "True1"), ("1e400", "007")])
def test_similar_labels_are_different_people(tmp_path, others):
    """And each is withdrawn by their own."""
    folder = tmp_path / "records"
    records = ["device=simulated", "window=false", "+preset=smoke", f"records={folder}", f"hydra.run.dir={tmp_path}"]
    valid = [label for label in others if label.isalnum()]
    with Records(folder, {"study_hash": "0", "seed": 0}) as study:
        for label in valid:
            study.participant(label).give_consent("text")
    for label in others:
        code, _, complained = here(lab, *records, f"participant={label}", "withdraw=true")
        assert (code == 0) == (label in valid), complained
        assert label in valid or f"participant = '{label}'" in complained or f"withdraw = {label}" in complained
        valid = [other for other in valid if other != label]
        assert {path.name for path in folder.glob("sub-*")} == {f"sub-{other}" for other in valid}


def test_a_session_at_a_window_shows_every_page_and_never_the_condition(at_a_window):
    session, folder = at_a_window
    window, said = session(leave_at=30.0)  # in some game
    assert "It goes on with participant=P1." in said
    begun = len(pd.read_csv(folder / "trials.csv"))
    assert 1 <= begun < 9
    again, said = session(leave_at=float("inf"))
    assert "P1: 9 of 9 games are played and rated." in said
    trials = pd.read_csv(folder / "trials.csv")
    assert len(trials) == 9 and (trials[list(RATINGS)] == [3, 4, 5, 6]).all(axis=None)
    (file,) = list(folder.rglob("*acq-nhg_run-*_beh.json"))
    assert json.loads(file.read_text())["Interview"] == "ok"
    first, second = [title for title, _ in window.read], [title for title, _ in again.read]
    assert first[:4] == ["Before you take part", "Practice", "A first game", "Game 1 of 9"]
    assert second[-1] == "Thank you" and len([title for title in second if title.endswith("guidance?")]) == 9 - begun
    shown = " ".join([*(f"{title} {text}" for title, text in window.read + again.read), *window.titles, *again.titles])
    assert not any(name in shown for name in ("OAHG", "UPHG", "CombHG", "NHG"))


def test_without_its_device_nobody_is_enrolled(tmp_path):
    for device in ("forcedimension", "gamepad"):
        where = f"records={tmp_path}/{device}", f"hydra.run.dir={tmp_path}/run"
        code, _, complained = here(lab, "participant=new", f"device={device}", *where)
        assert code == 2 and complained.startswith("error: device: ") and complained.count("\n") == 1, complained
        assert not (tmp_path / device).exists()  # and no study begun, which another device could then not go on with


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["participant=../../x"], "participant = '../../x' must be 1 to 16 letters and digits"),
        (["device=mouse"], "window = false must be true for device = mouse"),
        (["device=omega"], "device = omega must be one of forcedimension, gamepad, mouse, simulated"),
        (["consent=nowhere.txt"], "consent = nowhere.txt must be a file with a text"),
        (["~questions.comfort"], "error: questions.comfort is missing"),
        (["scale=[a]"], "error: scale.1 is missing"),
        (["scale=[a,b,c]"], "error: scale.2: no such text"),
        (["questions=fr"], "questions = fr must be one of de, en"),
        (["questions=nowhere.yaml"], "questions = nowhere.yaml: there is no such file"),
        (["texts.notes.goal="], "error: texts.notes.goal = '' must be a text"),
        (["texts.next_game.title=Spiel {nummer}"], "{nummer} must be one of the placeholders: {games}, {number}"),
        (["questions.comfort=Gut {so}?"], "questions.comfort: {so} must be one of the placeholders: there are none"),
        (["withdraw=perhaps"], "withdraw = perhaps must be true or false"),
        (["breath=-1"], "breath = -1 must be a finite number of at least 0 and at most 10"),
        (["safety.speed=0"], "safety.speed = 0 must be a finite number above 0"),
        (["opponent=1000"], "generation = 1000"),
        (["users.adaptation=maybe"], "users.adaptation = 'maybe' must be on or off"),
        (["users.variant=V9"], "users.variant = 'V9' must be one of passive, comply_or_resist, goal_sharing"),
        (["participants=0"], "participants = 0 must be a whole number of at least 1"),
    ],
)
def test_wrong_values_end_in_one_line_and_leave_nothing(monkeypatch, capsys, tmp_path, arguments, message):
    given = [] if any(argument.startswith("participant=") for argument in arguments) else ["participant=P1"]
    device = [] if any(argument.startswith("device=") for argument in arguments) else ["device=simulated"]
    run = ["window=false", f"records={tmp_path}/records", f"hydra.run.dir={tmp_path}/run"]
    arguments = [*device, *given, *run, *arguments]
    monkeypatch.setattr("guidance.sessions.session.Session", None)
    with pytest.raises(SystemExit) as stopped:
        start_command(lab.__name__, arguments)
    shown = capsys.readouterr().err
    assert stopped.value.code == 2 and shown.count("\n") == 1 and message in shown, shown
    assert not list(tmp_path.rglob("sub-*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("  comfort: How", "  comfy: How"), "{file}: questions.comfy: no such text; did you mean questions.comfort?"),
        (("    goal: goal!\n", ""), "{file}: texts.notes.goal is missing"),
        (("goal: goal!", "goal: 3"), "{file}: texts.notes.goal = 3 must be a text"),
        (("{seconds} s are", "{second} s are"), "{file}: texts.every_game.familiarization: {{second}} must be one of"),
        (("{seconds} s are", "{seconds s are"), "{file}: texts.every_game.familiarization: expected '}}' before end"),
        (("{seconds} s are", "{seconds!r} s are"), "{{seconds!r}} must be one of the placeholders: {{seconds}}"),
        (("scale: [", "scale: ["), None),
        (("texts:", "\ttexts:"), "{file} is no yaml of ours"),
    ],
)
def test_a_yaml_of_texts_is_checked(monkeypatch, tmp_path, change, message):
    file = tmp_path / "my größe.yaml"
    text = (CONF / "questions" / "en.yaml").read_text(encoding="utf-8")
    assert change[0] in text
    file.write_text("\ufeff" + text.replace(*change), encoding="utf-8")
    started = StringIO()
    monkeypatch.setattr(
        "guidance.sessions.session.Session.run", lambda session: started.write(repr(session.plan.texts))
    )
    code, _, complained = take_part(tmp_path, "P1", f"questions={file}")
    if message is None:
        assert code == 0 and "Before you take part" in started.getvalue(), complained
    else:
        assert code == 2 and message.format(file=file) in complained and complained.count("\n") == 1, complained
        assert not (tmp_path / "records").exists() and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"Gr\xfc\xdfe", "must be saved as UTF-8: line 1 has the byte 0xfc"),
        ("Text\nGrüße".encode("utf-16"), "must be saved as UTF-8: line 1 has the byte 0xff"),
        (b" \n", "must hold a text"),
        (b"\xef\xbb\xbf", "must hold a text"),
        (b"There are {game} games.", "{game} must be one of the placeholders: {games}"),
        ("동의서".encode(), "has 동 서 의, for which there is no font: install one"),
        ("\u05e9\u05dc\u05d5\u05dd".encode(), "has \u05e9 \u05dc \u05d5 \u05dd, which the window cannot join or order"),
        ("यह".encode(), "for which there is no font"),
        ("हिन्दी".encode(), "which the window cannot join or order"),
        ("soft\u00adhyphen \u0000".encode(), "has U+00AD U+0000, which"),
    ],
)
def test_a_consent_that_nobody_could_read_is_refused(tmp_path, content, message):
    consent = tmp_path / "consent.txt"
    consent.write_bytes(content)
    code, _, complained = take_part(tmp_path, "P1", "window=true", f"consent={consent}")
    assert code == 2 and f"consent = {consent} " in complained.replace(": ", " ") and message in complained, complained
    assert complained.count("\n") == 1 and not (tmp_path / "records").exists()


@pytest.mark.parametrize("typed", ["questions.comfort=편안했습니까?", "scale=[gar nicht, 매우]"])
def test_an_item_without_glyphs_is_refused(tmp_path, typed):
    code, _, complained = take_part(tmp_path, "P1", "window=true", typed)
    assert code == 2 and "for which there is no font" in complained and typed.partition("=")[0] in complained
    assert not (tmp_path / "records").exists()


def test_a_font_that_is_chosen_is_used(at_a_window, tmp_path):
    session, folder = at_a_window
    (tmp_path / "consent.txt").write_text("동의서", encoding="utf-8")
    glyphs = DEJAVU.with_name("LastResortHE-Regular.ttf")
    _, said = session(
        "questions.comfort=편안했습니까?", f"consent={tmp_path}/consent.txt", f"font={glyphs}", leave_at=1.0
    )
    assert "It goes on" in said
    assert json.loads((folder / "sub-P1" / "sub-P1_consent.json").read_text())["text"] == "동의서"
    (tmp_path / "no.ttf").write_text("no font")
    code, _, complained = take_part(tmp_path, "P1", "window=true", f"font={tmp_path}/no.ttf")
    assert code == 2 and f"font = {tmp_path}/no.ttf must be a font file" in complained


def test_no_byte_order_mark_and_no_carriage_return_are_in_the_record(at_a_window, tmp_path):
    session, folder = at_a_window
    (tmp_path / "consent.txt").write_bytes("\ufeffOne\r\ngame, {games} more: e\u0301\r".encode())
    session(f"consent={tmp_path}/consent.txt", leave_at=1.0)
    record = json.loads((folder / "sub-P1" / "sub-P1_consent.json").read_text())
    assert record["text"] == "One\ngame, 9 more: \u00e9\n"


def test_a_session_in_german(at_a_window):
    session, folder = at_a_window
    item = "Wie angenehm, alles in allem, war's: „gut“ oder (eher) nicht?"
    german = "questions=de", f"questions.comfort={item}"
    window, said = session(*german, leave_at=30.0)
    assert "It goes on" in said
    titles = [title for title, _ in window.read]
    assert titles[:4] == ["Bevor Sie teilnehmen", "Übung", "Ein erstes Spiel", "Spiel 1 von 9"]
    assert "Übung: Eingabetaste beendet sie" in window.titles
    assert window.clocks["Übung: Eingabetaste beendet sie"] > 0.5  # the clock of the practice runs
    game = json.loads(next(folder.rglob("*run-1_beh.json")).read_text())
    assert game["Facts"]["questions"]["comfort"] == item and game["Facts"]["scale"] == ["überhaupt nicht", "sehr"]
    code, _, complained = take_part(folder.parent, "P1", "breath=0.2", "questions=en")
    assert code == 2 and "holds a study with" in complained and len(complained) < 700, complained


@pytest.mark.parametrize(
    ("driver", "message"), [("", "window: there is no display here"), ("x11", "window: it cannot be opened with")]
)
def test_without_a_display_nothing_is_left(monkeypatch, tmp_path, driver, message):
    """Of a session, nor of a game: no records, and no run folder."""
    pygame.display.quit()
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    if not driver:
        monkeypatch.delenv("SDL_VIDEODRIVER")
        monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    outputs = f"hydra.run.dir={tmp_path}/outputs/day/time"
    commands = (play, ["device=simulated", "seconds=1"]), (lab, ["device=mouse", "participant=new"])
    for command, arguments in commands:
        code, _, complained = here(command, *arguments, outputs, *[f"records={tmp_path}/r"] * (command == lab))
        assert code == 2 and f"error: {message}" in complained and complained.count("\n") == 1, complained
        assert not list(tmp_path.iterdir())


def test_there_are_as_many_places_as_the_order_is_balanced_for(monkeypatch, two):
    for other in ("participants=2", "scale=[wenig,viel]", "safety.force=2", "breath=2"):
        code, _, complained = take_part(two, "S9", other)
        assert code == 2 and f"holds a study with {other.partition('=')[0]} = " in complained  # not in these records
    folder = two / "full"
    monkeypatch.setattr("guidance.sessions.session.Session.run", lambda s: s.participant.give_consent(s.plan.consent))
    assert take_part(folder, "S1", "participants=1")[0] == 0
    code, _, complained = take_part(folder, "S2", "participants=1")
    assert code == 2 and "participants = 1: all places are taken" in complained
    assert not (folder / "records" / "sub-S2").exists()
