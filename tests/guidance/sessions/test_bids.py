"""The records of people: complete games, one study per folder, and no loss by a kill at any moment."""

import errno
import hashlib
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from guidance.forces.conditions import GuidanceOutput
from guidance.sessions.bids import TRIALS, Records
from guidance.sessions.game import RESULTS, UNSCORED, read_ticks
from guidance.sessions.participant import NOT_LABELS
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.design import CONDITIONS
from guidance.statistics.groups import gather, merge
from guidance.study.metrics import METRIC_COUNTERS
from guidance.study.metrics import metric_values as metrics_of

FACTS = {"study_hash": "ab12" * 16, "seed": 7, "config": {"participants": 20}}
COLUMNS = {
    "t": {"Description": "time since the game began", "Units": "s"},
    "hand_x": {"Description": "the hand, along the table", "Units": "m"},
    "force_x": {"Description": "the guiding force, along the table", "Units": "N"},
    "scored": {"Description": "1 from the scored game on", "Units": "1"},
}
NAMES = [UNSCORED, *CONDITIONS]
TABLES = {"trials.csv", "trials.json", "trials_wide.csv", "counts.csv", "counts.json"}


def ticks_of(label: str, name: str, round_: int, n: int = 4) -> pd.DataFrame:
    rng = np.random.default_rng([*label.encode(), *name.encode(), round_])
    return pd.DataFrame(rng.normal(size=(n, 3)), columns=["t", "hand_x", "force_x"]).assign(scored=round_ > 0)


def results_of(label: str, name: str) -> dict[str, float]:
    rng = np.random.default_rng([*label.encode(), *name.encode()])
    results = dict(zip(RESULTS, rng.uniform(0, 1, len(RESULTS)), strict=True)) | {"rounds": 8}
    return results | ({"mean_disagreement": np.nan, "w_sim_mean": np.nan} if name in ("nhg", UNSCORED) else {})


def ratings_of(label: str, name: str) -> dict[str, int]:
    rng = np.random.default_rng([9, *label.encode(), *name.encode()])
    return dict(zip(RATINGS, rng.integers(1, 8, len(RATINGS)), strict=True))


def play(records: Records, label: str, names=NAMES, tell=lambda what: None) -> None:
    """What the lab does with a person: everything that is not done yet, in their order."""
    person = records.participant(label)
    person.give_consent("I take part.")
    for position, name in enumerate(names):
        if name not in person.games:
            with person.begin_game(name, position, COLUMNS) as recording:
                for round_ in range(3):
                    recording.append(ticks_of(label, name, round_).to_dict("records"))
                recording.finish(results_of(label, name))
            tell(f"{label} {name}")
        if name != UNSCORED and person.games[name].ratings is None:
            person.save_ratings(name, ratings_of(label, name), '=it was fine\t\n"fine" \ud800')
            tell(f"{label} {name} rated")


def content_of(folder: Path) -> dict[str, bytes]:
    """All files, but for the lock and the time of consent."""
    files = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    for name in files:
        if name.endswith("_consent.json"):
            files[name] = json.dumps(json.loads(files[name]) | {"time": ""}).encode()
    return {name: content for name, content in files.items() if name != ".lock"}


def child(task) -> int:
    """A process of its own that does this task, by fork: the modules are there at once."""
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            task()
            status = 0
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(status)
    return pid


