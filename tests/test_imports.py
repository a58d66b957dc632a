"""Who may import whom: the world knows nothing of haptics, leaves no other module, and nobody imports a command.

Leaves may import `checks`, a leaf itself: what an argument is refused with, and no part of what a module is about.
"""

import ast
from pathlib import Path

import pytest

from tests import ROOT

MODULES = sorted(path for package in ("airhockey_marl", "guidance") for path in (ROOT / package).rglob("*.py"))
LEAVES = {
    "airhockey_marl": {"checks", "table", "policy", "trpo", "samplers", "learner", "files"},
    "guidance": {"maml", "forces", "metrics", "stats", "safety", "clock"},
}
COMMANDS = {
    *(f"airhockey_marl.{name}" for name in ("train", "league_report", "compare", "grid")),
    *(
        f"guidance.{name}"
        for name in (
            "collect",
            "battery",
            "watch",
            "prediction_report",
            "meta_train",
            "calibrate",
            "evaluate",
            "replicate",
            "runs",
            "play",
            "lab",
        )
    ),
}


def imports(path: Path) -> set[str]:
    """The project's modules that a file imports, as dotted names."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in found if name.split(".")[0] in LEAVES}


def test_the_world_knows_nothing_of_guidance():
    for path in MODULES:
        if path.is_relative_to(ROOT / "airhockey_marl"):
            assert not [name for name in imports(path) if name.startswith("guidance")], path


@pytest.mark.parametrize(
    ("package", "leaf"), [(package, leaf) for package in LEAVES for leaf in sorted(LEAVES[package])]
)
def test_leaves_import_no_other_module_of_the_project(package, leaf):
    found = imports(ROOT / package / f"{leaf}.py")
    assert {
        name for name in found if leaf == "checks" or not name.startswith("airhockey_marl.experiment.validation")
    } == set()


def test_commands_are_imported_by_nobody():
    for path in MODULES:
        assert not imports(path) & COMMANDS, path


def test_imports_run_one_way():
    """No module imports, directly or not, one that imports it."""
    of = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in MODULES}
    graph = {name: {target for target in imports(path) if target in of} for name, path in of.items()}
    graph["guidance.simulated_users"] = (
        set()
    )  # the package's face imports its rooms, which import each other by full name
    visiting, done = set(), set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in visiting, " -> ".join((*trail, name))
        if name not in done:
            visiting.add(name)
            for target in graph[name]:
                visit(target, (*trail, name))
            visiting.discard(name)
            done.add(name)

    for name in graph:
        visit(name, ())
