"""How every command of this project starts: Hydra underneath, a manual for `--help`, one clear line for an error."""

import functools
import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from airhockey_marl.experiment.config import read_config
from airhockey_marl.experiment.files import UNWRITABLE, WriteError

ROOT = Path(__file__).resolve().parents[2]
LAUNCHERS = Path(__file__).parent / "launchers"
CONF = ROOT / "conf"  # absolute: a relative path means something else under a console script
# What a choice of Hydra's own groups needs, and the extra that brings it.
JOBLIB = ("hydra_plugins.hydra_joblib_launcher", "joblib")
SUBMITIT = ("hydra_plugins.hydra_submitit_launcher", "submitit")
OPTUNA = ("hydra_plugins.hydra_optuna_sweeper", "optuna")
RAY = "hydra/launcher=ray"
PLUGINS = {
    "hydra/launcher=cores": JOBLIB,
    "hydra/launcher=slurm": SUBMITIT,
    "hydra/launcher=slurm_here": SUBMITIT,
    RAY: ("ray", "ray"),
    "sweep=maml": OPTUNA,
    "sweep=trpo": OPTUNA,
    "hydra/sweeper=optuna": OPTUNA,
}

# ${project:path} in a yaml is a path in the project, from whatever folder a command is started.
OmegaConf.register_new_resolver("project", lambda path: str(ROOT / path), replace=True)


class InputError(ValueError):
    """Something the person at the keyboard can mend: named in one line, exit code 2, no traceback."""


