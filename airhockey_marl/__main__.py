"""Air hockey from the command line: `airhockey` lists the commands, `airhockey <command> key=value ...` runs one.

    airhockey                        this list
    airhockey <command> --help       what it does, and everything that can be set
    airhockey train +preset=smoke    one of them

A package brings commands by an entry point of the group `airhockey.commands` that names a package of modules, such as
`mine = "mine.commands"`; each module is a command, see `airhockey_marl.experiment.command`.
"""

import pkgutil
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from airhockey_marl.experiment.command import Command, print_error, run, tolerant_output

GROUP = "airhockey.commands"


@tolerant_output()
def main(argv: Sequence[str] | None = None) -> None:
    """List the commands, or run the one that the first argument, by default of the process, names."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments.pop(0) if arguments else "--help"
    commands = find_commands()
    if name in ("-h", "--help", "help"):
        print(overview(commands))
    elif name in commands:
        run(commands[name].module, arguments)
    else:
        near = get_close_matches(name, commands, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(commands)}"
        print_error(f"{name}: no such command; {hint}")
        sys.exit(2)


def find_commands() -> dict[str, Command]:
    """The commands by name: of this package, and of those installed, which cannot replace an earlier one."""
    commands: dict[str, Command] = {}
    for package in dict.fromkeys([f"{__package__}.commands", *installed(), *beside()]):
        for module in pkgutil.iter_modules(find_spec(package).submodule_search_locations):
            commands.setdefault(module.name, Command(f"{package}.{module.name}"))
    return commands


def installed() -> list[str]:
    """The packages of commands that installed distributions bring."""
    names = sorted(entry.value for entry in entry_points(group=GROUP))
    return [name for name in names if find_spec(name.partition(".")[0]) is not None]


def beside() -> list[str]:
    """The packages of commands in this source tree, whose entry points are unknown as long as it is not installed."""
    root = Path(__file__).parents[1]
    if not (root / "pyproject.toml").is_file():
        return []
    return sorted(".".join(file.relative_to(root).parts[:2]) for file in root.glob("*/commands/__init__.py"))


def overview(commands: dict[str, Command]) -> str:
    """The commands with a line each, by package."""
    width = max(map(len, commands))
    lines, package = [__doc__.strip()], ""
    for name, command in commands.items():
        if (head := command.module.rpartition(".")[0]) != package:
            package = head
            lines += ["", package.removesuffix(".commands")]
        lines.append(f"  {name:{width}}  {command.doc.splitlines()[0].rstrip('.')}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