def status_of(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.fixture
def folder(tmp_path) -> Path:
    return tmp_path / "study"


@pytest.fixture
def records(folder):
    with Records(folder, FACTS) as opened:
        yield opened


def begun(records: Records, label: str = "P01", name: str = UNSCORED, position: int = 0):
    person = records.participant(label)
    person.give_consent("I take part.")
    return person, person.begin_game(name, position, COLUMNS, {"device": "none"})


def test_a_study_is_laid_out_as_bids_has_it(records, folder):
    play(records, "P01", NAMES[:3])
    assert sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()) == [
        ".bidsignore",
        ".lock",
        "README",
        "counts.csv",
        "counts.json",
        "dataset_description.json",
        "manifest.json",
        "participants.json",
        "participants.tsv",
        "sub-P01/beh/sub-P01_task-airhockey_acq-nhg_run-1_beh.json",
        "sub-P01/beh/sub-P01_task-airhockey_acq-nhg_run-1_beh.tsv",
        "sub-P01/beh/sub-P01_task-airhockey_acq-oahg_run-2_beh.json",
        "sub-P01/beh/sub-P01_task-airhockey_acq-oahg_run-2_beh.tsv",
        "sub-P01/beh/sub-P01_task-airhockey_acq-unscored_run-0_beh.json",
        "sub-P01/beh/sub-P01_task-airhockey_acq-unscored_run-0_beh.tsv",
        "sub-P01/sub-P01_consent.json",
        "trials.csv",
        "trials.json",
        "trials_wide.csv",
    ]
    assert set((folder / ".bidsignore").read_text().split()) >= TABLES
    assert (folder / "participants.tsv").read_text() == "participant_id\tplace\nsub-P01\t0\n"
    dataset = json.loads((folder / "dataset_description.json").read_text())
    assert {"Name", "BIDSVersion", "DatasetType", "GeneratedBy"} <= set(dataset)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest == FACTS | {"participants": "people", "withdrawals": 0}
    table = folder / "sub-P01/beh/sub-P01_task-airhockey_acq-nhg_run-1_beh.tsv"
    described = json.loads(table.with_suffix(".json").read_text())
    for column in table.read_text().splitlines()[0].split("\t"):
        assert described[column] == COLUMNS[column]
    assert described["Results"]["mean_disagreement"] is None and described["Ratings"] == ratings_of("P01", "nhg")


def test_trials_have_the_columns_of_the_simulated_study(records, folder):
    weights = [f"{weight}_{part}" for weight in GuidanceOutput._fields[1:] for part in ("mean", "sd")]
    objective = list(metrics_of(np.zeros(1, METRIC_COUNTERS)))
    columns = ["user", "condition", "position", *objective, *RATINGS, "rounds", "duration_s", *weights, "seed"]
    assert columns == TRIALS and (folder / "trials.csv").read_text().strip() == ",".join(columns)
    for label in ("P02", "P01"):
        play(records, label, NAMES[:4])
    trials = merge([folder])
    assert trials["user"].tolist() == ["P02", "P01"] * 3  # by places
    assert trials["condition"].tolist() == ["nhg"] * 2 + ["oahg"] * 2 + ["oahg_ut"] * 2
    expected = results_of("P01", "oahg") | ratings_of("P01", "oahg") | {"position": 2, "seed": 7}
    row = trials[(trials["user"] == "P01") & (trials["condition"] == "oahg")].iloc[0]
    assert {name: row[name] for name in expected} == expected
    assert np.isnan(trials.loc[trials["condition"] == "nhg", "mean_disagreement"]).all()
    pd.testing.assert_frame_equal(records.trials(), trials, check_dtype=False, check_exact=True)


def test_the_report_reads_the_records_of_an_unfinished_study(records, folder):
    play(records, "P01", NAMES)
    for label in ("P02", "P03"):
        play(records, label, NAMES[:4])  # up to OAHG (UT)
    group = gather([folder])
    assert group.people and group.size == 3 and group.planned == 20 and not group.withdrawn
    tests = group.tests.query("family == 'OAHG'")
    assert set(tests["n"]) == {3} and tests["p"].notna().all()
    assert group.tests.query("family == 'CombHG'")["p"].isna().all()


NUMBERS = st.one_of(st.none(), st.floats(), st.floats(width=32).map(np.float32), st.integers(-(2**53), 2**53))


@settings(max_examples=60)
@given(st.lists(st.fixed_dictionaries({}, optional=dict.fromkeys(COLUMNS, NUMBERS)), max_size=20))
def test_ticks_come_back_with_the_same_bits(rows):
    with tempfile.TemporaryDirectory() as folder, Records(folder, FACTS) as records:
        _, recording = begun(records)
        for part in (rows[:3], rows[3:]):
            recording.append(part)
        ticks = read_ticks(recording.finish(results_of("P01", UNSCORED)).file)
        assert list(ticks) == list(COLUMNS) and len(ticks) == len(rows)
        for column in COLUMNS:
            expected = [np.nan if row.get(column) is None else float(row[column]) for row in rows]
            got = ticks[column].to_numpy(float)
            assert np.array_equal(got, expected, equal_nan=True)
            assert np.array_equal(np.signbit(got[got == 0]), np.signbit([value for value in expected if value == 0]))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"t": "=1+1"}], r"ticks\.t = '=1\+1' must be a number"),
        ([{"t": 0.0}, {"t": 1j}], r"ticks\.t = 1j must be a number"),
    ],
)
def test_ticks_are_numbers(records, rows, message):
    _, recording = begun(records)
    recording.append([{"t": 0.5}])
    with pytest.raises(ValueError, match=message):
        recording.append(rows)
    assert read_ticks(recording.finish(results_of("P01", UNSCORED)).file)["t"].tolist() == [0.5]


