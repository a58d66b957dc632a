"""How every command starts: Hydra underneath, a manual for `--help`, one clear line for an error.

A command is a module in a package `commands`: its docstring is the manual, `main(cfg)` runs it, and `check(cfg)`, if it
has one, raises a ValueError for values that it cannot run with. It is configured by `conf/<name of the module>.yaml`,
where the keys `seed`, `threads`, `compute` and `resume` mean the same for all commands, see `prepare`. What is typed is
checked before the module is imported, because models, compilers and statistics take seconds to import.
"""

import ast
import atexit
import io
import os
import shutil
import sys
import tempfile
import traceback
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import hydra
from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from airhockey_marl.experiment.config import (
    COMMAND_GROUPS,
    CONF,
    STATE_FILE,
    InputError,
    also_search,
    check_overrides,
    default_choices,
    describe,
    group_options,
    resumed_config,
)
from airhockey_marl.experiment.files import UNWRITABLE, WriteError
from airhockey_marl.experiment.registry import ENVIRONMENT, load_plugins
from airhockey_marl.experiment.validation import check_counts, check_numbers

PACKAGE = Path(__file__).parents[1]
LAUNCHERS = Path(__file__).parent / "launchers"
RAY = "hydra/launcher=ray"
EXTRAS = {  # by what is typed: the module that it needs, and the extra of this package that brings it
    "hydra/launcher=cores": ("hydra_plugins.hydra_joblib_launcher", "joblib"),
    "hydra/launcher=slurm": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    RAY: ("ray", "ray"),
    "hydra/sweeper=optuna": ("hydra_plugins.hydra_optuna_sweeper", "optuna"),
    "sweep/": ("hydra_plugins.hydra_optuna_sweeper", "optuna"),
}

_terminal: Any = None  # standard error while Hydra's own is held back, see `run`


@dataclass(frozen=True)
class Command:
    """A command, by the name of its module. Called with a configuration it imports the module and runs it.

    A launcher sends it to other processes: there, the module is imported anew.
    """

    module: str

    @property
    def name(self) -> str:
        return self.module.rpartition(".")[2]

    @cached_property
    def conf(self) -> Path:
        """The folder of its yaml: `conf` beside a package of commands that brings its own, else this project's."""
        own = Path(find_spec(self.module).origin).parents[1] / "conf"
        return own if (own / f"{self.name}.yaml").is_file() else CONF

    @cached_property
    def doc(self) -> str:
        """The module's docstring, without importing the module."""
        return ast.get_docstring(ast.parse(Path(find_spec(self.module).origin).read_bytes())) or ""

    def __call__(self, cfg: DictConfig) -> float | None:
        """Run one job; in a sweep the others go on if it fails, so that it says here and now why."""
        with tolerant_output(), redirect_stderr(_terminal or sys.stderr):
            try:
                OmegaConf.to_container(cfg, resolve=True)  # finds a broken reference now
                provide_numba_cache()
                module = import_module(self.module)
                cfg = prepare(cfg, module)
                if HydraConfig.get().output_subdir is not None:
                    print("run folder:", cfg.get("resume") or HydraConfig.get().runtime.output_dir, flush=True)
                return module.main(cfg)
            except Exception as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    _print_failed(error)
                raise

    def manual(self) -> str:
        """The text of `--help`: the docstring, the options of each group, and the yaml as commented."""
        with initialize_config_dir(str(self.conf), version_base="1.3"):
            options = group_options(self.conf, self.name)
        lines = [
            self.doc,
            "",
            "Every key below can be set on the command line: key=value, group=choice, +preset=smoke;",
            "-m sweeps: key=1,2,3 or 'condition=glob(*)'. --cfg job prints the resolved configuration.",
            "--plugin=module imports a module that registers conditions, algorithms or other things of its own.",
            "",
            "Groups",
            *(f"  {group} = {' | '.join(names)}" for group, names in options.items()),
            "",
            f"Keys (conf/{self.name}.yaml)",
            (self.conf / f"{self.name}.yaml").read_text(encoding="utf-8").rstrip(),
            "",
        ]
        return "\n".join(lines)

    def expand(self, arguments: Sequence[str]) -> list[str]:
        """What arguments stand for: --clean for clean=true, +preset=smoke for +preset/<command>=smoke.

        The null of a group that is null by default is left out, Hydra refuses it.
        """
        keys = OmegaConf.load(self.conf / f"{self.name}.yaml")
        defaults = {
            f"{group}=null" for group, choice in default_choices(self.conf, self.name).items() if choice is None
        }
        expanded = []
        for argument in arguments:
            group, equals, choice = argument.lstrip("+").partition("=")
            if argument.startswith("--") and keys.get(argument[2:]) is False:
                expanded.append(f"{argument[2:]}=true")
            elif equals and group in COMMAND_GROUPS and (self.conf / group / self.name).is_dir():
                expanded.append(f"+{group}/{self.name}={choice}")
            elif argument not in defaults:
                expanded.append(argument)
        return expanded


