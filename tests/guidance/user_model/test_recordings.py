"""Play of people, from files: that it is read as it was recorded, cut where it stops, and refused where it is wrong."""

import json
import re

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import CONF, run
from airhockey_marl.experiment.files import load_tensors, sha256
from guidance.commands import adapt, meta_train
from guidance.pretrained import FOLDER
from guidance.simulated_users import NO_ADVISORS, training_people
from guidance.study.demonstrations import collect_demonstrations
from guidance.study.models import load_user_model
from guidance.study.setup import PlaySetup
from guidance.user_model import dataset
from guidance.user_model.data import Demonstrations, Recordings, action_ahead
from guidance.user_model.recordings import ACTION, REQUIRED, STATE, read_recordings
from tests import ROOT
from tests.guidance.study.test_demonstrations import opponent

TABLE = TableSpec()
GAMES, TICKS = 2, 400


@pytest.fixture(scope="module")
def data() -> Demonstrations:
    setup = PlaySetup(opponent=opponent, variant="comply_or_resist", advisors=NO_ADVISORS)
    return collect_demonstrations(training_people(0)[:2], setup, GAMES, TICKS, 0)


@pytest.fixture(scope="module")
def rows(data, tmp_path_factory) -> pd.DataFrame:
    file = tmp_path_factory.mktemp("rows") / dataset.ROWS
    dataset.write_rows(file, data, pd.Series(["wall", "banker"]), TABLE)
    return pd.read_parquet(file)


@pytest.fixture
def one(rows) -> pd.DataFrame:
    """One game, in a table of one's own."""
    return rows[(rows["user"] == 0) & (rows["game"] == 0)][[*REQUIRED]].reset_index(drop=True)


def same(pieces: list, data: Demonstrations, user: int) -> bool:
    return all(
        torch.equal(observation, data.observation[user, game]) and torch.equal(action, data.action[user, game])
        for game, (observation, action) in enumerate(pieces)
    )