LABELS = st.text(st.sampled_from("abcXYZ019"), min_size=1, max_size=16) | st.from_regex(
    r"[A-Za-z0-9]{1,16}", fullmatch=True
)


@settings(max_examples=40)
@given(st.lists(LABELS.filter(lambda label: label.lower() not in NOT_LABELS), unique_by=str.lower, max_size=4))
def test_every_label_names_one_person(labels):
    with tempfile.TemporaryDirectory() as folder:
        with Records(folder, FACTS) as records:
            for place, label in enumerate(labels):
                play(records, label, NAMES[:2])
                assert records.participant(label).place == place
                if label.swapcase() != label:
                    with pytest.raises(ValueError, match="in more than capitals"):
                        records.participant(label.swapcase())
        with Records(folder, FACTS) as records:
            assert list(records.places) == labels
        assert {path.name for path in Path(folder).glob("sub-*")} == {f"sub-{label}" for label in labels}
        if labels:
            assert merge([folder])["user"].tolist() == labels


@settings(max_examples=200)
@given(label=st.text() | st.sampled_from(["../P01", "P01/..", "P01\n", "", "P" * 17, "NA", "nan", "NULL", "É1", "=P1"]))
def test_what_is_no_label_is_refused_before_anything_is_written(label, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "no-labels"
    with Records(folder, FACTS) as records:
        before = content_of(folder)
        good = label.isascii() and label.isalnum() and len(label) <= 16 and label.lower() not in NOT_LABELS
        if not good:
            with pytest.raises(ValueError, match="must be 1 to 16 letters and digits"):
                records.participant(label)
            with pytest.raises(ValueError, match="must be one of those enrolled: nobody"):
                records.withdraw(label)
            assert content_of(folder) == before


def test_who_was_enrolled_and_never_consented_is_nobody(folder):
    """Their session was killed; the next one, a withdrawal too, finds nothing of them."""
    with Records(folder, FACTS) as records:
        play(records, "P01", NAMES[:2])
        records.participant("P02"), records.participant("P03").give_consent("text")
    with Records(folder, FACTS) as records:
        assert list(records.places) == ["P01", "P03"] and not (folder / "sub-P02").exists()
        assert records.manifest["withdrawals"] == 0
        records.withdraw("P02")  # is done already
        with pytest.raises(ValueError, match="withdraw = P02 must be one of those enrolled: P01, P03"):
            records.withdraw("P02")
        assert records.participant("P04").place == 1


def test_labels_that_are_drawn_are_unlike_each_other(records, monkeypatch):
    drawn = iter("2222222222223333334" + "5" * 100)
    monkeypatch.setattr("guidance.sessions.bids.secrets.choice", lambda letters: next(drawn))
    assert [records.participant().label for _ in range(3)] == ["P222222", "P333333", "P455555"]
    monkeypatch.undo()
    labels = {records.participant(None).label for _ in range(30)}
    assert len(labels) == 30 and not set("".join(labels)) & set("01ILOAEU")


def test_places_are_the_smallest_that_are_free(records, folder):
    assert [records.participant(label).place for label in ("P01", "P02", "P03")] == [0, 1, 2]
    records.withdraw("P02")
    records.withdraw("P01")
    assert [records.participant(label).place for label in ("P04", "P05", "P06", "P04")] == [0, 1, 3, 0]
    assert records.manifest["withdrawals"] == 2
    lines = (folder / "participants.tsv").read_text().splitlines()
    assert lines[1:] == ["sub-P04\t0", "sub-P05\t1", "sub-P03\t2", "sub-P06\t3"]


def test_a_withdrawal_leaves_no_data(records, folder):
    play(records, "P01", NAMES[:3])
    play(records, "Gone", NAMES[:3])
    stale = records.participant("Gone")
    records.withdraw("Gone")
    for name, content in content_of(folder).items():
        assert b"Gone" not in content and "Gone" not in name, name
    assert set(records.trials()["user"]) == {"P01"}
    assert json.loads((folder / "manifest.json").read_text()) == FACTS | {"participants": "people", "withdrawals": 1}
    with pytest.raises(ValueError, match="withdraw = Gone must be one of those enrolled: P01"):
        records.withdraw("Gone")
    with pytest.raises(ValueError, match="Gone does not take part any more"):
        stale.begin_game("uphg", 5, COLUMNS)


def test_another_study_is_refused(records, folder):
    play(records, "P01", NAMES[:2])
    records.close()
    before = content_of(folder)
    for facts, message in (
        (FACTS | {"seed": 8}, "holds a study with seed = 7 and not 8:"),
        (FACTS | {"study_hash": "cd"}, "holds a study with study_hash = ab12.* and not cd:"),
        ({"seed": 7}, "lacks study_hash"),
    ):
        with pytest.raises(ValueError, match=message) as refusal:
            Records(folder, facts)
        assert "\n" not in str(refusal.value)
    assert content_of(folder) == before
    Records(folder, FACTS | {"seconds": 3.0}).close()  # what does not make another study


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match=r"holds thesis\.tex, but no study: no manifest\.json"):
        Records(tmp_path, FACTS)
    (tmp_path / "manifest.json").write_text(json.dumps(FACTS))
    with pytest.raises(ValueError, match="not one of the laboratory"):
        Records(tmp_path, FACTS)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest\.json is not JSON"):
        Records(tmp_path, FACTS)


