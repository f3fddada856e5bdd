"""A stop of an arm, kept in files until somebody resets it, whatever process dies meanwhile."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from longarm_comp.core.errors import JobError, LongarmError
from longarm_comp.core.files import write_text

_EXPLAINED = "Beside this file: stops of arms that nobody has reset yet (`longarm reset`).\n"


_AGAIN = ", asked for again at "


class Stop(Enum):
    """The stops that a person asks for; a name is that of the service."""

    ESTOP = "emergency stop"
    HOLD = "held"


class StopLatch:
    """The stops of an arm, also those that an earlier process was asked for.

    That a file is there counts, not what it holds. Where files cannot be read, or none could be
    written, the arm is held.

    Args:
        folder: of the files.
        namespace, arm, port: of the arm's graph; its file, if known; its servos' port. An arm is
            known by its file in its namespace, and by its port, as given and where a link leads.

    Attributes:
        standing: what stops the arm, in words.
        trouble: why that would not outlast this process; empty where it would.
        names: of the arm's files, without suffix, and what each stands for.
    """

    def __init__(self, folder: Path, namespace: str, arm: str, port: str) -> None:
        # The number of a pseudo-terminal is another's tomorrow
        ports = (port, os.path.realpath(port))
        known_by = [f"port {name}" for name in ports if name == port or "/pts/" not in name]
        known_by += [_of_arm(namespace, arm)] if arm else []
        self._folder, self.names = folder, {_file_name(text): text for text in known_by}
        self.standing: dict[Stop, str] = {}
        self.trouble, self._owing = "", False
        try:
            for stop in Stop:
                for file in self._list_files(stop):
                    with suppress(FileNotFoundError):
                        self.standing[stop] = _describe_stop(stop, file.lstat().st_mtime)
            self._try_folder()
        except (LongarmError, OSError) as error:
            self.ask(Stop.HOLD, "because stops cannot be kept")
            self._owing, self.trouble = True, str(error)

    @property
    def words(self) -> str:
        """The reason why the arm is stopped, in a sentence; empty where it is not."""
        if not self.standing:
            return ""
        said = [
            f"{words}; call ~/{stop.name.lower()} with false to go on"
            for stop, words in self.standing.items()
        ]
        lasts = [f"this ends with the driver: {self.trouble}"] * bool(self.trouble)
        return "; ".join((*said, *lasts))

    def ask(self, stop: Stop, why: str = "") -> None:
        """Stop the arm from now on; `keep` writes it.

        Asked for again, it says so: who ends a stop of his own sees that it is another's too.
        """
        words = self.standing.get(stop, "")
        now = _describe_stop(stop, time.time(), why)
        first = words.partition(_AGAIN)[0]
        self.standing[stop] = f"{first}{_AGAIN}{now.partition('since ')[2]}" if words else now
        self._owing = True

    def keep(self) -> None:
        """Write what is not written, or gone. `trouble` says why that fails: call it again."""
        try:
            files = (file for stop in self.standing for file in self._list_files(stop))
            if not self._owing and all(os.path.lexists(file) for file in files):
                return
            for stop, words in self.standing.items():
                for file, of in self._list_files(stop).items():
                    write_text(file, f"{words}\n{of}\n")
            folder = os.open(self._folder, os.O_RDONLY)
            try:
                os.fsync(folder)  # the names too outlast a loss of power
            finally:
                os.close(folder)
            self._owing, self.trouble = False, ""
        except (LongarmError, OSError) as error:
            self.trouble = str(error)

    @contextmanager
    def lift_stops(self, *stops: Stop) -> Iterator[None]:
        """End stops. They stand again where their files cannot be removed, or the block raises."""
        before = dict(self.standing)
        if not any(stop in before for stop in stops):
            yield
            return
        try:
            self._remove_files(stops)
            self.standing = {stop: said for stop, said in before.items() if stop not in stops}
            yield
        except BaseException:
            self.standing, self._owing = before, True
            self.keep()
            raise

    def _remove_files(self, stops: tuple[Stop, ...]) -> None:
        try:
            self._try_folder()
            for stop in stops:
                for file in self._list_files(stop):
                    file.unlink(missing_ok=True)
        except OSError as error:
            raise JobError(f"the stop stays: {error}") from error

    def _try_folder(self) -> None:
        write_text(self._folder / "README.txt", _EXPLAINED)

    def _list_files(self, stop: Stop) -> dict[Path, str]:
        """List the files of a stop, and whose each is."""
        return {self._folder / f"{n}.{stop.name.lower()}": of for n, of in self.names.items()}


@dataclass(frozen=True)
class KeptStop:
    """A file of a stop. ``of``: whose, in words; where it is damaged, the file's name says it."""

    file: Path
    of: str
    words: str

    def __str__(self) -> str:
        return f"{self.words} ({self.of}; {self.file})"


def kept_stops(folder: Path) -> list[KeptStop]:
    """List all stops that are kept in a folder and those below, where arms are simulated."""
    kept = []
    for stop in Stop:
        for file in sorted(folder.rglob(f"*.{stop.name.lower()}")):
            said = [""]
            with suppress(OSError):
                said = file.read_bytes()[:4096].decode("utf-8", "replace").splitlines()
            whole = len(said) == 2 and _file_name(said[1]) == file.stem
            with suppress(FileNotFoundError):
                words = _describe_stop(stop, file.lstat().st_mtime)
                kept.append(KeptStop(file, said[1] if whole else file.stem, words))
    return kept


def refuse_under_stop(folder: Path, ports: Collection[str], arm: Path | None = None) -> None:
    """Refuse to move or power servos without a driver while a stop of them stands.

    Args:
        arm: the arm's file, in whatever namespace.

    Raises:
        JobError: saying what stands, and how it is ended. Also where stops cannot be read.
    """
    latches = [StopLatch(folder, "/", str(arm or ""), port) for port in ports]
    for latch in latches:
        if latch.trouble:
            raise JobError(f"nothing is moved: stops cannot be read: {latch.trouble}")
    names = {name for latch in latches for name in latch.names}
    for kept in kept_stops(folder):
        of_arm = arm is not None and kept.of.endswith(_of_arm("", str(arm)))
        if kept.file.parent == folder and (of_arm or kept.file.stem in names):
            raise JobError(
                f"nothing is moved: {kept}. To go on: `longarm reset`; where no driver runs, "
                "`longarm reset --kept`"
            )


def _of_arm(namespace: str, arm: str) -> str:
    return f"{namespace} {os.path.realpath(arm)}"


def _file_name(text: str) -> str:
    """Make a file's name for any text: its last letters, and a hash."""
    legible = re.sub(r"[^A-Za-z0-9]+", "_", text)[-60:].strip("_")
    return f"{legible}-{hashlib.blake2s(text.encode(), digest_size=6).hexdigest()}"


def _describe_stop(stop: Stop, since: float, why: str = "") -> str:
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since))
    reason = f", {why}" if why else ""
    return f"{stop.value} since {at}{reason}"
