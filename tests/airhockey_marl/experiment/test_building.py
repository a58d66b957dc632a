"""Nothing but this project's classes is made from a configuration, wherever in it a target hides."""

import sys

import pytest
from omegaconf import OmegaConf

from airhockey_marl.commands import train
from airhockey_marl.experiment.building import CLASSES, build
from airhockey_marl.experiment.command import CONF, InputError
from guidance.commands import evaluate
from guidance.forces.conditions import Spring

SPRING = {"_target_": "guidance.forces.conditions.Spring", "stiffness": 50.0, "limit": 3.0, "reach": 0.075}


@pytest.fixture
def trap(tmp_path):
    """A file that is there once something was executed."""
    return tmp_path / "executed"


def hostile(trap) -> dict:
    return {"_target_": "os.system", "command": f"touch {trap}"}


@pytest.mark.parametrize(
    ("place", "wrap"),
    [
        ("part._target_", lambda node: node),
        ("part.stiffness._target_", lambda node: SPRING | {"stiffness": node}),
        ("part.deep[1].er._target_", lambda node: {"deep": [1, {"er": node}]}),
        ("part._args_[0]._target_", lambda node: SPRING | {"_args_": [node]}),
        ("part.x._target_", lambda node: {"x": node | {"_partial_": True}}),
        ("part.x._target_", lambda node: {"x": node | {"_recursive_": False}}),
    ],
)
def test_a_foreign_target_is_refused_by_its_place_and_not_called(trap, place, wrap):
    node = OmegaConf.create({"part": wrap(hostile(trap))})
    with pytest.raises(InputError, match=r"= os\.system must be a class of guidance\.conditions") as refused:
        build(node.part)
    assert str(refused.value).startswith(place) and not trap.exists()


def test_a_target_behind_a_reference_or_in_an_argument_is_refused(trap):
    node = OmegaConf.create({"name": "os.system", "part": {"_target_": "${name}", "command": f"touch {trap}"}})
    for make in (lambda: build(node.part), lambda: build(OmegaConf.create(SPRING), stiffness=hostile(trap))):
        with pytest.raises(InputError, match=r"os\.system"):
            make()
    assert not trap.exists()


@pytest.mark.parametrize(
    "target",
    [
        "builtins.eval",
        "guidance.forces.conditions.torch.hub.load",  # what a module of ours has imported
        "guidance.forces.conditions.Tensor",
        "guidance.forces.conditions.combine",
        "guidance.haptics.servo.ServoProcess",  # ours, but starts what it is told to
        "airhockey_marl.experiment.files.write_text",
        "guidance.forces.conditions",
        "Spring",
        "",
        7,
        None,
    ],
)
def test_only_classes_meant_for_it_can_be_named(target):
    with pytest.raises(InputError, match="must be a class of"):
        build(OmegaConf.create({"_target_": target}))


def test_what_is_ours_is_made():
    assert build(OmegaConf.create(SPRING)) == Spring(50.0, 3.0, 0.075)
    assert build(OmegaConf.create(SPRING), stiffness=20.0) == Spring(20.0, 3.0, 0.075)


def test_every_target_of_conf_may_be_made_and_no_class_is_allowed_in_vain():
    named = {
        line.split("_target_:")[1].split()[0]
        for path in CONF.rglob("*.yaml")
        if path.relative_to(CONF).parts[0] not in ("hydra", "sweep")  # which Hydra makes, not we
        for line in path.read_text(encoding="utf-8").splitlines()
        if "_target_:" in line
    }
    for target in named:
        assert target in CLASSES or target.rpartition(".")[0] in (
            "guidance.forces.conditions",
            "airhockey_marl.league.opponent_sampling",
        )
    assert set(CLASSES) <= named


@pytest.mark.parametrize(
    ("command", "key"),
    [
        (train, "algorithm.critic"),
        (train, "league.sampler"),
        (evaluate, "study"),
        (evaluate, "users.population"),
        (evaluate, "guidance.spring"),
    ],
)
def test_a_command_refuses_it_in_one_line(monkeypatch, capsys, tmp_path, trap, command, key):
    arguments = [f"{key}._target_=os.system", f"+{key}.command='touch {trap}'", f"hydra.run.dir={tmp_path}/run"]
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and "os.system must be a class of" in said, said
    assert not trap.exists()
