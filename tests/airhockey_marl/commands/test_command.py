"""How commands start: quickly, with a manual, and with one clear line for anything that is typed wrong."""

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from airhockey_marl.__main__ import find_commands, main
from airhockey_marl.experiment.command import CONF, run, tolerant_output
from airhockey_marl.experiment.config import check_overrides
from airhockey_marl.experiment.files import write_json
from tests import ROOT

HEAVY = ("torch", "numba", "numpy", "pandas", "pingouin", "matplotlib", "tensorboard", "scipy")
COMMANDS = find_commands()
CONDITIONS = "beyond/approach_gated, beyond/blended, beyond/product, combhg_ua, combhg_ua_sc, combhg_ut_ua_sc, "
CONDITIONS += "nhg, oahg, oahg_ut, uphg, uphg_ua, uphg_ut_ua"
FORM = "must be key=value, with its brackets closed and special characters quoted: 'key=\"a b\"'"


def modules_after(*arguments: str, code: int = 0) -> set[str]:
    """The heavy modules that a command has imported by its end."""
    script = "import sys, atexit; from airhockey_marl.__main__ import main\n"
    script += f"atexit.register(lambda: print([m for m in {HEAVY} if m in sys.modules]))\nmain()"
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([], 0),
        (["evaluate", "--help"], 0),
        (["play", "-h"], 0),
        (["evaluate", "participant=3"], 2),
        (["evaluate", "participants=many"], 2),
        (["train", "algorithm=dqn"], 2),
        (["compare"], 2),
        (["evaluate", "participants=0"], 2),
        (["train", "batch=333"], 2),
        (["evaluate", "--cfg", "job"], 0),
        (["runs", "status=done"], 0),
    ],
)
def test_what_needs_no_model_imports_none(tmp_path, arguments, code):
    (tmp_path / "outputs").mkdir()
    arguments += [f"outputs={tmp_path}/outputs"] if arguments[:1] == ["runs"] else []
    arguments += [f"hydra.run.dir={tmp_path}/run"] if code else []
    assert modules_after(*arguments, code=code) == "[]"


def test_completion_knows_groups_and_keys():
    environment = os.environ | {"COMP_LINE": "python evaluate condition=oa", "COMP_POINT": "28"}
    command = [sys.executable, "-m", "guidance", "evaluate", "-sc", "query=bash"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=100, check=True)
    assert {"condition=oahg", "condition=oahg_ut"} <= set(done.stdout.split())


@pytest.mark.parametrize(
    ("name", "argument", "message"),
    [
        ("evaluate", "foo", f"foo {FORM}"),
        ("evaluate", "condition=[a", f"condition=[a {FORM}"),
        ("evaluate", 'condition="a', f'condition="a {FORM}'),
        ("evaluate", "=3", "=3 must be key=value"),
        ("evaluate", "+data=", "data = : no such key; --help lists those there are"),
        ("evaluate", "condition=", f"condition = must be one of {CONDITIONS}"),
        ("evaluate", "condition=oahg,null", f"condition = null must be one of {CONDITIONS}"),
        ("watch", "condition=null", f"condition = null must be one of {CONDITIONS}"),
        ("train", "algorithm=null", "algorithm = null must be one of ppo, sac, trpo"),
        ("evaluate", "~x", "x: no such key; --help lists those there are"),
        ("evaluate", "~seed", "~seed: seed cannot be left out"),
        ("evaluate", "~users", "~users: users cannot be left out, must be one of default, novice"),
        ("evaluate", "++seed=x", "seed = x must be a whole number"),
        ("evaluate", "seed=", "seed = must be a whole number"),
        ("evaluate", "seed=1,x", "seed = x must be a whole number"),
        ("evaluate", "participants=3.5", "participants = 3.5 must be a whole number"),
        ("evaluate", "participants=null", "participants = null must be a whole number"),
        ("report", "mixed=1", "mixed = 1 must be true or false"),
        ("evaluate", "guidance.lookahead.seconds=far", "guidance.lookahead.seconds = far must be a number"),
        (
            "evaluate",
            "guidance.lookahead=0.1",
            "guidance.lookahead = 0.1 must be set by its keys: guidance.lookahead.seconds, guidance.lookahead.reading",
        ),
        ("evaluate", "seed='${nowhere}'", "seed: Interpolation key 'nowhere' not found"),
        ("evaluate", "conditon=oahg", "conditon = oahg: no such key; did you mean condition?"),
        ("evaluate", "guidance.lookahed=0", "guidance.lookahed = 0: no such key; did you mean guidance.lookahead?"),
        ("evaluate", "inner_lr=1", "inner_lr = 1: no such key; --help lists those there are"),
        ("meta_train", "inner_lr=1", "inner_lr = 1: no such key; did you mean maml.inner_lr?"),
        ("evaluate", "algorithm=ppo", "algorithm = ppo: no such key; --help lists those there are"),
        ("evaluate", "hydra.run.dirr=x", "hydra.run.dirr = x: no such key; did you mean hydra.run.dir?"),
        ("evaluate", "--nonsense", "unrecognized arguments: --nonsense; --help says what can be typed"),
        ("evaluate", "--cfg", "argument --cfg/-c: expected one argument; --help says what can be typed"),
        ("compare", "rounds=3", "runs must be chosen: runs=..."),
        (
            "evaluate",
            "--plugin=nobody",
            "plug-in nobody (AIRHOCKEY_PLUGINS): ModuleNotFoundError: No module named 'nobody'",
        ),
    ],
)
def test_whatever_is_typed_wrong_ends_in_one_line(capsys, monkeypatch, name, argument, message):
    monkeypatch.setenv("AIRHOCKEY_PLUGINS", "")
    with pytest.raises(SystemExit) as stopped:
        run(COMMANDS[name].module, [argument])
    shown = capsys.readouterr()
    assert (stopped.value.code, shown.err, shown.out) == (2, f"error: {message}\n", "")


