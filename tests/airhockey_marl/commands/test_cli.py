"""The commands as people run them: whole, on tiny budgets, and with everything that can be typed wrong."""

import json
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from airhockey_marl.__main__ import find_commands
from airhockey_marl.experiment.command import CONF, run
from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.experiment.run_record import read_run
from airhockey_marl.players.networks import GaussianPolicy
from guidance.study.models import Models
from guidance.study.setup import file_hashes, manifest
from tests.processes import Command, smoke, start

COMMANDS = find_commands()


def kill_at_the_first_checkpoint(run: Path, *arguments: str) -> Path:
    """Start a command with `run` as its folder, and end it with SIGKILL as soon as it has written its state."""
    command = Command(*arguments, f"hydra.run.dir={run}")
    while not (run / "state.safetensors").exists():
        assert command.poll() is None, command.stderr.read_text()
        time.sleep(0.001)
    command.kill()
    assert not (run / "card.json").exists()
    return run


def models_of(runs: Path) -> list[str]:
    files = {"league": "train/league", "user": "meta_train/user", "meta": "meta_train/meta"}
    return [f"models.{name}={runs}/{file}.safetensors" for name, file in files.items()]


def test_train_writes_a_league_a_card_and_what_tensorboard_reads(runs):
    folder = runs / "train"
    tensors, facts = load_tensors(folder / "league.safetensors")
    assert facts == {"hidden": [64, 64], "inputs": "paddle"} and {len(tensor) for tensor in tensors.values()} == {3}
    card = json.loads((folder / "card.json").read_text())
    assert card["generations"] == 3 and card["steps"] == 2000 and len(set(card["hashes"])) == 3
    assert list(folder.glob("tensorboard/events*"))


def test_train_gives_the_same_weights_for_the_same_seed_in_either_environment(runs, tmp_path):
    """Twice in the same: see `test_pictures_do_not_change_the_league`."""
    smoke("airhockey_marl.train", "env=pettingzoo", f"hydra.run.dir={tmp_path}")
    first, second = (json.loads((f / "card.json").read_text()) for f in (runs / "train", tmp_path))
    assert first["hashes"] == second["hashes"]


@pytest.mark.parametrize(
    ("how", "drawn"),
    [
        ("env=batched", 4),
        ("env=pettingzoo", 0),
        ("env=hand", 0),
        pytest.param("collector=multisync", 0, marks=pytest.mark.slow),
    ],
)
def test_train_killed_and_resumed_ends_like_one_never_killed(tmp_path, how, drawn):
    """SIGKILL as soon as the first generation is behind it; the league and the card's scores are then the same."""
    few = ["+preset=smoke", "generations=4", "steps_per_generation=500", how, f"pictures_every={drawn // 4}"]
    whole = start("airhockey_marl.train", *few, f"hydra.run.dir={tmp_path}/whole")
    assert whole.returncode == 0, whole.stderr
    killed = kill_at_the_first_checkpoint(tmp_path / "killed", "airhockey_marl.train", *few)
    assert (read_run(killed).state, read_run(killed).resumable) == ("interrupted", True)
    resumed = start("airhockey_marl.train", f"resume={killed}", f"hydra.run.dir={tmp_path}/log")
    assert resumed.returncode == 0, resumed.stderr
    assert [read_run(folder).state for folder in (killed, tmp_path / "log")] == ["done", "done"]
    first, second = (json.loads((tmp_path / name / "card.json").read_text()) for name in ("whole", "killed"))
    assert first["hashes"] == second["hashes"] and len(first["hashes"]) == 5
    assert first["win_rate_of_last_against"] == second["win_rate_of_last_against"]
    matches, resumed_matches = ((tmp_path / name / "matches.csv").read_bytes() for name in ("whole", "killed"))
    assert matches == resumed_matches
    assert scalars(tmp_path / "whole") == scalars(killed)
    shown = pictures(killed)
    assert shown == pictures(tmp_path / "whole") and sum(map(len, shown.values())) == 2 * drawn


def test_meta_train_killed_and_resumed_ends_like_one_never_killed(runs, tmp_path):
    """SIGKILL in the first training, and resume; then the weights, the scores and the scalars are the same."""
    few = ["+preset=smoke", f"models.opponents={runs}/train/league.safetensors", "opponent=1"]
    few += ["maml.epochs=6", "supervised.epochs=3"]
    whole = start("guidance", "meta_train", *few, f"hydra.run.dir={tmp_path}/whole")
    assert whole.returncode == 0, whole.stderr
    killed = kill_at_the_first_checkpoint(tmp_path / "killed", "guidance", "meta_train", *few)
    resumed = start("guidance", "meta_train", f"resume={killed}", f"hydra.run.dir={tmp_path}/log")
    assert resumed.returncode == 0, resumed.stderr
    for name in ("meta", "user"):
        first, second = (load_tensors(tmp_path / run / f"{name}.safetensors")[0] for run in ("whole", "killed"))
        assert all(torch.equal(first[key], second[key]) for key in first)
    first, second = (json.loads((tmp_path / run / "card.json").read_text()) for run in ("whole", "killed"))
    assert first["on_nine_others"] == second["on_nine_others"]
    for name, epochs in (("maml", 6), ("supervised", 3)):
        shown, again = (scalars(tmp_path / run, name) for run in ("whole", "killed"))
        assert shown == again and [step for step, _ in shown[f"{name}/loss"]] == list(range(1, epochs + 1))


