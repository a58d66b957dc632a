"""Files that are either whole or absent, and model weights that never need a pickle."""

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
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

# why something cannot be written that is nobody's mistake in a program: no room, no right, no disk
UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}


HASH = "sha256_of_all_this"  # among a file's facts; older files have none


class WriteError(OSError):
    """Something was not written; the message names it, and says what of it is left."""


@contextmanager
def name_write_errors(path: Path | str) -> Iterator[None]:
    """For whatever writes `path`: an `OSError` in it names the file, and says that nothing else is lost."""
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
    """Yield a temporary path beside `path`; when the block ends well, it takes `path`'s place in one rename.

    A reader therefore sees the old file or the new one, never half of one. If the block raises, the
    temporary file is removed and `path` is left as it was.

    Raises:
        Unwritten: there is no room or no right to; names `path`.
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
    """Have the folder's names on the disk: without it a power cut may take a rename back."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove(path: Path) -> None:
    """Remove a file, for good; none is fine."""
    with name_write_errors(path):
        path.unlink(missing_ok=True)
        fsync_dir(path.parent)


def remove_temporary_files(folder: Path) -> None:
    """Remove the temporary files that a crash has left below a folder: what is in them never came to be."""
    for file in folder.rglob(".*"):
        if re.fullmatch(r"\..+\.[a-z0-9_]{8}(\.\w+)?", file.name) and file.is_file():
            remove(file)


def write_text(path: Path | str, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, content: Any) -> None:
    """Write `content` as indented JSON to `path`, whole or not at all."""
    write_text(path, json.dumps(content, indent=2, default=str) + "\n")


def find_files(places: Iterable[Path | str], name: str) -> list[Path]:
    """Every file of this name at or below the given files, folders or glob patterns, each once.

    Raises:
        ValueError: a place under which there is none.
    """
    found: dict[Path, Path] = {}
    for place in places:
        # a sweep's folder may have brackets or stars in its own name: what exists is taken literally
        matches = [place] if Path(place).exists() else sorted(glob.glob(str(place), recursive=True))
        files = [file for match in map(Path, matches) for file in ([match] if match.is_file() else match.rglob(name))]
        if not files:
            raise ValueError(f"runs = {place}: there is no {name} at or below it")
        found |= {file.resolve(): file for file in sorted(files)}
    return list(found.values())


def sha256(path: Path | str) -> str:
    """Hexadecimal SHA-256 of a file's content."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def save_tensors(path: Path | str, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any] | None = None) -> None:
    """Save named tensors as safetensors; `facts` (any JSON) travels in the header and says what they are.

    So does a hash of both: safetensors has no checksum, and a bit that a disk has turned would be a weight.
    """
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    said = dict(facts or {})
    said = json.dumps(said | {HASH: _digest(contiguous, said)})  # one text: of two the library's order is random
    with atomic_write(path) as temporary:
        try:
            save_file(contiguous, temporary, metadata={"facts": said})
        except SafetensorError as error:  # which an OSError is inside the library
            raise OSError(errno.EIO, str(error)) from error


def _digest(tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def load_tensors(path: Path | str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Load what `save_tensors` wrote: the named tensors and the facts.

    Raises:
        ValueError: the file is missing, truncated, damaged or not in safetensors format.
    """
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