@pytest.mark.parametrize(
    ("name", "argument", "key", "value"),
    [
        *(
            ("lab", f"participant={label}", "participant", label)
            for label in ("1_01", "10_1", "12e3", "true", "+5", "1e400", "null", "nan", "007", "0x10", "1.0", "P01")
        ),
        ("lab", "records=20_24", "records", "20_24"),
        ("lab", "scale=[1, never at all,7.50]", "scale", ["1", "never at all", "7.50"]),
        ("lab", "scale.0=1e0", "scale.0", "1e0"),
        ("lab", "questions.comfort=5", "questions.comfort", "5"),
        *(
            ("lab", f"questions.comfort={item}", "questions.comfort", item)
            for item in (
                "Wie angenehm war die Führung?",
                "Wie angenehm, alles in allem, war sie?",
                "Wie gut: (sehr), „gut“ oder so?",
                "How's it, a=b?",
                '"Hilfe" oder "Last"?',
                "편안했습니까?",
            )
        ),
        ("lab", "questions.comfort='Gut, „so“?'", "questions.comfort", "Gut, „so“?"),
        ("lab", "scale=[überhaupt nicht, sehr]", "scale", ["überhaupt nicht", "sehr"]),
        ("lab", "records=/tmp/größe, x", "records", "/tmp/größe, x"),
        ("report", "runs=[2024,1_0,a/1_0,'3']", "runs", ["2024", "1_0", "a/1_0", "3"]),
        ("watch", "run=1_0", "run", "1_0"),
        ("train", "resume=1_0", "resume", "1_0"),
        ("train", "resume=null", "resume", None),
        ("evaluate", "opponent=1_0", "opponent", 10),
        ("evaluate", "metrics=[1_0]", "metrics", ["1_0"]),
        ("evaluate", "beyond=true", "beyond", True),
        ("evaluate", "hydra.run.dir=1_0", "hydra.run.dir", "1_0"),
        ("replicate", "ray=127.0.0.1:6379", "ray", "127.0.0.1:6379"),
        ("runs", "outputs=${oc.env:HOME}/1_0", "outputs", f"{os.environ['HOME']}/1_0"),
    ],
)
def test_a_name_is_the_text_that_was_typed(name, argument, key, value):
    arguments = [argument, *(["participant=P1"] if name == "lab" and "participant" not in argument else [])]
    loaded = check_overrides(CONF, name, arguments)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose(name, loaded, return_hydra_config=True)
    assert OmegaConf.select(cfg, key) == value


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_output_never_fails_on_a_character(monkeypatch, encoding):
    stream = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    with tolerant_output():
        print("– Ω 한국어 é")
    stream.seek(0)
    assert stream.read().startswith("? ? ??? ")


@pytest.mark.parametrize("redirection", [">/dev/full", "| head -c 1", ">&-", "2>/dev/full >&2"])
def test_output_that_nobody_takes_makes_no_command_fail(tmp_path, redirection):
    (tmp_path / "run").mkdir()
    write_json(tmp_path / "run" / "run.json", {"command": "train", "status": "done"})
    line = f"set -o pipefail; {sys.executable} -m airhockey_marl runs outputs={tmp_path} {redirection}"
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_null_is_a_choice_where_it_is_the_default(capsys):
    run(COMMANDS["evaluate"].module, ["condition=null", "--cfg", "job"])
    assert "condition:" not in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_the_manual_of_this_command(capsys, name):
    run(COMMANDS[name].module, ["--help"])
    text = capsys.readouterr().out
    assert (CONF / f"{name}.yaml").read_text().strip() in text and COMMANDS[name].doc in text
    assert (f"airhockey {name}" in text) or (f"python -m {name}" in text) or name in ("train", "evaluate")
    groups = text.partition("Groups\n")[2].partition("\nKeys")[0]
    assert ("algorithm = ppo | sac | trpo" in groups) == (name == "train")
    assert ("sweep = " in groups) == (name in ("train", "meta_train")) and "preset = smoke" in groups