def scalars(run: Path, part: str = ".") -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows of a run: steps and values by name, without the clock's."""
    events = EventAccumulator(str(run / "tensorboard" / part), size_guidance={"scalars": 0}).Reload()
    names = [name for name in events.Tags()["scalars"] if not name.startswith("speed/")]
    return {name: [(event.step, event.value) for event in events.Scalars(name)] for name in names}


def pictures(run: Path, part: str = ".") -> dict[str, list[tuple[int, bytes]]]:
    """The pictures that TensorBoard shows of a run: steps and files by name."""
    events = EventAccumulator(str(run / "tensorboard" / part), size_guidance={"images": 0}).Reload()
    shown = {name: events.Images(name) for name in events.Tags()["images"]}
    return {name: [(event.step, event.encoded_image_string) for event in images] for name, images in shown.items()}


def test_tensorboard_shows_each_generation_once(runs):
    shown = scalars(runs / "train")
    assert {"update/kl", "update/std", "win_rate_against/0", "win_rate_against/striker"} <= set(shown)
    assert all([step for step, _ in values] == [1000, 2000] for values in shown.values())


def test_validate_users_measures_and_draws(tmp_path):
    done = smoke("guidance", "validate_users", f"hydra.run.dir={tmp_path}")
    table = pd.read_csv(tmp_path / "human_measures.csv")
    assert len(table) == 26 and table["mean"].notna().all()
    assert all(name in done.stdout for name in table["measure"])
    anchors = pd.read_csv(tmp_path / "anchors.csv")
    assert len(anchors) == 3 * 4 * 4 and anchors.notna().all(axis=None)
    frozen = yaml.safe_load((tmp_path / "anchors.yaml").read_text())
    assert set(frozen) == {"scales", "withdrawn"} and (tmp_path / "anchors.yaml").read_text() in done.stdout
    for name in ("speeds", "push", "places", "shots", "anchors"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_a_league_is_reported_whole(runs):
    folder = runs / "league_report"
    assert "beats generation 0: wins" in (runs / "league_report.txt").read_text()
    for name in ("league_report.html", "league_report.json", "payoff.csv", "ratings.csv", "match.gif"):
        assert (folder / name).stat().st_size > 100
    found = json.loads((folder / "league_report.json").read_text())
    assert [steps for steps, _ in found["best_response"]] == [1000]


def test_meta_train_scores_itself_on_people_it_has_not_seen(runs):
    card = json.loads((runs / "meta_train" / "card.json").read_text())
    scores = card["on_nine_others"]
    assert all(score > -100 and score == score for score in scores.values()) and "persistence_rmse" in scores


def test_evaluate_all_nine(runs):
    folder, output = runs / "evaluate", (runs / "evaluate.txt").read_text(encoding="utf-8")
    trials = pd.read_csv(folder / "trials.csv")
    assert len(trials) == 9 * 4 and trials["condition"].nunique() == 9
    for name in ("tests.csv", "figure6.png", "figure6.svg", "report.html", "manifest.json"):
        assert (folder / name).stat().st_size > 100
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["config"]["participants"] == 4 and len(manifest["models"]["league"]) == 64
    assert "generations" not in manifest["config"]  # a preset's keys for other commands
    for letter in "abcdefghi":
        assert f"({letter})" in output
    assert not [path for path in folder.iterdir() if path.name.startswith(".") and path.is_file()]


@pytest.mark.parametrize("guidance", ["default", "stability"])
def test_the_shipped_defaults_are_the_frozen_studies(guidance):
    """Whoever changes a default, a model or a user changes a study, and has to say so in guidance/study/frozen.json."""
    with initialize_config_dir(str(CONF), version_base=None):
        cfg = compose("evaluate", overrides=[f"guidance={guidance}"])
    models = Models.load(cfg.models.league, cfg.models.generation, cfg.models.user, cfg.models.meta)
    facts = manifest(cfg, file_hashes(cfg, models), "", 0.0)
    assert facts["frozen"]
    cfg.opponent += 1
    assert not manifest(cfg, file_hashes(cfg, models), "", 0.0)["frozen"]


def without_figures() -> None:
    """Have this process draw a dot for each figure of a report, which takes half of the time of a small study."""
    from guidance.statistics import report

    def save_dot(draw, folder: Path, name: str, dpi: int) -> bytes:
        Image.new("RGB", (1, 1)).save(folder / f"{name}.png")
        return b"<svg/>"

    report.save_figure = save_dot


def test_a_sweep_over_the_nine_merges_into_the_report_of_one_run(monkeypatch, runs, tmp_path):
    """Of people who do not adapt: the others come to each job as to their first condition."""
    monkeypatch.setenv("AIRHOCKEY_OUTPUTS", str(tmp_path / "outputs"))
    settings = "seed=3", "users.adaptation=off", *models_of(runs)
    smoke("guidance.evaluate", *settings, f"hydra.run.dir={tmp_path}/whole", before=without_figures)
    smoke("guidance.evaluate", "-m", "condition=glob(*)", *settings, before=without_figures)
    (sweep,) = (tmp_path / "outputs" / "evaluate").glob("*/*-sweep")
    assert len(list(sweep.glob("*/trials.csv"))) == 9
    done = start("guidance", "report", f"runs={sweep}", f"out={tmp_path}/merged", f"hydra.run.dir={tmp_path}/r")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "merged" / "report.html").is_file()
    assert (tmp_path / "merged" / "tests.csv").read_bytes() == (tmp_path / "whole" / "tests.csv").read_bytes()


