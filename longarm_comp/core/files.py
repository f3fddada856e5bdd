"""Writes files whole or not at all; hashes, checks and locks files."""

import errno
import fcntl
import hashlib
import os
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

from longarm_comp.core.errors import InputError, JobError

MOST_UNPACKED = 256_000_000
"""Largest number of bytes of an unpacked archive: of a sheet of 250,000 rows of 20 cells;
predictors need less."""
_STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def file_hash(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, or of a folder's files in the order of their names."""
    whole, digest = Path(path), hashlib.sha256()
    for part in sorted(whole.rglob("*")) if whole.is_dir() else [whole]:
        if part.is_file():
            with part.open("rb") as file:
                while piece := file.read(1 << 20):
                    digest.update(piece)
    return digest.hexdigest()


def check_regular(path: str | os.PathLike[str]) -> None:
    """Raise InputError for a pipe, socket or device, whose reading might never end."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # missing or unreadable: who opens it says so
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(path, "file", "a pipe, a socket or a device", "a regular file")


MOST_BYTES = 500_000_000
"""Largest number of bytes of a table: more than 20 million numbers of 20 characters."""


def check_size(path: str | os.PathLike[str]) -> None:
    """Raise InputError for a table of more than `MOST_BYTES`, before it is read."""
    with suppress(OSError):  # who opens it says so
        if (size := os.stat(path).st_size) > MOST_BYTES:
            allowed = f"at most {MOST_BYTES} bytes: split it"
            raise InputError(path, "file", f"{size} bytes", allowed)


def check_unpacked(path: str | os.PathLike[str], archive: zipfile.ZipFile) -> None:
    """Raise InputError for an archive that would unpack to more than `MOST_UNPACKED` bytes."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > MOST_UNPACKED:
        raise InputError(path, "unpacked size", f"{size} bytes", f"at most {MOST_UNPACKED} bytes")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on a clean exit it replaces ``path`` in one step.

    It keeps the suffix of ``path``, for writers that choose their format by it. When the block
    raises, ``path`` is left as it was. Missing parent folders are made. Temporary files of writers
    that were killed are removed. If ``path`` is a symbolic link, the file that it leads to is
    replaced.

    Raises:
        InputError: ``path`` is a folder or cannot be written.
        JobError: the disk is full or fails.
    """
    target = follow_link(path)
    try:
        folder = target.is_dir()
    except OSError as error:  # not even its folder can be looked into
        raise _not_writable(target, error) from error
    if folder:
        raise InputError(target, "output file", "a folder", "a file name")
    handle, partial = _partial_beside(target)
    try:
        yield partial
        os.fsync(handle)
        _publish(partial, target)
    except OSError as error:
        if error.errno not in _STORAGE:
            raise
        raise JobError(f"{target} was not written: {error.strerror}") from error
    finally:
        with suppress(FileNotFoundError):
            partial.unlink()
        os.close(handle)


def follow_link(path: str | os.PathLike[str]) -> Path:
    """Return the file that a path or symbolic link leads to; InputError for links in a circle."""
    target = Path(path)
    if not os.path.islink(target):
        return target
    try:
        return target.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise InputError(target, "link", str(error), "a link that leads to a file") from error


@contextmanager
def atomic_paths(*paths: str | os.PathLike[str]) -> Iterator[list[Path]]:
    """Yield a temporary path, as `atomic_path` does, for each of several files that go together.

    None of the files is replaced before all are written.
    """
    with ExitStack() as held:
        partials = [held.enter_context(atomic_path(path)) for path in paths]
        yield partials
        for partial in partials:  # a disk may say only now that it is full
            with partial.open("rb") as file:
                os.fsync(file.fileno())


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write bytes to ``path``, whole or not at all.

    Let other libraries write into memory first: on a full disk some raise errors of any kind.
    """
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def write_texts(texts: Mapping[Path, str]) -> None:
    """Write texts as UTF-8. No file is replaced before all texts are written."""
    with atomic_paths(*texts) as partials:
        for partial, text in zip(partials, texts.values(), strict=True):
            partial.write_text(text, encoding="utf-8", newline="\n")


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8 to ``path``, whole or not at all."""
    write_bytes(path, text.encode())


def lock_beside(path: Path) -> IO[bytes] | None:
    """Lock a file, which need not exist, against other processes that lock it too.

    The lock is a hidden file beside it. It lasts until the hidden file is closed or the process
    ends.

    Returns:
        The hidden file; None if it cannot be made or locked, and then nothing is locked.

    Raises:
        InputError: another process holds the lock.
    """
    try:
        beside = os.open(path.with_name(f".{path.name}.lock"), os.O_RDWR | os.O_CREAT, 0o666)
    except OSError:
        return None
    lock = os.fdopen(beside, "rb")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise InputError(path, "file", "in use by another process", "one file each") from None
    except OSError:  # a file system without locks
        lock.close()
        return None
    return lock


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder within a ``with`` block, against other processes that lock it too.

    Nothing is written there. A folder that is missing or cannot be locked is not locked.

    Raises:
        InputError: another process has locked it.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        yield
        return
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                allowed = "one program at a time"
                raise InputError(folder, "folder", "in use by another process", allowed) from None
        yield
    finally:
        os.close(handle)


def check_writable(folder: Path) -> None:
    """Make a folder if it is missing; InputError if no file can be written there."""
    handle, partial = _partial_beside(folder / "file")
    partial.unlink()
    os.close(handle)


def _partial_beside(target: Path) -> tuple[int, Path]:
    """Make a temporary file beside ``target``; return its handle and its path.

    It is locked as long as its writer lives. Temporary files whose writer ended are removed.
    """
    begin = f".{target.stem}.unfinished-"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for left in target.parent.iterdir():
            if left.name.startswith(begin) and left.suffix == target.suffix:
                with suppress(OSError), left.open("rb") as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    left.unlink()
        while True:
            handle, name = tempfile.mkstemp(dir=target.parent, prefix=begin, suffix=target.suffix)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_EX)
            if os.fstat(handle).st_nlink:  # nobody removed it before it was locked
                return handle, Path(name)
            os.close(handle)
    except OSError as error:
        raise _not_writable(target, error) from error


def _publish(partial: Path, target: Path) -> None:
    """Give the file the permissions that an ordinary new file would have, then move it in place."""
    try:
        os.umask(umask := os.umask(0))
        partial.chmod(target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~umask)
        os.replace(partial, target)
    except OSError as error:
        raise _not_writable(target, error) from error


def _not_writable(target: Path, error: OSError) -> InputError:
    return InputError(target, "output folder", error.strerror or str(error), "a folder to write in")