WRITERS = {
    "table.parquet": lambda rows, file: rows.to_parquet(file),
    "indexed.parquet": lambda rows, file: rows.set_index(["user", "own_x"]).to_parquet(file),
    "table.csv": lambda rows, file: rows.to_csv(file, index=False),
    "table.tsv": lambda rows, file: rows.to_csv(file, index=False, sep="\t"),
    "excel.csv": lambda rows, file: rows.to_csv(file, index=False, sep=";", decimal=",", encoding="utf-8-sig"),
    "spaces.csv": lambda rows, file: rows.rename(columns=lambda name: f" {name.upper()}").to_csv(file, index=False),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_table_is_read_bit_for_bit(data, rows, tmp_path, name):
    WRITERS[name](rows, tmp_path / name)
    for place in (tmp_path / name, tmp_path):
        found, facts = read_recordings(place, 100)
        assert list(found.people) == ["0", "1"]
        assert all(len(pieces) == GAMES for pieces in found.people.values())
        assert all(same(found.people[str(user)], data, user) for user in range(2))
        assert (facts["people"], facts["games"], facts["ticks"]) == (2, 4, 4 * TICKS)
        assert facts["sha256"] == sha256(tmp_path / name) and not any(facts["left_out"].values())


def test_a_table_without_user_and_game_is_one_game_of_one_person(data, one, tmp_path):
    one.to_csv(tmp_path / "anna.csv")
    one.sample(frac=1.0, random_state=0, axis=1).to_csv(tmp_path / "bert.csv", index=False)
    found, _ = read_recordings(tmp_path, 100)
    assert list(found.people) == ["anna", "bert"] and all(len(own) == 1 for own in found.people.values())
    assert all(same(own, data, 0) for own in found.people.values())


def test_games_that_are_interleaved_are_taken_apart(data, rows, tmp_path):
    rows.sort_values(["tick", "user"]).to_csv(tmp_path / "all.csv", index=False)
    found, _ = read_recordings(tmp_path / "all.csv", 100)
    assert same(found.people["1"], data, 1) and len(found.people["1"]) == GAMES


def test_play_is_cut_where_it_stops_and_what_is_left_out_is_counted(one, data, tmp_path):
    one.loc[250:, "time_s"] += 3.0  # a pause
    one = one.drop(index=[100, 101])  # two ticks lost
    one.to_csv(tmp_path / "own.csv", index=False)
    found, facts = read_recordings(tmp_path / "own.csv", 120)
    assert [len(action) for _, action in found.people["own"]] == [148, 150]
    assert torch.equal(found.people["own"][0][1], data.action[0, 0, 102:250])
    assert facts["left_out"] == {
        "people": 0,
        "games_with_guidance": 0,
        "ticks_not_scored_or_not_held": 0,
        "ticks_in_short_pieces": 100,
    }


def test_of_recorded_sessions_unguided_play_by_a_hand_is_read(one, data, tmp_path):
    one["scored"], one["held"], one["force_x"], one["force_y"] = [0] * 100 + [1] * 300, 1, 0.0, np.nan
    one.loc[300:309, "held"] = 0
    for label, name, force in (("P1", "unscored", 0.0), ("P1", "oahg", 0.5), ("P2", "nhg", 0.0)):
        folder = tmp_path / f"sub-{label}" / "beh"
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"sub-{label}_task-airhockey_acq-{name}"
        one.assign(force_x=force).to_csv(folder / f"{stem}_run-0_beh.tsv", sep="\t", index=False, na_rep="n/a")
    one.to_csv(folder / f"{stem}_run-0_desc-interrupted1_beh.tsv", sep="\t", index=False, na_rep="n/a")
    (tmp_path / "trials.csv").write_text("user,condition\n")
    found, facts = read_recordings(tmp_path, 50)
    assert list(found.people) == ["P1", "P2"] and facts["games"] == 2
    for pieces in found.people.values():
        assert [len(action) for _, action in pieces] == [200, 90]
        assert torch.equal(pieces[1][0], data.observation[0, 0, 310:])
    assert facts["left_out"]["people"] == 0
    assert facts["left_out"]["games_with_guidance"] == 1 and facts["left_out"]["ticks_not_scored_or_not_held"] == 330
    assert list(read_recordings(folder.parent, 50)[0].people) == ["P2"]
    with pytest.raises(
        ValueError, match=r"without guidance; left out: 1 people, 1 games with guidance, 110 ticks not scored"
    ):
        read_recordings(next(tmp_path.rglob("*oahg*")), 50)


def test_the_readme_has_the_columns_units_and_frame_of_the_code():
    text = (ROOT / "guidance/user_model/README.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (`[^|]*) \| ([^|]*) \|", text, re.M)
    listed = {name: unit for names, unit in table for name in re.findall(r"`(\w+)`", names)}
    assert listed == {name: dataset.COLUMNS[name][1] for name in ("user", "game", *REQUIRED)}
    assert dataset.FRAME in " ".join(text.split())
    assert f"{TABLE.length} m long and {TABLE.width} m wide" in " ".join(text.split())


def change(column: str, value: object, row: int = 7):
    def changed(one: pd.DataFrame) -> pd.DataFrame:
        one = one.astype({column: object})
        one.loc[row, column] = value
        return one

    return changed


def scaled(factor: float, *columns: str):
    return lambda one: one.assign(**{name: one[name] * factor for name in columns})


REFUSED = {
    "missing": (lambda one: one.rename(columns={"own_vx": "own_v_x"}), "column own_vx is missing; is own_v_x meant?"),
    "other": (lambda one: one[["time_s"]], "column own_x is missing"),
    "twice": (lambda one: one.assign(**{"OWN_X": 0.0}), "column own_x must be there once"),
    "text": (change("puck_y", "left"), "row 9, column puck_y: 'left' must be a finite number"),
    "comma": (change("puck_y", "0,1"), "row 9, column puck_y: '0,1' must be a finite number"),
    "empty": (change("own_x", None), "row 9, column own_x: an empty cell must be a finite number"),
    "infinite": (change("action_x", np.inf), "row 9, column action_x: inf must be a finite number"),
    "nobody": (lambda one: change("user", None)(one.assign(user="a")), "row 9, column user must not be empty"),
    "off the table": (change("puck_y", 0.6), "row 9, column puck_y: 0.6 must be from -0.519 to 0.519 m"),
    "action": (change("action_y", 1.2), "row 9, column action_y: 1.2 must be from -1 to 1 (1 is the end"),
    "millimeters": (scaled(1000, *(name for name in STATE if "_v" not in name)), "is it in mm or cm?"),
    "one in millimeters": (scaled(1000, "other_x"), "row 2, column other_x: 487 must be from 0 to 0.974 m"),
    "mm/s": (scaled(1000, "puck_vx"), "is it in mm/s or cm/s?"),
    "per tick": (scaled(0.02, "puck_vx"), "column puck_vx does not fit how puck_x changes"),
    "other axis": (scaled(-1, "own_vy"), "column own_vy does not fit how own_y changes"),
    "hand in m": (scaled(0.075, *ACTION), "column action_x does not fit own_x, the paddle's place"),
    "right player": (scaled(-1, "own_x"), "column own_x: 0.487 must be from -0.974 to 0 m (from the table's center"),
    "10 ms": (scaled(0.5, "time_s"), "column time_s: rows are 0.01 s apart (median), must be 0.02 s"),
    "milliseconds": (scaled(1000, "time_s"), "column time_s: rows are 20 s apart (median), must be 0.02 s"),
    "back in time": (change("time_s", 0.0), "row 9, column time_s: -0.12 s after the row before of its game"),
    "short": (
        lambda one: one[:90],
        "must have 100 ticks in a row (2 s) without guidance; left out: 1 people, 90 ticks in short",
    ),
    "nothing": (lambda one: one[:0], "must have 100 ticks in a row"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_that_does_not_fit_is_refused_by_file_row_and_column(one, tmp_path, name):
    spoil, message = REFUSED[name]
    spoil(one).to_csv(tmp_path / "own.csv", index=False)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read_recordings(tmp_path / "own.csv", 100)
    assert "own.csv" in str(error.value) and len(str(error.value)) < 300 and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("own.csv", b"", "own.csv: column time_s is missing"),
        ("own.csv", "time_s".encode("utf-16"), "own.csv: its text must be UTF-8"),
        ("own.csv", b"1,2,3\n4,5,6\n", "column time_s is missing; there are 1, 2, 3"),
        ("own.parquet", b"PAR1 no", "own.parquet: "),
        ("own.xlsx", b"", "own.xlsx: its name must end in .csv, .tsv or .parquet"),
        (None, b"", "no such file or folder"),
    ],
)
def test_a_file_that_is_no_table_is_named(tmp_path, name, content, message):
    if name:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(message)):
        read_recordings(tmp_path / (name or "own.csv"), 100)


