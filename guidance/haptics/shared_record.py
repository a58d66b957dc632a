"""A record in shared memory with one writer, which readers see either whole or not at all."""

import struct
import zlib
from typing import Any


class SharedRecord:
    """A record in shared memory that one process writes and others read.

    Its checksum detects a partial write, so it needs no lock, which a process that dies could keep, and no ordering of
    writes in memory.

    Args:
        layout: of the record, as in `struct`.
        context: of `multiprocessing`.
        values: the first ones.
    """

    def __init__(self, layout: str, context: Any, *values: Any) -> None:
        self._layout, self._size = layout, struct.calcsize(layout)
        self._raw = context.RawArray("c", self._size + 4)
        self.write(*values)

    def write(self, *values: Any) -> None:
        """Replace the record."""
        body = struct.pack(self._layout, *values)
        self._raw.raw = body + zlib.crc32(body).to_bytes(4, "little")

    def read(self) -> tuple | None:
        """The record, or None while it is being written."""
        for _ in range(4):
            raw = self._raw.raw
            body = raw[: self._size]
            if zlib.crc32(body).to_bytes(4, "little") == raw[self._size :]:
                return struct.unpack(self._layout, body)
        return None