def complaint(capsys, tmp_path, name: str, *arguments: str) -> str:
    """Run a command that must refuse: exit code 1 or 2, one line, no traceback, nothing computed."""
    with pytest.raises(SystemExit) as stopped:
        run(COMMANDS[name].module, [f"hydra.run.dir={tmp_path}/run", *arguments])
    shown = capsys.readouterr()
    assert stopped.value.code in (1, 2)
    assert shown.err.count("\n") == 1 and shown.err.startswith("error: ") and len(shown.err) < 300, shown.err
    assert "Traceback" not in shown.err
    assert not list(tmp_path.rglob("*.csv")) and not list(tmp_path.rglob("run/*.safetensors"))
    return shown.err


@pytest.mark.parametrize(
    ("name", "argument", "message"),
    [
        ("evaluate", "condition=oahg_utt", "condition = oahg_utt must be one of beyond/approach_gated, "),
        ("evaluate", "+preset=tiny", "preset = tiny must be one of smoke"),
        ("evaluate", "participants=0", "participants = 0 must be a whole number of at least 1"),
        ("evaluate", "guidance.spring.stiffness=-50", "stiffness = -50"),
        ("evaluate", "guidance.thresholds.user.low=0.9", "low = 0.9"),
        (
            "evaluate",
            "guidance.lookahead.seconds=-1",
            "lookahead.seconds = -1 must be a finite number of at least 0",
        ),
        ("evaluate", "guidance.lookahead.reading=both", "reading = both must be one of printed, physics, consistent"),
        ("evaluate", "guidance.predictor=never", "guidance.predictor = never must be one of "),
        ("prediction_report", "guidance.predictor=never", "guidance.predictor = never must be one of "),
        ("evaluate", "users.variant=V9", "users.variant = 'V9'"),
        ("evaluate", "users.adaptation=maybe", "users.adaptation = 'maybe' must be on or off"),
        ("evaluate", "study.rounds=0", "study.rounds = 0"),
        ("evaluate", "opponent=1000", "generation = 1000"),
        ("evaluate", "models.user=nowhere.safetensors", "no such file: nowhere.safetensors"),
        ("evaluate", "seed=-1", "seed = -1"),
        ("train", "generations=0", "generations = 0 must be a whole number of at least 1"),
        ("train", "batch=333", "batch = 333 must be a multiple of env.tables"),
        ("train", "gamma=1.5", "gamma = 1.5"),
        ("train", "algorithm.max_kl=0", "max_kl = 0"),
        ("train", "env.backend=gym", "env.backend = 'gym'"),
        ("train", "league.sampler.first.delta=2", "delta = 2"),
        ("train", "league.scripted_players=[goalie]", "league.scripted_players = 'goalie' must be one of random,"),
        ("train", "league=nobody", "league = nobody must be one of curriculum, delta_uniform, latest, mixture"),
        ("validate_users", "play_seconds=1", "play_seconds = 1 must be a finite number of at least 10"),
        ("validate_users", "anchors.groups=0", "anchors.groups = 0 must be a whole number of at least 1"),
        ("validate_users", "guidance.spring.limit=0.0", "guidance.spring.limit = 0.0 must be a finite number above 0"),
        ("validate_users", "laboratory=1", "laboratory = 1 must be a whole number of at least 2"),
        ("validate_users", "users.variant=V9", "users.variant = 'V9' must be one of passive, comply_or_resist"),
        ("validate_users", "~users.population.intention.utility_weights.away_wait", "away_wait is missing"),
        ("validate_users", "users.population.situation.position_jump=0", "position_jump = 0 must be a number above 0"),
        ("validate_users", "users.adaptation=maybe", "users.adaptation = 'maybe' must be on or off"),
        ("meta_train", "users.variant=V9", "users.variant = 'V9' must be one of passive, comply_or_resist"),
        ("evaluate", "users.withdrawn=[joy]", "users.withdrawn: 'joy' must be one of helpfulness"),
        ("evaluate", "users.advisors=nobody.safetensors", "no such file: nobody.safetensors"),
        ("train", "algorithm.fisher_subsample=2", "algorithm.fisher_subsample = 2"),
        ("train", "hidden=[]", "hidden"),
        ("train", "inputs=puck", "inputs = 'puck' must be 'table' or 'paddle'"),
        ("train", "resume=nowhere", "resume = nowhere is not the folder of a run"),
        ("train", "action_cost=-0.1", "action_cost = -0.1 must be a finite number of at least 0"),
        ("train", "env.arm={mass: -1}", "env.arm.mass = -1 must be a finite number of at least"),
        ("train", "collector.workers=2", "collector.workers = 2 must be 1 where collector.kind = single"),
        ("train", "compute=tpu", "compute = tpu must be one of cpu"),
        ("meta_train", "maml.inner_lr=-0.1", "maml.inner_lr = -0.1"),
        ("meta_train", "demonstrations.games=1", "demonstrations.games = 1"),
        ("meta_train", "models.opponents=nowhere", "no such file: nowhere"),
        ("report", "runs=nowhere", "nowhere"),
        (
            "watch",
            "user=goalie",
            "user = goalie must be one of striker, wall, banker, counter, presser, all_round, null",
        ),
        ("watch", "skill=9", "skill = 9 must be a finite number of at least -4 and at most 4"),
        ("watch", "seconds=61", "seconds = 61 must be a finite number above 0 and at most 60"),
        ("watch", "frames_per_second=24", "frames_per_second = 24 must divide 50"),
        ("watch", "speed=3", "speed = 3 must be a finite number above 0 and at most 2"),
        ("watch", "width=100", "width = 100 must be a whole number of at least"),
        ("watch", "~condition", "~condition: condition cannot be left out, must be one of beyond/approach_gated, "),
        ("watch", "condition.letter=7", "condition.letter = '7' must be one of a to z"),
        ("collect", "people=everyone", "people = everyone must be training or study"),
        ("collect", "demonstrations.ticks=2.5", "demonstrations.ticks = 2.5 must be a whole number"),
        ("collect", "opponent=1000", "generation = 1000 must be below 101"),
        ("play", "device=joystick", "device = joystick must be one of forcedimension, gamepad, mouse, simulated"),
        ("play", "device.max_speed=0", "device.max_speed = 0 must be a finite number above 0"),
        ("play", "device=gamepad", "device: gamepad = 0 must be the index of a connected gamepad"),
        ("play", "condition=uphg_ua", "condition = uphg_ua needs a model of you"),
        ("play", "seconds=0", "seconds = 0 must be a finite number above 0"),
        ("play", "safety.force=-1", "safety.force = -1"),
    ],
)
def test_wrong_values_end_in_one_line(capsys, tmp_path, name, argument, message):
    assert message in complaint(capsys, tmp_path, name, argument)


def test_models_of_another_kind_or_broken_are_refused(capsys, tmp_path):
    broken, other = tmp_path / "broken.safetensors", tmp_path / "other.safetensors"
    broken.write_bytes(b"\x80\x04no tensors")
    save_tensors(other, GaussianPolicy([8]).state_dict(), {"hidden": [9], "inner_lr": 0.1})
    cases = [
        (f"models.meta={broken}", "is not a safetensors file"),
        (f"models.meta={other}", "the model has"),
        (f"models.league={other}", "the model has"),
        ("models.meta=guidance/pretrained/now/user.safetensors", "not meta-learned"),
    ]
    for argument, message in cases:
        assert message in complaint(capsys, tmp_path, "evaluate", argument)
    save_tensors(other, {"x": torch.zeros(1)})
    assert "not a file of this project" in complaint(capsys, tmp_path, "evaluate", f"models.user={other}")


def test_commands_start_from_any_folder(tmp_path):
    arguments = ["evaluate", "+preset=smoke", "condition=nhg", "hydra.run.dir=run"]
    done = start("airhockey_marl", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "trials.csv").is_file()