@pytest.mark.parametrize(
    "lines", ["sub-P01\t0\nsub-P02\t0", "sub-P01\t0\nsub-P01\t1", "sub-../x\t0", "P01\t0", "sub-P01"]
)
def test_participants_that_were_tampered_with_are_refused(records, folder, lines):
    records.close()
    (folder / "participants.tsv").write_text(f"participant_id\tplace\n{lines}\n")
    with pytest.raises(ValueError, match=r"participants\.tsv: the line"):
        Records(folder, FACTS)


def test_one_process_at_a_time_has_the_folder(records, folder):
    with pytest.raises(ValueError, match=f"in use by process {os.getpid()}; one at a time"):
        Records(folder, FACTS)
    records.close()
    ready, tell = os.pipe()

    def hold():
        records = Records(folder, FACTS)
        os.write(tell, b"1")
        time.sleep(60)
        records.close()

    pid = child(hold)
    os.read(ready, 1)
    with pytest.raises(ValueError, match=f"in use by process {pid}; one at a time"):
        Records(folder, FACTS)
    os.kill(pid, signal.SIGKILL)
    status_of(pid)
    Records(folder, FACTS).close()


def test_consent_comes_first_and_is_to_one_text(records):
    person = records.participant("P01")
    with pytest.raises(ValueError, match="P01 has not consented"):
        person.begin_game(UNSCORED, 0, COLUMNS)
    with pytest.raises(ValueError, match="must be a text"):
        person.give_consent(" \n")
    person.give_consent("I take part. §1")
    given_ = records.participant("P01").consent
    assert given_["text"] == "I take part. §1"
    assert given_["sha256"] == hashlib.sha256("I take part. §1".encode()).hexdigest()
    assert pd.Timestamp(given_["time"]).tz is not None
    person.give_consent("I take part. §1")
    assert records.participant("P01").consent == given_
    with pytest.raises(ValueError, match="has consented to another text"):
        person.give_consent("I take part in something else.")


@pytest.mark.parametrize(
    ("name", "position", "message"),
    [
        ("oahg", 4, "has played oahg already, at position 1"),
        ("uphg", 1, "has played oahg already, at position 1"),
        ("o_ahg", 2, "has played oahg already"),  # the same file name
        ("../uphg", 2, "condition = '../uphg' must be small letters"),
    ],
)
def test_a_game_is_played_once(records, name, position, message):
    person, recording = begun(records, name="oahg", position=1)
    with pytest.raises(ValueError, match="this game is running"):
        person.begin_game("uphg", 2, COLUMNS)
    with pytest.raises(ValueError, match="this game is running"):
        records.participant("P01")
    with pytest.raises(ValueError, match="this game is running"):
        records.withdraw("P01")
    recording.finish(results_of("P01", "oahg"))
    with pytest.raises(ValueError, match=message):
        person.begin_game(name, position, COLUMNS)


