"""README: its Python snippets run, and the files that the READMEs link to exist."""

import os
import re
import shlex
from itertools import chain
from pathlib import Path
from urllib.parse import unquote

import pytest
from hydra._internal.utils import get_args_parser

from airhockey_marl.__main__ import find_commands
from airhockey_marl.experiment.command import missing_extra
from airhockey_marl.experiment.config import CONF, check_overrides
from tests import ROOT
from tests.processes import start

READMES = sorted(
    path
    for path in chain(
        *(ROOT.glob(f"{folder}README*.md") for folder in ("", "*/", "*/*/")), (ROOT / ".github").glob("*.md")
    )
    if not path.is_relative_to(ROOT / "outputs")
)
SNIPPETS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
DOCUMENTS = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in READMES}
DOCUMENTS |= {f"airhockey {name} --help": command.doc for name, command in find_commands().items()}
COMMAND = re.compile(r"(?:^ {4}|`)(?:python -m (?:guidance|airhockey_marl)[. ]|airhockey )(\w+)((?: [^`\n]*)?)", re.M)
LINES = sorted(
    {
        (name, re.sub(r"<[^>]*>", "x", arguments.partition("#")[0].partition("  ")[0].strip()))
        for text in DOCUMENTS.values()
        for name, arguments in COMMAND.findall(text.replace("\\\n", " "))
    }
)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|<img[^>]* src=\"([^\"]+)\"")


@pytest.mark.parametrize("snippet", SNIPPETS, ids=[f"snippet {number}" for number in range(1, len(SNIPPETS) + 1)])
def test_snippets_run(snippet, tmp_path, monkeypatch):
    """Each in a namespace and an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {"__name__": "readme"})


def arguments_of(line: str) -> list[str]:
    """Of a command line of a README, without plug-ins, which belong to the reader."""
    arguments = [argument for argument in shlex.split(line) if not argument.startswith("--plugin=")]
    own = re.compile("lazy|my_gate|mymouse")
    return [argument for argument in arguments if not own.search(argument)]


def test_the_command_lines_are_all_seen():
    assert len(LINES) > 60 and {name for name, _ in LINES} == {*find_commands()}


@pytest.mark.parametrize(("name", "line"), LINES, ids=[" ".join(line) for line in LINES])
def test_command_lines_are_what_the_commands_take(name, line):
    """Their groups, choices and keys are there, and the values are of the right kind."""
    command = find_commands()[name]
    options = get_args_parser().parse_intermixed_args(command.expand(arguments_of(line)))
    if missing_extra(options.overrides):
        pytest.skip("needs an extra that is not installed")
    mandatory = re.findall(r"^(\w+): \?\?\?$", (CONF / f"{name}.yaml").read_text(encoding="utf-8"), re.M)
    typed = {override.partition("=")[0] for override in options.overrides}
    required = [f"{key}=x" for key in mandatory if key not in typed]
    check_overrides(CONF, name, [*options.overrides, *required])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "line"), LINES, ids=[" ".join(line) for line in LINES])
def test_command_lines_run_on_a_tiny_budget(name, line, tmp_path):
    """Those that need neither an earlier run, a device, a cluster nor a sweep."""
    if re.search(r"\.\.\.|outputs/|<|-m |device=|ray|P0|P7|lab|^new|cores|--help|--cfg", line) or name in (
        "lab",
        "play",
    ):
        pytest.skip("needs what is not here")
    arguments = [*arguments_of(line), *([] if "preset" in line else ["+preset=smoke"]), f"hydra.run.dir={tmp_path}/run"]
    done = start("airhockey_marl", name, *arguments, env={"AIRHOCKEY_OUTPUTS": str(tmp_path)})
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("readme", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_linked_files_exist(readme: Path):
    for groups in LINK.findall(re.sub(r"^```.*?^```$", "", readme.read_text(encoding="utf-8"), flags=re.M | re.S)):
        target = unquote("".join(groups)).partition("#")[0]
        if target and not re.match(r"[a-z]+:", target):
            file = Path(os.path.normpath(readme.parent / target))
            assert file.is_relative_to(ROOT) and file.exists(), f"{readme}: {target}"
