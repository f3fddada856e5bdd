"""Detects new versions of the files that a node has loaded."""

from __future__ import annotations

import os
from collections.abc import Sequence

_Signature = tuple[tuple[int, int, int] | None, ...]


class FileWatch:
    """Detects when one of several files is created, changed, replaced or removed."""

    def __init__(self, paths: Sequence[str]) -> None:
        self._paths = tuple(paths)
        self._seen = self._look()

    def changed(self) -> bool:
        """Whether a file changed since the last call, or since the start."""
        now = self._look()
        changed = now != self._seen
        self._seen = now
        return changed

    def _look(self) -> _Signature:
        return tuple(_signature(path) for path in self._paths)


def _signature(path: str) -> tuple[int, int, int] | None:
    try:
        stat = os.stat(path)
    except OSError:
        return None
    return stat.st_ino, stat.st_size, stat.st_mtime_ns
