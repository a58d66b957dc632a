"""Every public function refuses what it cannot work with, argument by argument, and says which argument it was.

`tests.calls` has a sound call of each. From every call come many wrong ones, each of which differs from it in a single
argument: a tensor on another device, of another dtype or shape; a number that is none, below zero or not whole. A
public function that takes any of these and has no call, and no reason to have none, fails here.
"""

import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from enum import Enum
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import airhockey_marl
import guidance
from tests.calls import CALLED_OTHERWISE, CALLS, ELSEWHERE, LAWFUL, NO_CALL, UNKNOWABLE

NUMERIC = re.compile(r"(torch\.|numpy\.)?\b(Tensor|ndarray|int|float)\b")


def name_of(function: Callable) -> str:
    return f"{function.__module__}.{function.__qualname__}"


def modules() -> list[ModuleType]:
    """All of both packages, but for those that are exempt as a whole."""
    names = [
        found.name
        for package in (airhockey_marl, guidance)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    return [import_module(name) for name in names if not any(f"{name}.".startswith(f"{left}.") for left in ELSEWHERE)]


def public(module: ModuleType) -> Iterator[Callable]:
    """Its functions, its classes that look at what they are made of, and their methods; compiled code is none."""
    for name, thing in vars(module).items():
        if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(thing):
            yield thing
        elif inspect.isclass(thing) and not getattr(thing, "_is_protocol", False):
            own = vars(thing)
            if "__post_init__" in own or ("__init__" in own and not hasattr(thing, "__dataclass_fields__")):
                yield thing
            for method in own:
                if (method == "__call__" or not method.startswith("_")) and inspect.isroutine(getattr(thing, method)):
                    yield getattr(thing, method)


def numeric(function: Callable) -> list[str]:
    """Its parameters that are annotated as a tensor, an array or a number, perhaps or None."""
    found = []
    for name, parameter in inspect.signature(function).parameters.items():
        kind = parameter.annotation if parameter.kind != parameter.VAR_POSITIONAL else None
        text = kind.__name__ if isinstance(kind, type) else str(kind)
        if all(NUMERIC.fullmatch(part) or part == "None" for part in text.split(" | ")) and text != "None":
            found.append(name)
    return found


def wrong(value: Any) -> dict[str, Any]:
    """What is like a value, but for what the key says."""
    if isinstance(value, torch.Tensor):
        cut = value[..., :-1] if value.ndim else value[None]
        dtype = value.long() if value.is_floating_point() else value.double()
        return {"device": value.to("meta"), "dtype": dtype, "shape": cut, "type": value.tolist()}
    if isinstance(value, np.ndarray):
        return {"dtype": np.full(value.shape, "x"), "shape": value[..., :-1] if value.ndim > 1 else value[..., None]}
    if isinstance(value, bool | Enum) or value is None:
        return {}
    if isinstance(value, int | np.integer):
        return {"negative": -1, "fraction": 1.5}
    return {"nan": float("nan"), "negative": -1.0} if isinstance(value, float) else {}


def run(function: Callable, arguments: dict[str, Any]) -> Any:
    arguments = dict(arguments)
    positional = arguments.pop("*", ())
    result = function(*positional, **arguments)
    return next(result) if inspect.isgenerator(result) else result


PUBLIC = {name_of(function): function for module in modules() for function in public(module)}
MUTANTS = [
    pytest.param(function, arguments, name, value, id=f"{name_of(function)}-{name}-{kind}")
    for function, arguments in CALLS
    for name, sound in arguments.items()
    for kind, value in wrong(sound).items()
    if kind not in (*LAWFUL.get(key := f"{name_of(function)} {name}", ()), *UNKNOWABLE.get(key, ()))
]


@pytest.mark.parametrize(("function", "arguments"), CALLS, ids=[name_of(function) for function, _ in CALLS])
def test_the_calls_are_sound(function, arguments):
    run(function, arguments)


@pytest.mark.parametrize(("function", "arguments", "name", "value"), MUTANTS)
def test_a_wrong_argument_is_named(function, arguments, name, value):
    called = CALLED_OTHERWISE.get(f"{name_of(function)} {name}", name)
    with pytest.raises(ValueError, match=rf"\b({re.escape(called)}|{name})\b") as refused:
        run(function, {**arguments, name: value})
    assert "\n" not in str(refused.value)


def test_every_public_function_has_a_call_or_a_reason():
    called: dict[str, set[str]] = {}
    for function, arguments in CALLS:
        called.setdefault(name_of(function), set()).update(name for name, value in arguments.items() if wrong(value))
    wanted = {f"{name} {item}" for name, function in PUBLIC.items() for item in numeric(function)}
    have = {f"{name} {item}" for name, items in called.items() for item in items}
    reasons = {f"{name} {item}" for name in NO_CALL for item in numeric(PUBLIC[name])}
    assert sorted(wanted - have - reasons) == []
    assert sorted(have & reasons) == []  # a call is better than a reason


def test_no_exemption_is_left_over():
    """Of a function that is gone, or of a wrong argument that no call has."""
    assert set(NO_CALL) <= set(PUBLIC)
    names = {f"{name_of(function)} {name}": wrong(sound) for function, args in CALLS for name, sound in args.items()}
    assert set(CALLED_OTHERWISE) <= set(names)
    exempt = {(key, kind) for key, kinds in (*LAWFUL.items(), *UNKNOWABLE.items()) for kind in kinds}
    assert sorted(exempt - {(name, kind) for name, kinds in names.items() for kind in kinds}) == []
    assert all(find_spec(name) for name in ELSEWHERE)


@pytest.mark.parametrize("key", LAWFUL)
def test_what_is_lawful_is_taken(key):
    for function, arguments in CALLS:
        for name, sound in arguments.items():
            if f"{name_of(function)} {name}" == key:
                for kind in LAWFUL[key]:
                    run(function, {**arguments, name: wrong(sound)[kind]})
