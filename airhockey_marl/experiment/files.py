"""Atomic writes of files, and tensors in safetensors files with metadata and a content hash.

torch and safetensors are imported by the functions that need them, so that commands which only write text start fast.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

# errors of the disk, not of the program: it is full, read-only, forbidden or broken
UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}
HASH = "sha256_of_all_this"  # key of the content hash in a file's metadata; files of early versions have none


class WriteError(OSError):
    """A file could not be written; the message names it."""


@contextmanager
def name_write_errors(path: Path | str) -> Iterator[None]:
    """Turn an `OSError` of the block, which writes `path`, into a `WriteError` that names the path."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise WriteError(
            error.errno, f"{path} cannot be written: {reason}. What was saved before is as it was"
        ) from error


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` when the block ends.

    A reader sees the old file or the new one, never half of one. If the block raises, the temporary file is removed and
    `path` keeps its content. A `WriteError` names `path` if the disk is full or read-only.
    """
    path = Path(path)
    with name_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix, delete=False) as handle:
            temporary = Path(handle.name)
        try:
            yield temporary
            with temporary.open("rb") as written:
                os.fsync(written.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def fsync_dir(folder: Path) -> None:
    """fsync a directory so that a rename or removal in it survives a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove(path: Path) -> None:
    """Remove a file durably, if it exists."""
    with name_write_errors(path):
        path.unlink(missing_ok=True)
        fsync_dir(path.parent)


def remove_temporary_files(folder: Path) -> None:
    """Remove the temporary files that a crash during `atomic_write` left below a folder."""
    for file in folder.rglob(".*"):
        if re.fullmatch(r"\..+\.[a-z0-9_]{8}(\.\w+)?", file.name) and file.is_file():
            remove(file)


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path | str, text: str) -> None:
    """Write `text` to `path` atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path | str, content: Any) -> None:
    """Write `content` as indented JSON to `path` atomically."""
    write_text(path, json.dumps(content, indent=2, default=str) + "\n")


def load_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file; a ValueError names the file if it holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # including UnicodeDecodeError
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}, must be a JSON object")
    return content


def find_files(places: Path | str | Iterable[Path | str], name: str) -> list[Path]:
    """Files of this name at or below one or several files, folders or glob patterns, each once.

    A ValueError names a place at or below which there is none.
    """
    paths: dict[Path, Path] = {}
    for place in [places] if isinstance(places, str | Path) else places:
        # an existing path is taken literally: a sweep's folder may have brackets or stars in its name
        matches = [place] if Path(place).exists() else sorted(glob.glob(str(place), recursive=True))
        files = [file for match in map(Path, matches) for file in ([match] if match.is_file() else match.rglob(name))]
        if not files:
            raise ValueError(f"runs = {place}: there is no {name} at or below it")
        paths |= {file.resolve(): file for file in sorted(files)}
    return list(paths.values())


def sha256(path: Path | str) -> str:
    """Hexadecimal SHA-256 of a file's content."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def save_tensors(path: Path | str, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any] | None = None) -> None:
    """Write named tensors to a safetensors file.

    The header holds `facts` (any JSON) and a SHA-256 of tensors and facts: the format itself has no checksum, and a
    flipped bit would go unnoticed.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = dict(facts or {})
    header = json.dumps(content | {HASH: _digest(contiguous, content)})  # a single entry: several have no fixed order
    with atomic_write(path) as temporary:
        try:
            save_file(contiguous, temporary, metadata={"facts": header})
        except SafetensorError as error:  # how the library reports an OSError
            raise OSError(errno.EIO, str(error)) from error


def _digest(tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> str:
    import torch

    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def load_tensors(path: Path | str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read the tensors and facts of `save_tensors`; a ValueError names a file that is missing or damaged."""
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    try:
        with safe_open(path, framework="pt") as handle:
            facts = json.loads((handle.metadata() or {}).get("facts", "{}"))
            if not isinstance(facts, dict):
                raise ValueError(f"{path}: its facts are a {type(facts).__name__}, must be a JSON object")
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118 (no dict)
    except (SafetensorError, json.JSONDecodeError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path} is not a safetensors file: {error}") from error
    if HASH in facts and facts.pop(HASH) != _digest(tensors, facts):
        raise ValueError(f"{path} is damaged: its content is not what its own hash says")
    return tensors, facts
