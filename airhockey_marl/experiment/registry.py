"""Registries: what a configuration may name, and how another package adds to it.

A registry maps the names that stand in configurations, such as `trpo`, to what they mean. Ours are filled by their own
modules, others by plug-ins: modules that register something when they are imported. A plug-in is found through the
entry-point group `airhockey.plugins` of an installed package, or is named by `--plugin=module` on the command line or
in the environment variable AIRHOCKEY_PLUGINS (names separated by commas). No configuration names a module or a class,
so to read, resume or report a run folder imports nothing that the folder asks for.
"""

import dataclasses
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

T = TypeVar("T")

ENTRY_POINTS = "airhockey.plugins"
ENVIRONMENT = "AIRHOCKEY_PLUGINS"  # also how worker processes learn of `--plugin`

_registries: list["Registry"] = []
_loaded: set[str] = set()


class Registry(Mapping[str, T], Generic[T]):
    """Names and what they mean.

    Args:
        kind: what is registered, in words, for messages.
        builtin: by name the module of ours that registers it when it is imported, on first use.
        group: the configuration group whose choices are the names; a plug-in's becomes a choice of it.
        key: the key of a configuration that holds the name.
    """

    def __init__(
        self, kind: str, builtin: Mapping[str, str] | None = None, group: str | None = None, key: str = "name"
    ) -> None:
        self.kind, self.group, self.key = kind, group, key
        self._builtin = dict(builtin or {})
        self._entries: dict[str, T] = {}
        _registries.append(self)

    def register(self, name: str) -> Callable[[T], T]:
        """A decorator that registers what it decorates under `name`.

        Raises:
            ValueError: the name is taken by something else.
        """

        def add(entry: T) -> T:
            previous = self._entries.get(name, entry)
            if previous is not entry and _origin(previous) != _origin(entry):
                raise ValueError(
                    f"{self.kind} {name!r} is registered twice: by {_origin(previous)} and {_origin(entry)}"
                )
            self._entries[name] = entry
            return entry

        return add

    def __getitem__(self, name: str) -> T:
        if name not in self._entries and name in self._builtin:
            import_module(self._builtin[name])
        if name not in self._entries:
            load_plugins()
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        load_plugins()
        return iter(dict.fromkeys([*self._builtin, *self._entries]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def find(self, name: Any, place: str) -> T:
        """The entry of this name.

        Args:
            place: where the name stands, for the message.

        Raises:
            ValueError: there is none; names the place, the value and what is allowed.
        """
        if not isinstance(name, str) or name not in self:
            raise ValueError(f"{place} = {name!r} must be one of {', '.join(self)}{did_you_mean(name, self)}")
        return self[name]

    def build(self, settings: Any, place: str, *context: Any) -> Any:
        """Call the entry that `settings` name with the rest of them.

        Args:
            settings: the name alone, or a mapping with it under `self.key`; mappings within that have the key, also in
                lists, are built first.
            place: where the settings stand, for messages.
            context: arguments that come before the settings.

        Raises:
            ValueError: a name is unknown, or a setting is unknown, missing or refused by the entry; names it.
        """
        settings = as_mapping({self.key: settings} if isinstance(settings, str) else settings, place)
        entry = self.find(settings.get(self.key), f"{place}.{self.key}")
        own = {name: self._nested(value, f"{place}.{name}") for name, value in settings.items() if name != self.key}
        return construct(entry, own, place, *context)

    def _nested(self, value: Any, place: str) -> Any:
        if isinstance(value, Mapping) and self.key in value:
            return self.build(value, place)
        if isinstance(value, list | tuple):
            return [self._nested(item, f"{place}[{index}]") for index, item in enumerate(value)]
        return value


def construct(entry: Callable[..., T], settings: Any, place: str, *context: Any) -> T:
    """Call a class or function with the settings of a configuration as keyword arguments.

    Args:
        settings: a mapping, such as a node of the configuration, with plain values.
        place: where it stands, for messages.
        context: arguments that come before the settings.

    Raises:
        ValueError: a setting is unknown or missing; names it, and what is allowed.
    """
    settings = as_mapping(settings, place)
    parameters = list(inspect.signature(entry).parameters.values())[len(context) :]
    names = [parameter.name for parameter in parameters if parameter.kind != parameter.VAR_KEYWORD]
    if len(names) == len(parameters):  # else it takes any keyword
        for name in settings:
            if name not in names:
                allowed = f"must be one of {', '.join(names)}" if names else "there are none"
                raise ValueError(f"{place}.{name}: no such setting, {allowed}{did_you_mean(name, names)}")
    for parameter in parameters:
        if parameter.default is parameter.empty and parameter.name in names and parameter.name not in settings:
            raise ValueError(f"{place}.{parameter.name} is missing")
    return entry(*context, **settings)


def as_mapping(settings: Any, place: str) -> dict[str, Any]:
    """Settings as a dict of plain values, references resolved.

    Raises:
        ValueError: they are no mapping of names to values.
    """
    from omegaconf import DictConfig, OmegaConf  # not above: a registry can be filled without it

    if isinstance(settings, DictConfig):
        settings = OmegaConf.to_container(settings, resolve=True)
    if not isinstance(settings, Mapping) or not all(isinstance(name, str) for name in settings):
        raise ValueError(f"{place} = {settings!r} must be a mapping of settings to values")
    return dict(settings)


def did_you_mean(name: Any, allowed: Any) -> str:
    """A hint at the closest of the allowed names; "" if none is close."""
    close = get_close_matches(str(name), list(allowed), 1, 0.6)
    return f"; did you mean {close[0]}?" if close else ""


def load_plugins() -> None:
    """Import every plug-in that has not been imported yet, and offer what it registers as choices of Hydra's groups.

    Raises:
        ValueError: a plug-in cannot be imported; names it, and why.
    """
    names = [name.strip() for name in os.environ.get(ENVIRONMENT, "").split(",") if name.strip()]
    modules = {name: ENVIRONMENT for name in names}
    modules |= {point.module: f"entry point {point.name}" for point in entry_points(group=ENTRY_POINTS)}
    new = [name for name in modules if name not in _loaded]
    if not new:
        return
    _loaded.update(new)  # first: a plug-in may ask a registry what there is
    for name in new:
        try:
            import_module(name)
        except Exception as error:
            raise ValueError(f"plug-in {name} ({modules[name]}): {type(error).__name__}: {error}") from error
    for registry in _registries:
        if registry.group is not None:
            for name in set(registry._entries) - set(registry._builtin):
                from hydra.core.config_store import ConfigStore  # only where there are plug-ins

                node = {registry.key: name, **_defaults(registry._entries[name])}
                ConfigStore.instance().store(group=registry.group, name=name, node=node)


def _defaults(entry: Any) -> dict[str, Any]:
    """The settings of an entry with their defaults; ??? for those that must be chosen."""
    if dataclasses.is_dataclass(entry) and not isinstance(entry, type):  # an object: its fields are the settings
        return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(entry).items()}
    settings = {}
    for parameter in inspect.signature(entry).parameters.values():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            settings[parameter.name] = "???" if parameter.default is parameter.empty else parameter.default
    for field in dataclasses.fields(entry) if dataclasses.is_dataclass(entry) else ():
        if field.default_factory is not dataclasses.MISSING:
            settings[field.name] = field.default_factory()
    return settings


def _origin(entry: Any) -> str:
    owner = entry if hasattr(entry, "__qualname__") else type(entry)
    return f"{owner.__module__}.{owner.__qualname__}"