@pytest.mark.parametrize(("longer", "message"), [([4], ".*line 5"), (range(1, 401), "row 2 has 17 cells, must be 15")])
def test_lines_that_are_longer_than_the_header_are_named(one, tmp_path, longer, message):
    text = one.to_csv(index=False).splitlines()
    for line in longer:
        text[line] += ",1,2"
    (tmp_path / "own.csv").write_text("\n".join(text))
    with pytest.raises(ValueError, match=rf"own\.csv: {message}"):
        read_recordings(tmp_path / "own.csv", 100)


# as training data


def numbered(*lengths: int) -> list:
    """Pieces whose observations hold the piece and the tick."""
    pieces = []
    for number, length in enumerate(lengths):
        observation = torch.zeros(length, 12)
        observation[:, 0], observation[:, 1] = number, torch.arange(length)
        pieces.append((observation, observation[:, :2].clone()))
    return pieces


def test_blocks_of_a_pair_are_of_one_person_whole_and_of_two_pieces():
    recordings = Recordings({"a": numbered(45, 20, 39), "b": numbered(25, 10)})
    generator, used = torch.Generator().manual_seed(0), []
    pairs = list(recordings.pairs(10, generator))
    assert len(pairs) == 4  # of nine blocks; b has three, and begins anew
    for demo, valid in pairs:
        for observation, action in (demo, valid):
            assert observation.shape == (2, 10, 12) and torch.equal(action, observation[..., :2])
            piece, tick = observation[..., 0], observation[..., 1]
            assert (piece == piece[:, :1]).all() and (tick == tick[:, :1] + torch.arange(10)).all()
            used.append((int(piece[0, 0]), int(tick[0, 0])))
        assert demo[0][0, 0, 0] != valid[0][0, 0, 0]
    assert len(set(used)) == 8
    again = list(recordings.pairs(10, torch.Generator().manual_seed(0)))
    assert all(torch.equal(one[0][0], other[0][0]) for one, other in zip(pairs, again, strict=True))


def test_the_last_part_of_everybody_is_held_out():
    recordings = Recordings({"a": numbered(50, 10, 40), "b": numbered(30)})
    first, last = recordings.split(0.45)
    assert [len(action) for _, action in first.people["a"]] == [50, 5]
    assert [len(action) for _, action in last.people["a"]] == [5, 40]
    assert last.people["b"][0][0][0, 1] == 30 - round(0.45 * 30) == len(first.people["b"][0][1])
    assert sum(len(action) for _, action in first.batches(7)) == 55 + 16
    ahead = recordings.ahead(0.04, TABLE)
    observation, action = recordings.people["a"][0]
    assert torch.equal(ahead.people["a"][0][1], action_ahead(observation, action, 0.04, TABLE))


# the commands


@pytest.fixture
def table(rows, tmp_path):
    rows.assign(user=rows["user"].map({0: "Xanthippe", 1: "Bert"})).to_csv(tmp_path / "table.csv", index=False)
    return tmp_path / "table.csv"


SMALL = ["+preset=smoke", "hidden=[8]", "maml.block=100"]


