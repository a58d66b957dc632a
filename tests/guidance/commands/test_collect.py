"""The data set: the play it holds, how it is opened, and that it is whole or absent."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import NonTensorData, TensorDict

from airhockey_marl.envs.physics import PUCK, VX, VY, TableSpec, X, Y
from airhockey_marl.envs.world import World
from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.files import sha256
from airhockey_marl.experiment.registry import construct
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import greedy_player
from guidance.commands import collect
from guidance.simulated_users import Population, load_advisors, sample_people, training_people
from guidance.study import demonstrations, games
from guidance.study.setup import PlaySetup
from guidance.user_model import dataset
from guidance.user_model.data import Demonstrations

GAMES, TICKS = 2, 300
ADVISORS = load_advisors(CONF.parent / "guidance/pretrained/advisors.safetensors")
DATA = {"demonstrations/observation.memmap", "demonstrations/action.memmap", "demonstrations/user.memmap"}
DATA |= {"demonstrations/game.memmap", "demonstrations/meta.json", "demonstrations.parquet", "people.csv"}


def run(folder: Path, *arguments: str) -> Path:
    """Run the command in `folder`."""
    with pytest.MonkeyPatch.context() as patch:
        sizes = [f"demonstrations.games={GAMES}", f"demonstrations.ticks={TICKS}"]
        patch.setattr(sys, "argv", ["collect", *sizes, f"hydra.run.dir={folder}", *arguments])
        start_command(collect.__name__)
    return folder


def population() -> Population:
    return construct(Population, OmegaConf.load(CONF / "users" / "default.yaml").population, "users.population")


def play(people: np.ndarray, seed: int, ticks: int = TICKS) -> Demonstrations:
    """What the command should have collected."""
    opponent = greedy_player(League.load(CONF.parent / "airhockey_marl/pretrained/opponents.safetensors").player(55))
    setup = PlaySetup(opponent=opponent, variant="comply_or_resist", advisors=ADVISORS)
    return demonstrations.collect_demonstrations(people, setup, GAMES, ticks, seed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return run(tmp_path_factory.mktemp("data") / "run", "seed=3")


@pytest.fixture(scope="module")
def wanted() -> Demonstrations:
    return play(training_people(3, population()), 3)


def test_it_holds_the_unguided_play_of_the_nine_training_users(folder, wanted):
    tensors = TensorDict.load_memmap(folder / "demonstrations", allow_pickle=False)
    assert tensors.batch_size == (9, GAMES, TICKS)
    assert torch.equal(tensors["observation"], wanted.observation) and torch.equal(tensors["action"], wanted.action)
    assert tensors["user"][:, 1, -1].tolist() == list(range(9)) and tensors["game"][4, :, 7].tolist() == [0, 1]
    loaded = dataset.load(folder)
    assert torch.equal(loaded.observation, wanted.observation) and torch.equal(loaded.action, wanted.action)


def test_a_row_is_a_tick_and_says_what_it_is(folder, wanted):
    file = pq.ParquetFile(folder / "demonstrations.parquet")
    assert file.num_row_groups == 9 and file.metadata.row_group(0).num_rows == GAMES * TICKS
    rows = pd.read_parquet(folder / "demonstrations.parquet")
    assert list(rows) == list(dataset.COLUMNS) and len(rows) == 9 * GAMES * TICKS
    row = rows.iloc[(4 * GAMES + 1) * TICKS + 50]
    assert (row["user"], row["game"], row["tick"], row["time_s"], row["archetype"]) == (4, 1, 50, 1.0, "presser")
    numbers = torch.from_numpy(rows.iloc[:, 5:].to_numpy(copy=True)).unflatten(0, (9, GAMES, TICKS))
    assert torch.equal(numbers, torch.cat([wanted.observation, wanted.action], dim=-1))
    names = {"own_x": 0, "other_y": 5, "puck_vx": 10, "action_y": 13}
    assert all(list(rows)[5 + place] == name for name, place in names.items())
    units = {field.name: field.metadata[b"unit"].decode() for field in file.schema_arrow}
    assert (units["time_s"], units["puck_y"], units["own_vx"], units["action_x"]) == ("s", "m", "m/s", "1")
    assert b"SIMULATED" in file.schema_arrow.metadata[b"data"]


def test_the_people_are_listed_with_every_parameter(folder):
    people, listed = training_people(3, population()), pd.read_csv(folder / "people.csv", float_precision="round_trip")
    assert list(listed["archetype"][:6]) == ["striker", "wall", "banker", "counter", "presser", "all_round"]
    for name in people.dtype.names:
        if name != "archetype":
            columns = [column for column in listed if column == name or column.startswith(f"{name}_0")]
            assert columns and np.array_equal(listed[columns[0]], people[name].reshape(9, -1)[:, 0]), name


def test_the_card_tells_where_it_comes_from_and_how_to_open_it(folder, monkeypatch):
    card = json.loads((folder / "card.json").read_text())
    assert "SIMULATED" in card["data"] and card["config"]["people"] == "training"
    facts = {"seed": 3, "opponent_generation": 55, "users": 9, "games": GAMES, "ticks": TICKS, "tick_s": 0.02}
    assert {name: card[name] for name in facts} == facts
    assert set(card["sha256"]) == DATA and all(sha256(folder / name) == card["sha256"][name] for name in DATA)
    assert set(card["columns"]) == set(dataset.COLUMNS) and len(card["opponents_sha256"]) == 64
    monkeypatch.chdir(folder)
    opened: dict = {}
    for line in card["open"]:
        exec(line, opened)
    assert len(opened["rows"]) == opened["tensors"].numel() == 9 * GAMES * TICKS


def test_no_file_is_a_pickle_and_none_is_left_over(folder):
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    of_every_run = (".hydra/", "collect.log", "run.json")
    assert {name for name in files if not name.startswith(of_every_run)} == DATA | {"card.json"}
    assert not list(folder.glob(".demonstrations*"))
    for name, size in (("observation", 12 * 4), ("action", 2 * 4), ("user", 8), ("game", 8)):  # raw, nothing else
        assert (folder / f"demonstrations/{name}.memmap").stat().st_size == 9 * GAMES * TICKS * size
    json.loads((folder / "demonstrations/meta.json").read_text())
    assert (folder / "demonstrations.parquet").read_bytes()[:4] == b"PAR1"


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(folder, tmp_path):
    of = [json.loads((path / "card.json").read_text())["sha256"] for path in (folder, run(tmp_path / "1", "seed=3"))]
    assert of[0] == of[1]
    other = json.loads((run(tmp_path / "2", "seed=4") / "card.json").read_text())["sha256"]
    same = {name for name in DATA if of[0][name] == other[name]}
    assert same == {f"demonstrations/{name}" for name in ("user.memmap", "game.memmap", "meta.json")}


def test_people_of_a_study_are_those_whom_evaluate_draws(tmp_path):
    card = json.loads((run(tmp_path / "run", "+preset=smoke", "people=study") / "card.json").read_text())
    assert card["users"] == card["config"]["participants"] == 4 and "generations" not in card["config"]
    action = play(sample_people(4, 0, population()), 0).action
    assert torch.equal(dataset.load(tmp_path / "run").action, action)


def test_the_summary_counts_the_goals_that_fell(monkeypatch):
    goals = []

    class Watched(World):
        def step(self, actions, ticks=1, indices=None):
            if len(goals) % 100 == 99:  # a shot from right before the goal line, so that goals fall in any play
                puck = self.bodies[:, PUCK]
                puck[:, X] = np.copysign(self.table.length / 2 - 1e-3, puck[:, X])
                puck[:, VX] = np.copysign(5.0, puck[:, X])
                puck[:, Y] = puck[:, VY] = 0.0
            super().step(actions, ticks, indices)
            goals.append(self.goals.copy())

    monkeypatch.setattr(games, "World", Watched)
    ticks = 1500
    data = play(training_people(0, population()), 0, ticks)
    fell = np.array(goals[:-1]).reshape(ticks - 1, 9, GAMES)  # nobody sees what the last tick brought
    found, minutes = dataset.summary(data, TableSpec()), GAMES * ticks * 0.02 / 60
    assert (fell == 1).sum() > 5 and (fell == -1).sum() > 5
    assert np.allclose(found["scored_per_minute"] * minutes, (fell == 1).sum((0, 2)))
    assert np.allclose(found["conceded_per_minute"] * minutes, (fell == -1).sum((0, 2)))
    hand = 0.075 * data.action[0].double()
    before = torch.cat([torch.zeros(GAMES, 1, 2), hand[:, :-1]], dim=1)
    before[:, 1:][torch.from_numpy(fell[:, 0].T != 0)] = 0.0  # a goal puts it back at the center
    speed = (hand - before).norm(dim=-1) / 0.02
    assert found["hand_m_s_mean"][0] == pytest.approx(speed.mean().item(), rel=1e-5)
    assert found["hand_m_s_sd"][0] == pytest.approx(speed.std().item(), rel=1e-3)
    assert found["own_y_m_mean"][0] == pytest.approx(data.observation[0, ..., 1].mean().item(), abs=1e-6)


def test_a_run_that_fails_leaves_nothing_that_could_be_taken_for_data(monkeypatch, tmp_path):
    def fail(self, prefix):
        Path(prefix).mkdir()
        (Path(prefix) / "meta.json").write_text("{")
        raise OSError("disk full")

    monkeypatch.setattr(TensorDict, "memmap", fail)
    with pytest.raises(OSError, match="disk full"):
        dataset.write_tensors(tmp_path / "demonstrations", play(training_people(0, population())[:1], 0, 5))
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_whole_data_set_is_not_loaded(folder, tmp_path):
    with pytest.raises(ValueError, match="is not a finished run"):
        dataset.load(tmp_path)
    (tmp_path / "demonstrations").mkdir()
    for name in ("card.json", *(name for name in DATA if name.startswith("demonstrations/"))):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    assert dataset.load(tmp_path).action.shape == (9, GAMES, TICKS, 2)
    action = tmp_path / "demonstrations/action.memmap"
    action.write_bytes(action.read_bytes()[:-8])
    with pytest.raises(ValueError, match=r"action\.memmap is missing or not the file"):
        dataset.load(tmp_path)
    action.unlink()
    with pytest.raises(ValueError, match=r"action\.memmap is missing or not the file"):
        dataset.load(tmp_path)


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("a pickle was loaded",)


def test_a_pickle_that_somebody_else_put_into_a_data_set_is_not_loaded(tmp_path):
    tensors = TensorDict({"observation": torch.zeros(1, 1, 2, 12), "action": torch.zeros(1, 1, 2, 2)}, [1, 1, 2])
    tensors["bomb"] = NonTensorData(Bomb(), [1, 1, 2])
    tensors.memmap(tmp_path / "demonstrations")
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert "other.pickle" in {path.name for path in files}
    listed = {str(path.relative_to(tmp_path)): sha256(path) for path in files}
    (tmp_path / "card.json").write_text(json.dumps({"sha256": listed}))
    with pytest.raises(RuntimeError, match="Refusing to load pickled"):
        dataset.load(tmp_path)


def test_loaded_demonstrations_are_a_copy(folder, wanted):
    dataset.load(folder).action.zero_()
    assert torch.equal(dataset.load(folder).action, wanted.action)


def test_data_are_never_replaced(folder, tmp_path, capsys):
    """Neither where they were made, nor where somebody has copied nothing but them."""
    copied = tmp_path / "copied"
    shutil.copytree(folder, copied, ignore=shutil.ignore_patterns(".hydra", "run.json"))
    for place, said in ((folder, "holds a run that has left card.json"), (copied, "without demonstrations/")):
        before = (place / "card.json").read_bytes()
        with pytest.raises(SystemExit) as stopped:
            run(place, "seed=9")
        assert stopped.value.code == 2 and said in capsys.readouterr().err
        assert (place / "card.json").read_bytes() == before and dataset.load(place) is not None
