"""Dependencies: every distribution is pinned exactly, as it is installed, and its license is known."""

import re
from importlib.metadata import PackageNotFoundError, distribution

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests import ROOT

OURS, EXTRAS = "airhockey-haptics", ("bench", "dev", "forcedimension", "lsl")
LICENSES = ROOT / ".github" / "THIRD_PARTY.md"
# torch has a build for each kind of machine, all of one version, which pyproject.toml pins; some bring these as well
MACHINE_SPECIFIC = ("triton", "nvidia-", "cuda-")


def pins() -> dict[str, str]:
    """Version by name, as constraints.txt has them."""
    lines = [line.strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    return {
        canonicalize_name(name): version
        for name, version in (line.split("==") for line in lines if line and not line.startswith("#"))
    }


def installed() -> dict[str, str]:
    """Version by name of every installed distribution that this project requires, directly or indirectly."""
    versions: dict[str, str] = {}
    todo, seen = [(OURS, frozenset(EXTRAS))], set()
    while todo:
        name, extras = todo.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            required = distribution(name)
        except PackageNotFoundError:  # of an extra, or for another system
            continue
        if name != OURS:
            versions[name] = required.version
        for requirement in map(Requirement, required.requires or []):
            contexts = [{"extra": extra} for extra in ("", *extras)]
            if requirement.marker is None or any(map(requirement.marker.evaluate, contexts)):
                todo.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    return versions


def licensed() -> dict[str, str]:
    """License by name, as THIRD_PARTY.md has them."""
    rows = re.findall(r"^\| ([a-z0-9-]+) \| ([^|]+) \|$", LICENSES.read_text(), re.M)
    return dict(rows[1:])  # after the heads of the columns


@pytest.mark.skipif(not installed(), reason="not installed with pip")
def test_everything_installed_is_pinned_exactly_at_its_version():
    versions, pinned = installed(), pins()
    assert len(versions) > 60 and {"torch", "numpy", "hydra-core", "omegaconf", "llvmlite"} <= versions.keys()
    unpinned = {name for name in versions.keys() - pinned.keys() - {"torch"} if not name.startswith(MACHINE_SPECIFIC)}
    assert not unpinned
    wrong = {
        name: f"{version}, pinned {pinned[name]}"
        for name, version in versions.items()
        if name in pinned and Version(version).public != pinned[name]  # a build of torch is torch
    }
    assert not wrong


def test_torch_is_pinned_by_the_project_itself():
    dependencies = (ROOT / "pyproject.toml").read_text()
    assert re.search(r'"torch==\d+\.\d+\.\d+"', dependencies)


def test_every_pin_is_one_exact_version():
    for name, version in pins().items():
        assert re.fullmatch(r"\d+(\.\d+)*(\.?(post|rc|a|b)\d+)?", version), f"{name}=={version}"


def test_every_pinned_distribution_has_a_license_on_the_list():
    assert licensed().keys() == pins().keys() | {"torch"}