def test_results_are_what_trials_have(records):
    person, recording = begun(records)
    good = results_of("P01", UNSCORED)
    game = recording.finish(good | {"win_rate": 0.1, "rounds": 9})
    assert game.results["win_rate"] == 0.1 and game.results["rounds"] == 9
    assert person.games == {UNSCORED: game} and game.facts == {"device": "none"}
    for late in (lambda: recording.finish(good), lambda: recording.append([{"t": 1.0}])):
        with pytest.raises(ValueError, match="the game unscored is not running"):
            late()


def test_a_game_is_rated_once(records):
    play(records, "P01", NAMES[:1])
    person, recording = begun(records, name="oahg", position=1)
    good = dict.fromkeys(RATINGS, 4)
    with pytest.raises(ValueError, match="has not played oahg"):
        person.save_ratings("oahg", good)
    recording.finish(results_of("P01", "oahg"))
    with pytest.raises(ValueError, match="unscored: this game is not rated"):
        person.save_ratings(UNSCORED, good)
    person.save_ratings("oahg", good, "@SUM(1)")
    person.save_ratings("oahg", good, "@SUM(1)")
    with pytest.raises(ValueError, match="ratings of oahg: there are some already"):
        person.save_ratings("oahg", good | {"comfort": 5}, "@SUM(1)")
    assert records.participant("P01").games["oahg"].interview == "@SUM(1)"
    assert "SUM" not in (records.folder / "trials.csv").read_text()


def test_an_interrupted_game_is_kept_and_counts_for_nothing(records, folder):
    for attempt in range(3):
        person, recording = begun(records)
        recording.append([{"t": float(attempt)}])
        if attempt == 1:
            recording.close()  # as after an exception: the same process begins again
            records.set_active(recording)
        else:  # as after a crash
            records.close()
            records = Records(folder, FACTS)
    person, recording = begun(records)
    recording.append([{"t": 3.0}])
    game = recording.finish(results_of("P01", UNSCORED))
    kept = sorted(folder.glob("sub-P01/beh/*_desc-interrupted*_beh.tsv"))
    assert [path.name.split("_")[-2] for path in kept] == [f"desc-interrupted{k}" for k in (1, 2, 3)]
    assert [float(path.read_text().splitlines()[1].split("\t")[0]) for path in kept] == [0.0, 1.0, 2.0]
    for path in kept:
        described = json.loads(path.with_suffix(".json").read_text())
        assert described["t"] == COLUMNS["t"] and "Results" not in described
    assert read_ticks(game.file)["t"].tolist() == [3.0]
    assert list(person.games) == [UNSCORED] and not list(folder.rglob("*partial*"))
    records.close()


def test_the_clock_decides_nothing(records, folder, monkeypatch):
    play(records, "P01", NAMES[:4])
    before = content_of(folder)
    for file in folder.rglob("*"):
        when = random.Random(file.name).uniform(0, 2e9)
        os.utime(file, (when, when))
    records.close()
    with Records(folder, FACTS) as again:
        assert list(again.participant("P01").games) == NAMES[:4]
        play(again, "P01", NAMES[:4])
    assert content_of(folder) == before


