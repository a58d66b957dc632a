"""Configurations: where they lie, what may be typed for them, and how those that lie in run folders are read.

A run folder may be anybody's, and a few lines of yaml can mean a billion: aliases of lists of aliases, or
`${references}` to texts of references. What Hydra writes has no aliases and a handful of references.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, IntervalSweep, Override, Quote, QuotedString, RangeSweep
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigSource
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import AliasEvent, CollectionEndEvent, CollectionStartEvent, Event, YAMLError

STATE_FILE = "state.safetensors"  # from which a run resumes
MAX_BYTES = 30_000  # of a kept configuration; the largest that a command of ours writes has 7,000
MAX_REFERENCES = 16  # in it; ours have 6. Each three of them can make it three times as much at most
MAX_DEPTH = 64  # of lists and tables in each other; ours have 6. The time to parse them grows with its square

ROOT = Path(__file__).resolve().parents[2]
_INSTALLED = Path(__file__).resolve().parents[1] / "conf"  # in a source tree a link to ROOT / "conf"
CONF = _INSTALLED.resolve() if _INSTALLED.is_dir() else ROOT / "conf"
ELEMENT = r"""(?:(?<=[\[,])|^)[^\[\],{}'"\\$]+(?=[\],]|$)"""  # of a list or a sweep, unless it is quoted
CHANGEABLE = ("compute", "threads", "collector", "pictures_every", "ray")  # when a run is resumed
COMMAND_GROUPS = ("preset", "sweep")  # with a folder for each command, conf/preset/<command>/
# keys of names and paths for which the yaml has no text: nothing, or an empty list
TEXT_KEYS = {
    *("participant", "resume", "run", "runs", "game", "beside", "out", "by", "command", "status", "address"),
    *("metrics", "scripted_players", "partition", "account", "data"),
}
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}  # of simple values

# ${project:path} in a yaml is a path beside the packages, in a source tree as where they are installed
OmegaConf.register_new_resolver("project", lambda path: str(ROOT / path), replace=True)


class InputError(ValueError):
    """Something that the user can correct: reported in one line, exit code 2, no traceback."""


def default_choices(conf: Path, name: str) -> dict[str, str | None]:
    """The groups in the defaults list of conf/<name>.yaml, and the choice of each."""
    entries = OmegaConf.load(conf / f"{name}.yaml").get("defaults", [])
    choices = {key: choice for entry in entries if isinstance(entry, DictConfig) for key, choice in entry.items()}
    return {group: choice for group, choice in choices.items() if not group.startswith(("hydra", "override "))}


def group_options(conf: Path, name: str) -> dict[str, list[str]]:
    """The groups of a command, `COMMAND_GROUPS` and the launchers included, and the options of each."""
    defaults, loader = default_choices(conf, name), GlobalHydra.instance().config_loader()
    folders = {group: group for group in (*defaults, "hydra/launcher")}
    folders |= {group: f"{group}/{name}" for group in COMMAND_GROUPS}
    options = {
        group: sorted({*loader.get_group_options(folder), *_choices_below(CONF / folder)})
        for group, folder in folders.items()
    }
    return {group: names for group, names in options.items() if names}


def _choices_below(folder: Path) -> list[str]:
    """The choices in a folder and its subfolders, those that others refer to left out."""
    files = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return [file.as_posix() for file in files if file.parts[0] != "shared"]


def also_search(conf: Path) -> list[str]:
    """The override by which a command of another package finds this project's groups beside its own."""
    return [] if conf == CONF else [f"hydra.searchpath=['{CONF}']"]


def check_overrides(conf: Path, name: str, arguments: Sequence[str], sweeps: bool = False) -> list[str]:
    """Compare what is typed for conf/<name>.yaml with what it has: groups, their options, keys and types of values.

    Args:
        sweeps: whether a comma separates the values of a sweep; in a text it is a comma otherwise.

    Returns:
        The arguments, with texts quoted where Hydra would read something else: `participant=1_01` is not 101.
    """
    overrides = [_parse(argument) for argument in arguments]
    with initialize_config_dir(str(conf), version_base="1.3"):
        loader, own = GlobalHydra.instance().config_loader(), group_options(conf, name)
        chosen, keys = [], []
        for override in overrides:
            group = _short(override.key_or_group, name)
            options = loader.get_group_options(group) if group.startswith("hydra/") else own.get(group)
            if not options:
                keys.append(override)
                continue
            choices = _choices(override, group, options)
            if choices:
                choice = _quoted(choices[0]) if _is_file(choices[0]) else choices[0]
                chosen.append(f"{override.input_line.partition('=')[0]}={choice}")
        try:
            cfg = compose(name, overrides=[*chosen, *also_search(conf)], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as error:
            raise InputError(describe(error)) from error
    tree = OmegaConf.to_container(cfg)
    typed = {override.input_line: _quote_text(override, cfg, sweeps) for override in keys}
    for override in typed.values():
        _check_key(override, tree, [*own])
    set_keys = {override.key_or_group for override in keys}
    for key, value in flatten_settings({key: value for key, value in tree.items() if key != "hydra"}).items():
        if value == "???" and not any(key == one or key.startswith(f"{one}.") for one in set_keys):
            raise InputError(f"{key} must be chosen: {key}=...")
    return [typed.get(override.input_line, override).input_line for override in overrides]


def _parse(argument: str) -> Override:
    """Parse an override; a value that Hydra cannot read is the text that it is, unless a bracket or quote is open."""
    parser = OverridesParser.create()
    try:
        try:
            override = parser.parse_override(argument)
        except HydraException:
            override = parser.parse_override(_as_text(argument))
    except HydraException as error:
        form = "key=value, with its brackets closed and special characters quoted: 'key=\"a b\"'"
        raise InputError(f"{argument} must be {form}") from error
    if not override.key_or_group:
        raise InputError(f"{argument} must be key=value")
    return override


def _quoted(text: str) -> str:
    return QuotedString(text, Quote.single).with_quotes()


def _as_text(argument: str) -> str:
    """An argument with its value quoted, or the elements of its list."""
    start, _, value = argument.partition("=")
    value = value.strip()
    if value.startswith("["):
        return f"{start}={re.sub(ELEMENT, lambda match: _quoted(match[0].strip()), value)}"
    is_open = value[:1] in ("'", '"') and value.count(value[0]) % 2
    return argument if is_open or not value else f"{start}={_quoted(value)}"


def _quote_text(override: Override, cfg: DictConfig, sweeps: bool) -> Override:
    """The override with the elements of its value quoted that Hydra takes for something else than the text they are."""
    start, equals, value = override.input_line.partition("=")
    if not equals or not _holds_text(override.key_or_group, cfg):
        return override
    if not sweeps and isinstance(override.value(), ChoiceSweep) and override.value().simple_form:
        return _parse(_as_text(override.input_line))
    if "(" in value:
        return override
    may_be_null = not OmegaConf.is_missing(cfg, override.key_or_group)

    def quote(match: re.Match[str]) -> str:
        text = match[0].strip()
        read = _parse(f"x={text}").value() if text else ""
        return _quoted(text) if isinstance(read, int | float) or (read is None and not may_be_null) else match[0]

    return _parse(f"{start}={re.sub(ELEMENT, quote, value)}")


def _holds_text(key: str, cfg: DictConfig) -> bool:
    """Whether the value of a key is a name, a path or another text, or a list of these."""
    try:
        default = OmegaConf.select(cfg, key)
    except OmegaConfBaseException:  # a reference to what only a running job knows: a path
        return True
    if isinstance(default, ListConfig) and default:
        return all(isinstance(element, str) for element in default)
    return isinstance(default, str) or (default in (None, []) and key.rpartition(".")[2] in TEXT_KEYS)


def _short(group: str, name: str) -> str:
    """`preset` for `preset/<name>`, into which a command's own groups are expanded before Hydra sees them."""
    head, _, tail = group.partition("/")
    return head if head in COMMAND_GROUPS and tail in ("", name) else group


def _elements(override: Override) -> list[Any]:
    """The values that an override gives a key, one for each job of a sweep; only the ends of a range."""
    value = override.value()
    if isinstance(value, ChoiceSweep):
        values = value.list
    elif isinstance(value, RangeSweep):
        values = [value.start]
    else:
        values = [] if isinstance(value, Glob | IntervalSweep) else [value]
    return [element.text if isinstance(element, QuotedString) else element for element in values]


def _choices(override: Override, group: str, options: list[str]) -> list[str]:
    """The options that an override asks a group for; none for glob(*), to which Hydra sees."""
    allowed = f"must be one of {', '.join(options)}"
    if override.is_delete():
        raise InputError(f"{override.input_line}: {group} cannot be left out, {allowed}")
    choices = _elements(override)
    for choice in choices:
        if _is_file(choice):
            _offer_file(group, Path(choice))
        elif choice not in options:
            raise InputError(f"{group} = {_shown(choice)} {allowed}")
    return choices


def _is_file(choice: Any) -> bool:
    """Whether a choice of a group is a file of the user's, by its name."""
    return isinstance(choice, str) and choice.endswith(".yaml")


def _offer_file(group: str, file: Path) -> None:
    """Make a yaml file a choice of a group, by its path as it was typed."""
    if not file.is_file():
        raise InputError(f"{group} = {file}: there is no such file")
    try:
        content = read_config(file)
    except ValueError as error:
        raise InputError(f"{group} = {error}") from error
    package = ConfigSource._get_header_dict(file.read_text(encoding="utf-8-sig")).get("package", group)
    place = "/".join((group, *(part for part in file.parts[:-1] if part != file.anchor)))
    ConfigStore.instance().store(file.name, content, group=place, package=package)


def _shown(value: Any) -> str:
    """A value as it is typed."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _check_key(override: Override, tree: Mapping[str, Any], groups: Sequence[str]) -> None:
    """Raise unless the key is in the tree of the command's configuration, and its value of the kind that is there."""
    key, node, path = override.key_or_group, tree, []
    parts = key.replace("[", ".").replace("]", "").split(".")
    for depth, part in enumerate(parts):
        siblings = node if isinstance(node, dict) else dict(enumerate(node)) if isinstance(node, list) else {}
        part = int(part) if isinstance(node, list) and part.isdecimal() else part
        if part not in siblings:
            if depth and depth == len(parts) - 1 and override.is_add() and isinstance(node, dict):
                return  # a new entry of a table
            near = get_close_matches(str(part), [*map(str, siblings), *([] if path else groups)], 1)
            same_name = [name for name in flatten_settings(tree) if name.split(".")[-1] == parts[-1]]
            near = [".".join([*path, *near])] if near else same_name
            hint = f"; did you mean {near[0]}?" if near else "; --help lists those there are"
            raise InputError(f"{override.input_line.lstrip('+~').replace('=', ' = ', 1)}: no such key{hint}")
        node = siblings[part]
        path.append(str(part))
    if override.is_delete():
        if len(parts) == 1:
            raise InputError(f"{override.input_line}: {key} cannot be left out")
        return
    if parts[0] == "hydra" or node is None or (isinstance(node, str) and ("${" in node or node == "???")):
        return
    for value in _elements(override):
        if not _fits(value, node):
            kind = KINDS.get(type(node)) or f"set by its keys: {', '.join(f'{key}.{name}' for name in node)}"
            raise InputError(f"{key} = {_shown(value)} must be {kind}")


def _fits(value: Any, default: Any) -> bool:
    """Whether a value is of the kind of a default, which anything is where that is a list."""
    if isinstance(value, str) and "${" in value:  # a reference
        return True
    if isinstance(default, dict):  # a text may name an entry of a registry
        return isinstance(value, dict | str)
    if isinstance(default, str):
        return value is None or isinstance(value, str)
    if isinstance(default, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is type(default) or type(default) not in KINDS


def flatten_settings(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of settings as dotted names; lists as they are written on the command line."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten_settings(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = json.dumps(value).replace(" ", "") if isinstance(value, list) else value
    return leaves


def describe(error: Exception) -> str:
    """In one line what Hydra or OmegaConf refuse, without their advice for programmers."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else None
    inner = cause or error
    key = getattr(inner, "full_key", None)
    reason = (getattr(inner, "msg", None) or str(inner)).strip().splitlines()[0]
    return f"{key}: {reason}" if key else reason


def resumed_config(
    run: Path, state: str, now: Mapping[str, Any] = MappingProxyType({}), arguments: Sequence[str] = ()
) -> DictConfig:
    """The configuration of an earlier run, to resume it.

    Args:
        state: the name of the file that it resumes from.
        now: the command's own configuration: keys that it does not have are dropped, those that the earlier run did
            not have yet are taken from it.
        arguments: the overrides that are typed now. Those of `CHANGEABLE` keys hold from now on, and `generations` if
            there are more of them.

    Raises:
        ValueError: the folder has no such run, or an argument sets another value for a key that must stay; names it.
    """
    file = run / ".hydra" / "config.yaml"
    if not (run / state).is_file() or not file.is_file():
        raise ValueError(f"resume = {run} is not the folder of a run that can go on: it has no {state}")
    cfg = read_config(file)
    if "resume" not in cfg:
        raise ValueError(f"{file} is not the configuration of a run that can go on")
    for key in set(cfg) - set(now) if now else ():
        del cfg[key]
    for key in set(now) - set(cfg):
        cfg[key] = now[key]
    for key in _typed_keys(arguments, now):
        value, kept = OmegaConf.select(now, key), OmegaConf.select(cfg, key)
        if key.partition(".")[0] in CHANGEABLE or (key == "generations" and value > kept):
            OmegaConf.update(cfg, key, value, force_add=True)
        elif key != "resume" and value != kept:
            raise ValueError(f"{key} = {_shown(value)} must be {_shown(kept)}, as in the run that is resumed")
    cfg.resume = str(run)
    return cfg


def _typed_keys(arguments: Sequence[str], cfg: DictConfig) -> list[str]:
    """The keys of a configuration, dots for nesting, that arguments set, by themselves or by the choice of a group."""
    keys: dict[str, None] = {}
    for override in map(_parse, arguments):
        key, value = override.key_or_group.replace("/", "."), override.value()
        file = CONF / override.key_or_group / f"{value}.yaml"
        node = OmegaConf.select(cfg, key)
        if node is None and file.is_file():  # of a choice for the whole configuration
            content = {name: part for name, part in OmegaConf.load(file).items() if name not in ("defaults", "hydra")}
            keys |= dict.fromkeys(flatten_settings(content))
        elif isinstance(node, DictConfig):
            keys |= dict.fromkeys(flatten_settings(node, f"{key}."))
        elif not key.startswith("hydra."):
            keys[key] = None
    return list(keys)


def _events(text: str) -> Iterator[Event]:
    """The parts of a yaml; a ValueError at the first that lies too deep, before the rest takes minutes to parse."""
    depth = 0
    for event in yaml.parse(text):
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise ValueError(f"it is nested more than {MAX_DEPTH} deep")
        yield event


def read_config(file: Path) -> DictConfig:
    """Read a configuration; a ValueError names the file if it is no yaml, no table, or more than it seems."""
    with file.open("rb") as handle:
        content = handle.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"{file} is of more than {MAX_BYTES} bytes, must be a configuration that a run has kept")
    try:
        text = content.decode("utf-8")
        if text.count("${") > MAX_REFERENCES or any(isinstance(event, AliasEvent) for event in _events(text)):
            raise ValueError(f"it has aliases, or more than {MAX_REFERENCES} references")
        config = OmegaConf.create(text)
    except (YAMLError, ValueError, RecursionError, OmegaConfBaseException) as error:  # no UTF-8 is a ValueError, too
        raise ValueError(f"{file} is no yaml of ours: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(config, DictConfig):
        raise ValueError(f"{file} is no yaml of ours: it must be a table of keys and values")
    return config