class _TolerantStream:
    """A text stream that replaces characters which its encoding lacks, and drops what can no longer be written."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._dropped_if_closed():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._dropped_if_closed():
            self._stream.flush()

    @contextmanager
    def _dropped_if_closed(self) -> Iterator[None]:
        try:
            yield
        except OSError:  # nobody reads the pipe any more, or the disk is full; what is still buffered goes nowhere, too
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextmanager
def tolerant_output() -> Iterator[None]:
    """Within the block, what is printed cannot make a command fail that has done its work."""
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _TolerantStream(stream) for stream in streams)
    try:
        yield
    finally:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        sys.stdout, sys.stderr = streams


@tolerant_output()
def run(module: str, argv: Sequence[str] | None = None) -> None:
    """Run a command with the arguments, those of the process by default.

    Invalid input, whether it is found here, by Hydra or by the command (`InputError`), ends in one line on standard
    error and exit code 2. So do, with exit code 1, a disk that is full or may not be written to, and a training that
    diverged. Anything else is a bug and keeps its traceback.
    """
    global _terminal
    command = Command(module)
    try:
        arguments = command.expand(_load_plugins(sys.argv[1:] if argv is None else argv))
        if {"--help", "-h"} & {*arguments}:
            print(command.manual())
            return
        options = _parse_options(arguments)
        overrides = options.overrides
        if not options.shell_completion:
            if complaint := missing_extra(arguments):
                raise InputError(complaint)
            if RAY in {argument.lstrip("+") for argument in arguments}:
                sys.path.append(str(LAUNCHERS))  # Hydra looks for plugins below folders `hydra_plugins`, nowhere else
            overrides = check_overrides(command.conf, command.name, overrides, options.multirun)
        # Hydra takes overrides in one block only
        arguments = [argument for argument in arguments if argument not in options.overrides] + overrides
    except InputError as error:
        _fail(str(error), 2)
    wants_trace = os.environ.get("HYDRA_FULL_ERROR") == "1"
    arguments += also_search(command.conf)
    stderr, _terminal, argv_before = io.StringIO(), sys.stderr, sys.argv
    try:
        # Hydra then raises what it would print over many lines; and says on standard error what failed
        with redirect_stderr(stderr), env_override({"HYDRA_FULL_ERROR": "1"}):
            sys.argv = [sys.argv[0], *arguments]
            hydra.main(version_base="1.3", config_path=str(command.conf), config_name=command.name)(command)()
    except Exception as error:
        of_input = isinstance(error, InputError | HydraException | OmegaConfBaseException)
        text, trouble = str(error) if isinstance(error, InputError) else describe(error), _trouble(error)
        if options.multirun and not isinstance(error, HydraException) and not wants_trace:
            _fail(f"a job failed: {text}; `airhockey runs` says what became of each", 2 if of_input else 1)
        if trouble is not None:
            _fail(trouble, 1)
        if wants_trace or not of_input:
            raise
        _fail(text, 2)
    except SystemExit as stop:
        if isinstance(stop.code, str):  # a callback's, see `run_folder.RunRecorder`
            _fail(stop.code, 2)
        raise
    finally:
        sys.argv, _terminal = argv_before, None
    sys.stderr.write(stderr.getvalue())


@contextmanager
def report_input_errors() -> Iterator[None]:
    """For the part of a command that checks its input: a `ValueError` in it is the input's fault."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error)) from error


def require_counts(cfg: DictConfig, *keys: str, least: int = 1) -> None:
    """Raise an InputError if a key, dots for nesting, is not an integer >= `least`."""
    with report_input_errors():
        check_counts(least, **{key: OmegaConf.select(cfg, key) for key in keys})


def require_numbers(
    cfg: DictConfig, *keys: str, above: float = 0.0, least: float | None = None, at_most: float = float("inf")
) -> None:
    """Raise an InputError if a key is not a number > `above`, or >= `least` where it is given, and <= `at_most`."""
    lower = {"above": above} if least is None else {"least": least}
    with report_input_errors():
        check_numbers(**lower, at_most=at_most, **{key: OmegaConf.select(cfg, key) for key in keys})