def choices(name: str) -> dict[str, list[str]]:
    """The configuration's groups and what each can be: the folders of `conf/` and the files in them."""
    folders = sorted(path for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
    return {folder.name: sorted(path.stem for path in folder.glob("*.yaml")) for folder in folders}


def wrong_choice(name: str, arguments: Sequence[str]) -> str | None:
    """What is wrong with the first argument that asks for something its group does not have; None if none does."""
    options_of = choices(name)
    for argument in arguments:
        group, _, wanted = argument.lstrip("+").partition("=")
        options = options_of.get(group, [])
        for choice in wanted.split(",") if options else []:
            if choice not in (*options, "null") and "(" not in wanted:  # Hydra sees to glob(*) and its kin
                return f"{group} = {choice} must be one of {', '.join(options)}"
    return None


@contextmanager
def report_input_errors() -> Iterator[None]:
    """For the part of a command that checks its input: a `ValueError` in it is the input's fault."""
    try:
        yield
    except InstantiationException as error:  # Hydra's wrapping of what a constructor raised
        raise InputError(str(error.__cause__ or error)) from error
    except ValueError as error:
        raise InputError(str(error)) from error


def manual(name: str, doc: str) -> str:
    """The text of `--help`: the command's docstring, the choices of each group, and its primary yaml as commented."""
    launchers = sorted(path.stem for path in (CONF / "hydra" / "launcher").glob("*.yaml"))
    options_of = choices(name) | {"hydra/launcher": ["basic", *launchers]}
    groups = [f"  {group} = {' | '.join(options)}" for group, options in options_of.items()]
    return "\n".join(
        [
            doc.strip(),
            "",
            "Every key below can be set on the command line: key=value, group=choice, +preset=smoke;",
            "-m sweeps: key=1,2,3 or 'condition=glob(*)'. --cfg job prints the resolved configuration.",
            "",
            "Groups",
            *groups,
            "",
            f"Keys (conf/{name}.yaml)",
            (CONF / f"{name}.yaml").read_text(encoding="utf-8").rstrip(),
            "",
        ]
    )


def missing_extra(arguments: Sequence[str]) -> str | None:
    """What to install for the launcher or sweeper that the arguments ask for; None if it is there."""
    for argument in arguments:
        module, extra = PLUGINS.get(argument.lstrip("+"), (None, ""))
        if module is not None and not _is_there(module):
            return f"{argument} needs what `pip install 'airhockey-haptics[{extra}]'` brings: there is no {module}"
    return None


class HeldBack:
    """Standard error between a command's start and its task's: Hydra reports a wrong override over many lines.

    A launcher sends a job to another process together with all that it refers to. There, nothing is held back.

    Attributes:
        held: what was written meanwhile.
    """

    def __init__(self) -> None:
        self.held, self._terminal = io.StringIO(), None

    def __reduce__(self) -> tuple[type, tuple]:
        return type(self), ()

    @contextmanager
    def holding(self) -> Iterator[None]:
        """Hold back what the block writes, but for what is `let_through`."""
        self._terminal = sys.stderr
        with redirect_stderr(self.held):
            yield

    @contextmanager
    def let_through(self) -> Iterator[None]:
        """Show what the block writes."""
        with redirect_stderr(self._terminal or sys.stderr):
            yield


def command(name: str) -> Callable[[Callable[[DictConfig], float | None]], Callable[[], None]]:
    """Turn a function of a configuration into a command configured by `conf/<name>.yaml`.

    Wrong values, whether Hydra finds them or the function does (`InputError`), end in one line on standard error
    and exit code 2. So do, with exit code 1, a disk that is full or may not be written to, and a training whose numbers
    are none any more. Anything else is a bug and keeps its traceback.
    """

    def decorate(task: Callable[[DictConfig], float | None]) -> Callable[[], None]:
        @functools.wraps(task)
        def main() -> None:
            if {"--help", "-h"} & set(sys.argv[1:]):
                print(manual(name, sys.modules[task.__module__].__doc__ or ""))
                return
            if complaint := wrong_choice(name, sys.argv[1:]) or missing_extra(sys.argv[1:]):
                _say_error(complaint)
                sys.exit(2)
            _register_plugins(sys.argv[1:])
            errors = HeldBack()

            def run(cfg: DictConfig) -> float | None:
                with errors.let_through():
                    try:
                        _keep_own_keys(cfg, name)
                        OmegaConf.to_container(cfg, resolve=True)  # finds a broken reference now
                        missing = sorted(OmegaConf.missing_keys(cfg))
                        if missing:
                            raise InputError(f"{missing[0]} must be chosen: {missing[0]}=...")
                        return task(cfg)
                    except Exception as error:
                        if HydraConfig.get().mode == RunMode.MULTIRUN:  # the other jobs go on: it is said here and now
                            _say_failed(error)
                        raise

            wants_trace = os.environ.get("HYDRA_FULL_ERROR") == "1"
            try:
                # Hydra then raises what it would print over many lines
                with errors.holding(), env_override({"HYDRA_FULL_ERROR": "1"}):
                    hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)(run)()
            except Exception as error:
                trouble = _trouble(error)
                of_input = isinstance(error, InputError | HydraException | OmegaConfBaseException)
                if {"-m", "--multirun"} & set(sys.argv) and not isinstance(error, HydraException) and not wants_trace:
                    _say_error(f"a job failed: {error}; `airhockey runs` says what became of each")
                    sys.exit(2 if of_input else 1)
                if trouble is not None:
                    _say_error(trouble)
                    sys.exit(1)
                if wants_trace or not of_input:
                    raise
                _say_error(f"{error} {error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else ''}")
                sys.exit(2)
            except SystemExit as stop:
                if not stop.code:
                    raise
                _say_error(errors.held.getvalue())
                sys.exit(2)
            sys.stderr.write(errors.held.getvalue())

        return main

    return decorate


