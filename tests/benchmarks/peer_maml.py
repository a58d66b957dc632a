"""Peer of the meta-step: the MAML class of learn2learn.

Its package does not build on Python 3.11 and later, but the class needs only three files. They are imported unchanged
from the source distribution that `make bench` downloads; without it there is no peer.
"""

import importlib
import sys
import tarfile
import tempfile
from pathlib import Path
from types import ModuleType

NEEDED = ("algorithms/maml.py", "algorithms/base_learner.py", "utils/__init__.py")


def peer_maml() -> ModuleType | None:
    """Module `algorithms.maml` of learn2learn, or None without its source distribution."""
    archives = sorted((Path(sys.prefix) / "peers").glob("learn2learn-*.tar.gz"))
    if not archives:
        return None
    folder = Path(tempfile.mkdtemp())
    root = archives[-1].name.removesuffix(".tar.gz")
    with tarfile.open(archives[-1]) as archive:
        for name in NEEDED:
            target = folder / "learn2learn" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(archive.extractfile(f"{root}/learn2learn/{name}").read())
    sys.path.insert(0, str(folder))  # its folders without an __init__.py are namespace packages
    return importlib.import_module("learn2learn.algorithms.maml")