def test_the_commands_are_listed_by_package_with_a_line_each(capsys):
    main([])
    lines = capsys.readouterr().out.splitlines()
    for name, command in COMMANDS.items():
        assert f"  {name:17}  {command.doc.splitlines()[0].rstrip('.')}" in lines
    assert {"airhockey_marl", "guidance"} <= {*lines}


def test_an_unknown_command_is_asked_about(capsys):
    with pytest.raises(SystemExit):
        main(["evalute", "seed=1"])
    assert capsys.readouterr().err == "error: evalute: no such command; did you mean evaluate?\n"


def test_another_package_brings_commands_with_their_own_configuration(tmp_path):
    package = tmp_path / "mine"
    for folder in ("commands", "conf", "../mine-1.dist-info"):
        (package / folder).mkdir(parents=True)
    for file in ("__init__.py", "commands/__init__.py"):
        (package / file).touch()
    (package / "commands" / "greet.py").write_text('"""Greet."""\n\ndef main(cfg):\n    print("hello", cfg.name)\n')
    (package / "conf" / "greet.yaml").write_text("defaults:\n  - hydra: outputs\n  - _self_\nname: you\n")
    (tmp_path / "mine-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    (tmp_path / "mine-1.dist-info" / "entry_points.txt").write_text("[airhockey.commands]\nmine = mine.commands\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]), "AIRHOCKEY_OUTPUTS": "runs"}

    def airhockey(*arguments: str) -> str:
        command = [sys.executable, "-m", "airhockey_marl", *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    assert "mine\n  greet" in airhockey()
    assert airhockey("greet", "name=me").splitlines()[1:] == ["hello me"] and list(
        tmp_path.glob("runs/greet/*/*/run.json")
    )


@pytest.mark.slow
def test_an_installed_wheel_works_in_any_folder_without_anything_writable_but_that(tmp_path):
    """Neither the sources nor the environment nor a home: as an unprivileged user, or as root without its privilege."""
    pytest.importorskip("setuptools")
    source, environment, place = tmp_path / "source", tmp_path / "environment", tmp_path / "place"
    ignored = shutil.ignore_patterns(".git", ".venv*", "outputs", "build", "*.egg-info", "__pycache__", "tests")
    shutil.copytree(ROOT, source, symlinks=True, ignore=ignored)
    pip = [sys.executable, "-m", "pip", "--quiet"]
    subprocess.run([*pip, "wheel", ".", "--no-deps", "--no-build-isolation", "-w", tmp_path], cwd=source, check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    python = environment / "bin" / "python"
    subprocess.run([*pip, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True)
    (packages,) = environment.glob("lib/*/site-packages")
    dependencies = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "dependencies.pth").write_text("\n".join(dependencies))
    shutil.rmtree(source)
    place.mkdir()
    drop = ["setpriv", "--inh-caps=-all", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    if drop and not shutil.which("setpriv"):
        pytest.skip("as root, everything can be written to")
    home = {"HOME": str(environment)}
    variables = {
        key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "AIRHOCKEY_OUTPUTS")
    } | home
    subprocess.run(["chmod", "-R", "a-w", environment], check=True)
    try:
        for arguments in (["train", "+preset=smoke"], ["evaluate", "+preset=smoke", "condition=nhg"], ["runs"]):
            command = [*drop, environment / "bin" / "airhockey", *arguments]
            done = subprocess.run(command, cwd=place, env=variables, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            notes = [line for line in done.stderr.splitlines() if line.startswith("note: compiled code is not kept")]
            assert len(notes) == (arguments != ["runs"])  # which compiles nothing
    finally:
        subprocess.run(["chmod", "-R", "u+w", environment], check=True)
    assert "done" in done.stdout and list(place.glob("outputs/train/*/*/league.safetensors"))
    (record,) = place.glob("outputs/evaluate/*/*/run.json")
    assert json.loads(record.read_text())["status"] == "done" and (record.parent / "report.html").is_file()
    assert {path.name for path in place.iterdir()} == {"outputs"} and isinstance(place, Path)