def require_counts(cfg: DictConfig, *keys: str, least: int = 1) -> None:
    """Refuse keys, dots for nesting, that are not whole numbers of at least `least`.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    for key in keys:
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise InputError(f"{key} = {value} must be a whole number of at least {least}")


def require_numbers(
    cfg: DictConfig, *keys: str, above: float = 0.0, least: float | None = None, at_most: float = float("inf")
) -> None:
    """Refuse keys, dots for nesting, that are not numbers above `above`, or from `least` on, and at most `at_most`.

    Raises:
        InputError: names the key, its value and what is allowed.
    """
    for key in keys:
        value = OmegaConf.select(cfg, key)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or value > at_most or not (value > above if least is None else value >= least):
            lowest = f"above {above}" if least is None else f"of at least {least}"
            highest = "" if at_most == float("inf") else f" and at most {at_most}"
            raise InputError(f"{key} = {value} must be a number {lowest}{highest}")


def resumed_config(run: Path, state: str, now: Mapping[str, Any] = MappingProxyType({})) -> DictConfig:
    """The configuration of an earlier run, to go on with it.

    Args:
        state: the name of the file that it goes on from.
        now: the command's own configuration, whose keys stand for those that the earlier run did not know yet.

    Raises:
        ValueError: it is not a run of this command that has come so far.
    """
    if not (run / state).is_file() or not (run / ".hydra" / "config.yaml").is_file():
        raise ValueError(f"resume = {run} is not the folder of a run that can go on: it has no {state}")
    file = run / ".hydra" / "config.yaml"
    cfg = read_config(file)
    if "resume" not in cfg:
        raise ValueError(f"{file} is not the configuration of a run that can go on")
    if HydraConfig.initialized():  # a preset's keys for other commands are in the file, too
        own = _own_keys(HydraConfig.get().job.config_name)
        for key in set(cfg) - own:
            del cfg[key]
    for key in set(now) - set(cfg):
        cfg[key] = now[key]
    cfg.resume = str(run)
    return cfg


def require_device(cfg: DictConfig) -> None:
    """Refuse a value of `compute` for which torch finds no device here.

    Raises:
        InputError: names it, and what there is.
    """
    import torch  # not above: the commands that only read start without it

    there = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if cfg.compute not in there:
        raise InputError(f"compute = {cfg.compute} must be one of {', '.join(there)}, which are what there is here")


class ProgressBar:
    """A progress bar on standard error for work that comes in phases; silent where there is no terminal."""

    def __init__(self) -> None:
        self._bar, self._phase = None, ""

    def __call__(self, phase: str, share: float) -> None:
        """Show that the share (0 to 1) of this phase is done."""
        if phase != self._phase:
            self.close()
            self._phase, self._bar = phase, tqdm(total=100, desc=phase, unit="%", file=sys.stderr, disable=None)
        self._bar.update(round(100 * share) - self._bar.n)

    def close(self) -> None:
        """Leave the last bar as it is."""
        if self._bar is not None:
            self._bar.close()


def _keep_own_keys(cfg: DictConfig, name: str) -> None:
    """Drop what a preset brings for other commands; refuse what was typed for this one and does not exist."""
    own = _own_keys(name)
    for override in HydraConfig.get().overrides.task:
        key = override.lstrip("+~").split("=")[0].split(".")[0].split("@")[0]
        if key not in own | {"preset", "sweep"}:
            raise InputError(f"{override}: {key} is not a key of conf/{name}.yaml")
    with open_dict(cfg):
        for key in set(cfg) - own:
            del cfg[key]


def _own_keys(name: str) -> set[str]:
    """The keys at the top of a command's configuration: its groups, and those of its yaml."""
    return set(_defaults(name)) | set(OmegaConf.load(CONF / f"{name}.yaml"))


def _defaults(name: str) -> dict[str, str]:
    """The groups of a command's configuration, and what each is if nothing else is asked for."""
    entries = OmegaConf.load(CONF / f"{name}.yaml").get("defaults", [])
    return {key: choice for entry in entries if isinstance(entry, DictConfig) for key, choice in entry.items()}


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package that it would be in
        return False


def _register_plugins(arguments: Sequence[str]) -> None:
    """Have Hydra find our own launcher: it looks below folders `hydra_plugins` of the search path, nowhere else."""
    if RAY in {argument.lstrip("+") for argument in arguments} and str(LAUNCHERS) not in sys.path:
        sys.path.append(str(LAUNCHERS))


def _trouble(error: Exception) -> str | None:
    """What to say of an error that is neither the input's fault nor a bug: no numbers any more, or a full disk."""
    if isinstance(error, FloatingPointError):
        return str(error)
    if isinstance(error, OSError) and (isinstance(error, WriteError) or error.errno in UNWRITABLE):
        return str(error.strerror if error.filename is None else f"{error.filename}: {error.strerror}")
    return None


def _say_failed(error: Exception) -> None:
    """Say which job of a sweep failed and why: wrong input in one line, a bug with its traceback."""
    overrides = " ".join(HydraConfig.get().overrides.task)
    if not isinstance(error, InputError | OmegaConfBaseException) and _trouble(error) is None:
        traceback.print_exception(error)
    _say_error(f"job {HydraConfig.get().job.num} ({overrides}): {error}")


def _say_error(text: str) -> None:
    print("error:", " ".join(text.split()), file=sys.stderr)