@pytest.mark.parametrize("broken", ["replace", "fsync", "pwrite"])
def test_a_disk_that_fails_takes_nothing_and_can_be_mended(records, folder, monkeypatch, broken):
    """Every step of a session fails at the first of the calls that it makes, then at the second, until it is done."""
    real, failing_at, failures = getattr(os, broken), None, 0

    def failing(*arguments, **more):
        nonlocal failing_at
        if failing_at is not None:
            failing_at -= 1
            if failing_at < 0:
                failing_at = None
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*arguments, **more)

    monkeypatch.setattr(os, broken, failing)

    def stubborn(step):
        nonlocal failing_at, failures
        for calls in count():
            before, failing_at = content_of(folder), calls
            try:
                return step()
            except OSError as error:
                failures += 1
                assert error.errno == errno.ENOSPC
                assert "cannot be written: No space left on device. What was saved before is as it was" in str(error)
                assert str(folder) in str(error)
                after = content_of(folder)
                assert after["trials.csv"] in (before["trials.csv"], records.trials().to_csv(index=False).encode())
                for name, content in before.items():
                    if name == "participants.tsv":
                        assert after[name].startswith(content)
                    elif name in TABLES:
                        assert after[name].endswith(b"\n")
                    elif "partial" not in name:
                        assert after[name] == content or json.loads(after[name])["Ratings"]  # old, or new and whole
            finally:
                failing_at = None

    person = stubborn(lambda: records.participant("P01"))
    stubborn(lambda: person.give_consent("I take part."))
    for position, name in enumerate(NAMES[:6]):
        recording = stubborn(lambda name=name, position=position: person.begin_game(name, position, COLUMNS))
        for round_ in range(3):
            stubborn(lambda: recording.append(ticks_of("P01", name, round_).to_dict("records")))  # noqa: B023
        stubborn(lambda: recording.finish(results_of("P01", name)))  # noqa: B023
        if name != UNSCORED:
            stubborn(lambda: person.save_ratings(name, ratings_of("P01", name), "fine"))  # noqa: B023
    assert failures >= {"replace": 20, "fsync": 60, "pwrite": 20}[broken]
    monkeypatch.undo()
    records.close()
    with Records(folder, FACTS) as again:
        assert len(again.trials()) == 5
        for name, game in again.participant("P01").games.items():
            expected = pd.concat([ticks_of("P01", name, round_) for round_ in range(3)], ignore_index=True)
            pd.testing.assert_frame_equal(read_ticks(game.file), expected.astype({"scored": int}), check_exact=True)