def test_meta_train_has_a_training_user_per_person(table, tmp_path, capsys):
    folder = tmp_path / "run"
    run(meta_train.__name__, [*SMALL, f"data={table}", f"hydra.run.dir={folder}"])
    assert "data: 2 people, 4 games, 1600 ticks; left out: nothing" in capsys.readouterr().out
    card = json.loads((folder / "card.json").read_text())
    assert card["data"] == json.loads((folder / "data.json").read_text())
    assert card["data"]["sha256"] == sha256(table) and card["held_out"].startswith("the last 20%")
    assert "opponents_sha256" not in card and card["on_held_out"]["after_ua_loss"] > -100
    meta, facts = load_user_model(folder / "meta.safetensors")
    assert facts["inner_lr"] == 0.1 and meta is not None
    table.write_text(table.read_text() + "\n")
    with pytest.raises(SystemExit):
        run(meta_train.__name__, [f"resume={folder}", f"hydra.run.dir={tmp_path}/again"])
    assert f"sha256 must be as in {folder}/data.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["maml.block=400"], "Xanthippe has 800 ticks in pieces of at least maml.block = 400; without the last 0.2"),
        (
            ["maml.block=500"],
            "must have 500 ticks in a row (10 s) without guidance; left out: 2 people, 1600 ticks in short",
        ),
        (["hold_out=0"], "hold_out = 0 must be a finite number of at least 0.05 and at most 0.5"),
        (["data=nowhere"], "data = nowhere: no such file or folder"),
    ],
)
def test_meta_train_refuses_what_it_cannot_train_on(table, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as stopped:
        run(meta_train.__name__, [*SMALL, f"data={table}", f"hydra.run.dir={tmp_path}/run", *arguments])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and message in error and error.count("\n") == 1
    assert not list(tmp_path.rglob("state.safetensors"))


def test_adapt_makes_a_user_model_of_one_person_that_does_not_name_them(table, tmp_path, capsys):
    folder = tmp_path / "run"
    run(adapt.__name__, [f"data={table}", "participant=Xanthippe", f"hydra.run.dir={folder}"])
    assert f"models.user={folder}/user.safetensors" in capsys.readouterr().out
    card = json.loads((folder / "card.json").read_text())
    scores = card["on_held_out"]
    assert scores["after"]["loss"] < scores["before"]["loss"] and scores["ticks"] == 160
    assert card["adaptation"] == {"inner_lr": 0.1, "steps": 1, "ticks": 640, "data_sha256": sha256(table)}
    written = [path for path in folder.rglob("*") if path.is_file()]
    assert {path.name for path in written} == {"user.safetensors", "card.json", "adapt.log"}
    assert not any(b"Xanthippe" in path.read_bytes() for path in written)
    with pytest.raises(SystemExit):
        run(adapt.__name__, [f"data={table}", "participant=Bert", f"hydra.run.dir={folder}"])
    assert "a model is not replaced" in capsys.readouterr().err
    run(adapt.__name__, [f"data={table}", "participant=Bert", "keep_label=true", f"hydra.run.dir={tmp_path}/named"])
    assert load_tensors(tmp_path / "named" / "user.safetensors")[1]["participant"] == "Bert"


def test_the_adapted_model_is_that_of_user_adaptation_and_is_a_user_model_of_every_command(table, data, tmp_path):
    from guidance import pretrained
    from guidance.study.models import Models

    run(adapt.__name__, [f"data={table}", "participant=Bert", "hold_out=0.5", f"hydra.run.dir={tmp_path}/run"])
    models = pretrained.models()
    adapted = models.adapted_to([(data.observation[1, 0], data.action[1, 0])])[0].flatten_keys(".")
    league = ROOT / "airhockey_marl/pretrained/league.safetensors"
    meta = FOLDER / OmegaConf.load(CONF / "guidance" / "default.yaml").predictor / "meta.safetensors"
    own = Models.load(league, -1, tmp_path / "run" / "user.safetensors", meta).user
    assert all(torch.allclose(tensor, adapted[name], atol=1e-6) for name, tensor in own.named_parameters())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "participant must be chosen, data has 2 people: Xanthippe, Bert"),
        (["participant=bert"], "participant = bert must be one of Xanthippe, Bert"),
        (["participant=Bert", "steps=0"], "steps = 0 must be a whole number of at least 1"),
        (["participant=Bert", "inner_lr=1e300"], "inner_lr = 1e+300, steps = 1: the adapted model's loss is"),
        (["participant=Bert", "guidance.predictor=never"], "guidance.predictor = never must be one of "),
        (
            ["participant=Bert", f"models.meta={FOLDER}/now/user.safetensors"],
            "not meta-learned: it has no inner_lr",
        ),
    ],
)
def test_adapt_refuses_by_name(table, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit):
        run(adapt.__name__, [f"data={table}", f"hydra.run.dir={tmp_path}/run", *arguments])
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not list(tmp_path.rglob("*.safetensors"))
