"""Architecture: imports only go down the lists of layers, and folders stay small."""

import ast
from pathlib import Path

from tests import ROOT

# Folders of each package from the bottom up. A module imports its own folder and the layers before it; `guidance` also
# imports all of `airhockey_marl` but the commands.
LAYERS = {
    "airhockey_marl": [
        {"experiment"},
        {"envs"},
        {"players"},
        {"league", "algorithms"},
        {"evaluation"},
        {"self_play"},
        {"commands"},
    ],
    "guidance": [
        {"forces"},
        {"simulated_users"},
        {"user_model", "haptics"},
        {"study", "display"},
        {"statistics"},
        {"sessions"},
        {"commands"},
    ],
}
PACKAGES = tuple(LAYERS)
# Above all layers: the documented entry points, the shipped models, and examples that use the whole package.
TOP = {"__main__", "train", "evaluate", "pretrained", "examples"}
MAX_ENTRIES = 14

MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}


def imports(path: Path) -> set[str]:
    """Modules of this project that a file imports, wherever in the file, as dotted names."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in names if name in MODULES}


GRAPH = {name: imports(path) - {name} for name, path in MODULES.items()}


def layer(module: str) -> int | None:
    """Index of a module's layer in its package; None for the package itself and what is above all layers."""
    package, folder, *_ = [*module.split("."), ""]
    if folder == "" or folder in TOP:
        return None
    (index,) = [number for number, folders in enumerate(LAYERS[package]) if folder in folders]
    return index


def test_every_folder_has_a_layer():
    for package, layers in LAYERS.items():
        folders = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
        assert folders <= set.union(*layers) | TOP


def test_imports_go_down():
    upward = []
    for module, names in GRAPH.items():
        package, folder, *_ = [*module.split("."), ""]
        for name in sorted(names):
            other_package, other_folder, *_ = [*name.split("."), ""]
            if layer(module) is None or other_folder in ("", folder) or other_package != package:
                continue
            if other_folder in TOP or layer(name) >= layer(module):
                upward.append(f"{module} imports {name}")
    assert not upward


def test_imports_have_no_cycle():
    visiting, done = [], set()

    def visit(name: str) -> None:
        assert name not in visiting, " -> ".join((*visiting, name))
        if name not in done:
            visiting.append(name)
            for target in sorted(GRAPH[name]):
                visit(target)
            visiting.pop()
            done.add(name)

    for name in GRAPH:
        visit(name)


def test_only_entry_points_import_commands():
    for module, names in GRAPH.items():
        if module.split(".")[1:] not in (["__main__"], ["train"], ["evaluate"]):
            commands = {name for name in names if name.startswith(f"{name.split('.')[0]}.commands.")}
            assert not commands, f"{module} imports {commands}"


def test_airhockey_marl_does_not_name_guidance():
    """Not in an import, and not in a string such as a class path or the module of a command."""
    named = []
    for module, path in MODULES.items():
        if module.startswith("guidance"):
            continue
        named += [f"{path}: imports {name}" for name in GRAPH[module] if name.startswith("guidance")]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "guidance." in node.value:
                named.append(f"{path}:{node.lineno}: {node.value!r}")
    assert not named


def test_folders_of_code_are_small():
    for package in (*PACKAGES, "tests"):
        for folder in {path.parent for path in (ROOT / package).rglob("*.py")}:
            entries = {path.name for path in folder.iterdir()} - {"__pycache__", "__init__.py"}
            assert len(entries) <= MAX_ENTRIES, f"{folder}: {len(entries)} entries"
