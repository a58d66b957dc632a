"""Environment of all tests: no window on the screen, one thread per process as tests run on all cores, no deadlines."""

import os

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# fixtures that take seconds: tests which use the same one run in one process, so that it is made once
SHARED = ("runs", "two", "trained", "outcomes", "written", "reported", "groups", "few", "anchored", "single")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for name in SHARED:
            if name in getattr(item, "fixturenames", ()):
                group = name if name == "runs" else f"{item.path.stem}-{name}"
                item.add_marker(pytest.mark.xdist_group(group))
                break
