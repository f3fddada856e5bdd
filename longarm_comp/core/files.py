"""Files written whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from longarm_comp.core.errors import InputError, JobError

_STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse what is neither a file nor a folder: a pipe or a device has no end to read up to."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # missing or unreadable: who opens it says so
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(path, "file", "a pipe, a socket or a device", "a regular file")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on a clean exit it replaces ``path`` in one step.

    The temporary file keeps the suffix of ``path``, for writers that go by it, and is synced
    first. When the block raises, ``path`` is left as it was. Missing parent folders are made.
    """
    target = Path(path)
    try:
        folder = target.is_dir()
    except OSError as error:  # not even its folder can be looked into
        raise _not_writable(target, error) from error
    if folder:
        raise InputError(target, "output file", "a folder", "a file name")
    partial = _partial_beside(target)
    try:
        yield partial
        _sync(partial)
        _publish(partial, target)
    except OSError as error:
        if error.errno not in _STORAGE:
            raise
        raise JobError(f"{target} was not written: {error.strerror}") from error
    finally:
        with suppress(FileNotFoundError):
            partial.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8 to ``path``, whole or not at all."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def _partial_beside(target: Path) -> Path:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.stem}.", suffix=target.suffix
        )
    except OSError as error:
        raise _not_writable(target, error) from error
    os.close(handle)
    return Path(name)


def _sync(partial: Path) -> None:
    with partial.open("rb+") as file:
        os.fsync(file.fileno())


def _publish(partial: Path, target: Path) -> None:
    """Give the file the permissions that an ordinary new file would have, then move it in place."""
    try:
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
        partial.chmod(mode)
        os.replace(partial, target)
    except OSError as error:
        raise _not_writable(target, error) from error


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def _not_writable(target: Path, error: OSError) -> InputError:
    return InputError(target, "output folder", error.strerror or str(error), "a folder to write in")
