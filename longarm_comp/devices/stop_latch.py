"""A stop of an arm, kept in files until somebody resets it, whatever process dies meanwhile."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path

from longarm_comp.core.errors import JobError, LongarmError
from longarm_comp.core.files import write_text

_EXPLAINED = "Beside this file: stops of arms that nobody has reset yet (`longarm reset`).\n"


class Stop(Enum):
    """What a person asks for; its name is that of the service."""

    ESTOP = "emergency stop"
    HOLD = "held"


class StopLatch:
    """What stops an arm, also what an earlier process was asked for.

    That a file is there counts, not what it holds. Where files cannot be read, or none could be
    written, the arm is held.

    Args:
        folder: of the files.
        namespace, arm, port: of the arm's graph; its file, if known; its servos' port. An arm is
            known by its file in its namespace, and by its port.

    Attributes:
        standing: what stops the arm, in words.
        trouble: why that would not outlast this process; empty where it would.
    """

    def __init__(self, folder: Path, namespace: str, arm: str, port: str) -> None:
        known_by = [f"port {port}"] + [f"{namespace} {os.path.realpath(arm)}"] * bool(arm)
        self._folder, self._names = folder, [*map(_file_name, known_by)]
        self.standing: dict[Stop, str] = {}
        self.trouble, self._owing = "", False
        try:
            for stop in Stop:
                for file in self._files(stop):
                    with suppress(FileNotFoundError):
                        self.standing[stop] = _words(stop, file.lstat().st_mtime)
            self._try_folder()
        except (LongarmError, OSError) as error:
            self.ask(Stop.HOLD, "because stops cannot be kept")
            self._owing, self.trouble = True, str(error)

    @property
    def words(self) -> str:
        """Why the arm is stopped, in a sentence; empty where it is not."""
        lasts = f"this ends with the driver: {self.trouble}" if self.trouble else ""
        return "; ".join(filter(None, (*self.standing.values(), lasts))) if self.standing else ""

    def ask(self, stop: Stop, why: str = "") -> None:
        """Stop the arm from now on; `keep` writes it."""
        if stop not in self.standing:
            self.standing[stop] = _words(stop, time.time(), why)
            self._owing = True

    def keep(self) -> None:
        """Write what is not written yet. Where that fails, `trouble` says why: call it again."""
        if not self._owing:
            return
        try:
            for stop, words in self.standing.items():
                for file in self._files(stop):
                    write_text(file, words + "\n")
            folder = os.open(self._folder, os.O_RDONLY)
            try:
                os.fsync(folder)  # the names too outlast a loss of power
            finally:
                os.close(folder)
            self._owing, self.trouble = False, ""
        except (LongarmError, OSError) as error:
            self.trouble = str(error)

    @contextmanager
    def lifted(self, *stops: Stop) -> Iterator[None]:
        """End stops. They stand again where their files cannot be removed, or the block raises."""
        before = dict(self.standing)
        if not any(stop in before for stop in stops):
            yield
            return
        try:
            self._remove(stops)
            self.standing = {stop: said for stop, said in before.items() if stop not in stops}
            yield
        except BaseException:
            self.standing, self._owing = before, True
            self.keep()
            raise

    def _remove(self, stops: tuple[Stop, ...]) -> None:
        try:
            self._try_folder()
            for stop in stops:
                for file in self._files(stop):
                    file.unlink(missing_ok=True)
        except OSError as error:
            raise JobError(f"the stop stays: {error}") from error

    def _try_folder(self) -> None:
        write_text(self._folder / "README.txt", _EXPLAINED)

    def _files(self, stop: Stop) -> list[Path]:
        return [self._folder / f"{name}.{stop.name.lower()}" for name in self._names]


def _file_name(text: str) -> str:
    """A file's name for any text: its last letters, and a hash."""
    legible = re.sub(r"[^A-Za-z0-9]+", "_", text)[-60:].strip("_")
    return f"{legible}-{hashlib.blake2s(text.encode(), digest_size=6).hexdigest()}"


def _words(stop: Stop, since: float, why: str = "") -> str:
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since))
    reason = f", {why}" if why else ""
    return f"{stop.value} since {at}{reason}; call ~/{stop.name.lower()} with false to go on"