def test_a_game_whose_end_failed_halfway_is_complete(records, monkeypatch):
    """Its results are there and its table has not its name yet: it is not played again, and others go on."""
    person, recording = begun(records, name="oahg", position=1)
    recording.append([{"t": 1.0}])
    full = Path.replace

    def failing(old, new):
        if str(new).endswith(".tsv"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return full(old, new)

    monkeypatch.setattr(Path, "replace", failing)
    with pytest.raises(OSError, match="Input/output error"), recording:
        recording.finish(results_of("P01", "oahg"))
    monkeypatch.undo()
    assert records.trials().empty and not person.games
    play(records, "P02", NAMES[:2])
    with pytest.raises(ValueError, match="P01 has played oahg already"):
        person.begin_game("oahg", 1, COLUMNS)
    person.save_ratings("oahg", ratings_of("P01", "oahg"))
    assert read_ticks(person.games["oahg"].file)["t"].tolist() == [1.0] and len(records.trials()) == 2
    assert not list(records.folder.rglob("*partial*"))


def test_a_full_disk_in_the_middle_of_a_game(folder):
    """The kernel itself refuses to let a file grow: the part of a row that went there is taken back."""
    with Records(folder, FACTS) as records:
        play(records, "P01", NAMES[:2])

    def task():
        records = Records(folder, FACTS)
        recording = records.participant("P01").begin_game("oahg", 2, COLUMNS)
        recording.append(ticks_of("P01", "oahg", 0).to_dict("records"))
        resource.setrlimit(resource.RLIMIT_FSIZE, (1500, resource.RLIM_INFINITY))
        with pytest.raises(OSError, match=r"desc-partial_beh\.tsv cannot be written: File too large"):
            recording.append(ticks_of("P01", "oahg", 1, n=100).to_dict("records"))
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        recording.append(ticks_of("P01", "oahg", 1).to_dict("records"))
        recording.finish(results_of("P01", "oahg"))

    assert status_of(child(task)) == 0
    with Records(folder, FACTS) as records:
        ticks = read_ticks(records.participant("P01").games["oahg"].file)
        expected = pd.concat([ticks_of("P01", "oahg", round_) for round_ in range(2)], ignore_index=True)
        pd.testing.assert_frame_equal(ticks, expected.astype({"scored": int}), check_exact=True)


def session(folder: Path, labels, names=NAMES, tell=lambda what: None) -> None:
    with Records(folder, FACTS) as records:
        for label in labels:
            play(records, label, names, tell)


def saved(folder: Path) -> set[str]:
    """What `play` would have told of the games that are in the records."""
    with Records(folder, FACTS) as records:
        people = [records.participant(label) for label in list(records.places)]
        rated = set(records.trials()["user"] + " " + records.trials()["condition"] + " rated")
        return {f"{person.label} {name}" for person in people for name in person.games} | rated


def told(pipe: int) -> set[str]:
    return set(os.read(pipe, 1 << 16).decode().splitlines())


OPERATIONS = ("fsync", "pwrite", "ftruncate", "replace", "unlink", "mkdir", "rmdir", "open")


def killing_itself(at: int, task) -> None:
    """Do the task and die, as if by a power cut, before the operation on files with this number; a write halfway."""
    done = 0

    def wrapped(name):
        real = getattr(os, name)

        def operation(*arguments, **more):
            nonlocal done
            done += 1
            if done > at:
                if name == "pwrite":
                    real(arguments[0], arguments[1][: len(arguments[1]) // 2], *arguments[2:])
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*arguments, **more)

        return operation

    for name in OPERATIONS:
        setattr(os, name, wrapped(name))
    task()


def every_crash(tmp_path: Path, prepare, task, check, step: int) -> int:
    """Kill the task before its operation 0, `step`, 2 `step`, ..., and check the folder each time; how many it has."""
    at = 0
    while True:
        folder, (reading, writing) = tmp_path / f"{at}", os.pipe()
        prepare(folder)
        tell = lambda what, writing=writing: os.write(writing, f"{what}\n".encode())  # noqa: E731
        pid = child(lambda folder=folder, at=at, tell=tell: killing_itself(at, lambda: task(folder, tell)))
        os.close(writing)
        status = status_of(pid)
        check(folder, told(reading))
        os.close(reading)
        if status == 0:
            return at
        assert status == -signal.SIGKILL
        at += step


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_a_crash_before_any_operation_loses_no_game(tmp_path, step):
    names = NAMES[:3]
    session(tmp_path / "whole", ["P01"], names)
    expected = content_of(tmp_path / "whole")

    def check(folder, finished):
        assert finished <= saved(folder)
        session(folder, ["P01"], names)
        assert {n: c for n, c in content_of(folder).items() if "desc-interrupted" not in n} == expected

    how_many = every_crash(
        tmp_path / "crashes",
        lambda folder: None,
        lambda folder, tell: session(folder, ["P01"], names, tell),
        check,
        step,
    )
    assert how_many > 100


def test_repeated_crashes_lose_no_game(tmp_path):
    """Each process dies later than the one before, in the records that that has left."""
    session(tmp_path / "whole", ["P01"], NAMES[:3])
    task, kills = (lambda: session(tmp_path / "killed", ["P01"], NAMES[:3])), 0
    while status := status_of(child(lambda at=5 * kills: killing_itself(at, task))):
        assert status == -signal.SIGKILL
        kills += 1
    assert kills >= 5
    content = content_of(tmp_path / "killed")
    assert sum("desc-interrupted" in name for name in content) > 0
    assert {n: c for n, c in content.items() if "desc-interrupted" not in n} == content_of(tmp_path / "whole")


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_a_crash_in_a_withdrawal_is_finished_later(tmp_path, step):
    def prepare(folder):
        session(folder, ["P01", "Gone"], NAMES[:2])

    def withdraw(folder, tell):
        with Records(folder, FACTS) as records:
            tell("opened")
            records.withdraw("Gone")
            tell("withdrawn")

    prepare(tmp_path / "whole")
    withdraw(tmp_path / "whole", lambda what: None)
    expected = content_of(tmp_path / "whole")

    def check(folder, said):
        if "withdrawn" not in said:
            done = content_of(folder) == expected  # but nobody was told
            try:
                withdraw(folder, lambda what: None)
            except ValueError as error:
                assert done and "must be one of those enrolled: P01" in str(error)
        assert content_of(folder) == expected
        with Records(folder, FACTS) as records:
            assert records.manifest["withdrawals"] == 1
            assert records.participant("P02").place == 1

    assert every_crash(tmp_path / "crashes", prepare, withdraw, check, step) > 20
