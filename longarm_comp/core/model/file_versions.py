"""Writes a file and keeps its previous version beside it; an interruption loses neither.

If the path is a symbolic link, both are beside the file that it leads to.
"""

from __future__ import annotations

import os
from pathlib import Path

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import follow_link, write_bytes


def write_version(path: str | Path, content: bytes) -> None:
    """Write a model file's bytes atomically. An existing file becomes the previous version.

    It is first copied to a third file, so that an interruption at any point loses no version.
    """
    path = Path(path)
    settle(path)
    if os.path.isfile(path):  # False in an unreadable folder; writing then raises
        write_bytes(_beside(path, "before"), path.read_bytes())
    write_bytes(path, content)
    settle(path)


def settle(path: str | Path) -> None:
    """Finish a `write_version` that was interrupted.

    The file that it had kept becomes the previous version, or is removed if nothing was replaced.
    """
    path = Path(path)
    kept = _beside(path, "before")
    if not os.path.isfile(kept):
        return
    if os.path.isfile(path) and path.read_bytes() == kept.read_bytes():  # nothing was replaced
        kept.unlink()
    else:
        replace_file(kept, previous(path))


def previous(path: str | Path) -> Path:
    """Return the path of the previous version. Raises InputError where the path names no file."""
    return _beside(path, "previous")


def _beside(path: str | Path, what: str) -> Path:
    path = follow_link(path)
    if not path.name:
        raise InputError(str(path), "model", "a folder", "a file")
    return path.with_name(f"{path.stem}.{what}{path.suffix}")


def replace_file(path: Path, to: str | Path) -> None:
    """Move a file to the place of another. Raises InputError if it may not be replaced."""
    try:
        os.replace(path, follow_link(to))
    except OSError as error:
        raise InputError(str(to), "file", error.strerror, "a file that may be replaced") from error