def prepare(cfg: DictConfig, module: ModuleType) -> DictConfig:
    """Check a command's configuration, set the threads of torch, and return what the command is to run with.

    That is the configuration itself, or with `resume` that of the earlier run; the module's STATE_FILE is the file from
    which its runs resume, if that is not `config.STATE_FILE`.
    An InputError names a value that the command cannot run with, or a `compute` for which torch finds no device.
    """
    with report_input_errors():
        if cfg.get("resume") is not None:
            state = getattr(module, "STATE_FILE", STATE_FILE)
            cfg = resumed_config(Path(cfg.resume), state, cfg, HydraConfig.get().overrides.task)
        require_counts(cfg, *{"threads"} & {*cfg})
        require_counts(cfg, *{"seed"} & {*cfg}, least=0)
        if hasattr(module, "check"):
            module.check(cfg)
    if "threads" in cfg:
        import torch  # not above: commands start without it

        present = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
        if cfg.get("compute", "cpu") not in present:
            allowed = f"must be one of {', '.join(present)}, which are what there is here"
            raise InputError(f"compute = {cfg.compute} {allowed}")
        torch.set_num_threads(cfg.threads)
    return cfg


def missing_extra(arguments: Sequence[str]) -> str | None:
    """What to install for the launcher or sweeper that the arguments ask for; None if it is there."""
    for argument in arguments:
        for start, (module, extra) in EXTRAS.items():
            if argument.lstrip("+").startswith(start) and not _is_installed(module):
                return f"{argument} needs what `pip install 'airhockey-haptics[{extra}]'` brings: there is no {module}"
    return None


def provide_numba_cache() -> None:
    """Give numba a temporary folder for compiled code where no other can be written to: without one it raises.

    matplotlib, which makes a folder of its own but says so in many words, is given the same. A process that compiled
    something says in the end that it is not kept.
    """
    user = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    if os.environ.get("NUMBA_CACHE_DIR") or _is_writable(PACKAGE) or _is_writable(Path(user)):
        return
    os.environ["NUMBA_CACHE_DIR"] = folder = tempfile.mkdtemp(prefix="airhockey-numba-")
    os.environ.setdefault("MPLCONFIGDIR", folder)
    atexit.register(_remove_numba_cache, folder)


def _remove_numba_cache(folder: str) -> None:
    if "numba" in sys.modules:
        note = "note: compiled code is not kept, it will be compiled again: NUMBA_CACHE_DIR=... keeps it"
        print(note, file=sys.stderr)
    shutil.rmtree(folder, ignore_errors=True)


def _is_writable(folder: Path) -> bool:
    """Whether a folder can be written to, or made."""
    existing = next((place for place in (folder, *folder.parents) if place.exists()), None)
    return existing is not None and folder.is_absolute() and os.access(existing, os.W_OK | os.X_OK)


def _load_plugins(arguments: Sequence[str]) -> list[str]:
    """Load the plug-ins that are installed or that arguments name, --plugin=module; the other arguments."""
    plugins = [argument.partition("=")[2] for argument in arguments if argument.startswith("--plugin=")]
    if plugins:
        os.environ[ENVIRONMENT] = ",".join(filter(None, [os.environ.get(ENVIRONMENT), *plugins]))
    with report_input_errors():
        load_plugins()
    return [argument for argument in arguments if not argument.startswith("--plugin=")]


def _parse_options(arguments: Sequence[str]) -> Namespace:
    """Hydra's own options, and the overrides."""
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise InputError(f"{message}; --help says what can be typed")

    parser.error = refuse
    return parser.parse_intermixed_args(arguments)


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package that it would be in
        return False


def _trouble(error: Exception) -> str | None:
    """The text of an error that is neither the input's fault nor a bug: a diverged training, or a full disk."""
    if isinstance(error, FloatingPointError):
        return str(error)
    if isinstance(error, OSError) and (isinstance(error, WriteError) or error.errno in UNWRITABLE):
        return str(error.strerror if error.filename is None else f"{error.filename}: {error.strerror}")
    return None


def _print_failed(error: Exception) -> None:
    """Print which job of a sweep failed and why: invalid input in one line, a bug with its traceback."""
    overrides = " ".join(HydraConfig.get().overrides.task)
    if not isinstance(error, InputError | OmegaConfBaseException) and _trouble(error) is None:
        traceback.print_exception(error)
    print_error(f"job {HydraConfig.get().job.num} ({overrides}): {error}")


def print_error(text: str) -> None:
    """Print an error in one line on standard error."""
    print("error:", " ".join(text.split()), file=sys.stderr)


def _fail(text: str, code: int) -> NoReturn:
    print_error(text)
    sys.exit(code)
