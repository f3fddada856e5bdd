"""Stops and faults of an arm, kept in files, so that they outlast every process until reset."""

import hashlib
import os
import re
import time
from collections.abc import Collection, Iterator, Mapping
from concurrent import futures
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from longarm_comp.core.errors import JobError, LongarmError
from longarm_comp.core.files import write_text

_EXPLAINED = "Beside this file: stops of arms that nobody has reset yet (`longarm reset`).\n"


_AGAIN = ", asked for again at "
_DISK_S = 1.0
"""Longest wait for the disk, s: one that is worn out, or far away, may hang."""


class Stop(Enum):
    """The kinds of stop that only a person ends: two that a person asks for, and a fault."""

    ESTOP = "emergency stop"
    HOLD = "held"
    FAULT = "fault"

    @property
    def cure(self) -> str:
        """The instruction, in words, by which a person ends the stop."""
        if self is Stop.FAULT:
            return "call ~/reset once cured"
        return f"call ~/{self.name.lower()} with false to go on"


class StopLatch:
    """The stops of an arm that are in force, also those asked of an earlier process.

    A stop is in force if its file exists, whatever the file contains. If the files cannot be read
    or written, the arm is held.

    An arm has several names, each with its own file: its arm.yaml in its namespace, its port as
    given, and the device to which a link at this port leads.

    Args:
        namespace: namespace of the arm's graph.
        arm: path of arm.yaml; empty if not known.
        port: serial port of the servos.

    A thread writes the files, so that a disk that hangs delays no stop.

    Attributes:
        standing: description of each stop in force.
        names: what each file of the arm stands for, by its name without suffix.
    """

    def __init__(self, folder: Path, namespace: str, arm: str, port: str) -> None:
        known_by = names_of_port(port) + [_of_arm(namespace, arm)] * bool(arm)
        self._folder, self.names = folder, {file_name(text): text for text in known_by}
        self.standing: dict[Stop, str] = {}
        self._disk, self._owing = futures.ThreadPoolExecutor(max_workers=1), False
        self._writing = futures.Future[None]()  # the last write
        self._failed = ""  # why the write before it failed
        self._due_s = 0.0  # when the disk counts as hanging, monotonic s
        try:
            for stop in Stop:
                for file in self._list_files(stop):
                    with suppress(FileNotFoundError):
                        self.standing[stop] = _read(file, stop).words
            self._try_folder()
            self._writing.set_result(None)
        except (LongarmError, OSError) as error:
            self.ask(Stop.HOLD, "because stops cannot be kept")
            self._writing.set_exception(error)

    @property
    def words(self) -> str:
        """The reasons why the arm is stopped, in one line; empty if it is not."""
        if not self.standing:
            return ""
        said = [f"{words}; {stop.cure}" for stop, words in self.standing.items()]
        lasts = [f"this ends with the driver: {self.trouble}"] * bool(self.trouble)
        return "; ".join((*said, *lasts))

    @property
    def writing(self) -> bool:
        """True while a write is under way that may still end in time."""
        return not self._writing.done() and time.monotonic() < self._due_s

    @property
    def trouble(self) -> str:
        """The reason why the stops would not outlast this process; empty if they would.

        While `writing`, it is that of the write before.
        """
        if self._writing.done():
            return str(self._writing.exception() or "")
        return self._failed if self.writing else f"the disk of {self._folder} does not answer"

    def ask(self, stop: Stop, why: str = "") -> None:
        """Put a stop in force; `keep` then writes it.

        If the stop is in force already, its description says that it was asked for again: a person
        who wants to end his own stop sees that another person asked for it too.
        """
        words = self.standing.get(stop, "")
        now = _describe_stop(stop, time.time(), why)
        first = words.partition(_AGAIN)[0]
        again = f"{first}{_AGAIN}{now.partition('since ')[2]}"
        self.standing = {**self.standing, stop: again if words else now}
        self._owing = True

    def mark(self, within_s: float) -> None:
        """Make the files, still empty: they stop the next process; wait this long at most, s."""
        files = [file for stop in self.standing for file in self._list_files(stop)]
        futures.wait([self._disk.submit(_make_files, files)], within_s)

    def keep(self, within_s: float | None = None) -> None:
        """Write the files that are not written yet or are gone.

        If this fails, `trouble` gives the reason; call it again then.

        Args:
            within_s: longest wait for it, s; None: as long as a disk may take that does not hang.
        """
        if self._owing or (self.standing and self._writing.done()):
            anew, self._owing = self._owing or bool(self.trouble), False
            if self._writing.done():
                self._due_s, self._failed = time.monotonic() + _DISK_S, self.trouble
            self._writing = self._disk.submit(self._write_files, self.standing, anew)
        futures.wait([self._writing], _DISK_S if within_s is None else within_s)

    def _write_files(self, standing: Mapping[Stop, str], anew: bool) -> None:
        texts = {
            file: f"{words}\n{of}\n"
            for stop, words in standing.items()
            for file, of in self._list_files(stop).items()
        }
        if not anew and all(os.path.lexists(file) for file in texts):
            return
        _make_files(texts)  # at once, as `mark` does: the texts wait for the disk
        for file, text in texts.items():
            write_text(file, text)
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)  # so that the names, too, outlast a loss of power
        finally:
            os.close(folder)

    @contextmanager
    def lift_stops(self, *stops: Stop) -> Iterator[None]:
        """End stops for the block and after it.

        They are in force again if the block raises an exception.

        Raises:
            JobError: their files cannot be removed; the stops remain in force.
        """
        before = dict(self.standing)
        if not any(stop in before for stop in stops):
            yield
            return
        try:
            self._disk_removes(stops)
            self.standing = {stop: said for stop, said in before.items() if stop not in stops}
            yield
        except BaseException:
            self.standing, self._owing = before, True
            self.keep()
            raise

    def _disk_removes(self, stops: tuple[Stop, ...]) -> None:
        removing = self._disk.submit(self._remove_files, stops)
        futures.wait([removing], _DISK_S)
        if removing.cancel() or removing.running():
            raise JobError(f"the stop stays: {self._folder} does not answer")
        if error := removing.exception():
            raise JobError(f"the stop stays: {error}") from error

    def _remove_files(self, stops: tuple[Stop, ...]) -> None:
        self._try_folder()
        for stop in stops:
            for file in self._list_files(stop):
                file.unlink(missing_ok=True)

    def _try_folder(self) -> None:
        write_text(self._folder / "README.txt", _EXPLAINED)

    def _list_files(self, stop: Stop) -> dict[Path, str]:
        """Return the files of a stop, each with the name of the arm for which it stands."""
        return {self._folder / f"{n}.{stop.name.lower()}": of for n, of in self.names.items()}


@dataclass(frozen=True)
class KeptStop:
    """A file of a stop.

    Attributes:
        of: the arm or port that is stopped, in words; the file's name if the file is damaged.
        words: the kind of stop, and since when.
    """

    file: Path
    of: str
    words: str

    def __str__(self) -> str:
        return f"{self.words} ({self.of}; {self.file})"


def kept_stops(folder: Path) -> list[KeptStop]:
    """List all stops that are kept in a folder and in its subfolders (of simulated arms)."""
    kept = []
    for stop in Stop:
        for file in sorted(folder.rglob(f"*.{stop.name.lower()}")):
            with suppress(FileNotFoundError):
                kept.append(_read(file, stop))
    return kept


def _read(file: Path, stop: Stop) -> KeptStop:
    """Read the file of a stop, if it exists; a damaged file tells only its kind and since when."""
    since, said = file.lstat().st_mtime, [""]
    with suppress(OSError):
        said = file.read_bytes()[:4096].decode("utf-8", "replace").splitlines()
    if len(said) == 2 and file_name(said[1]) == file.stem:
        return KeptStop(file, said[1], said[0])
    return KeptStop(file, file.stem, _describe_stop(stop, since))


def refuse_under_stop(folder: Path, ports: Collection[str], arm: Path | None = None) -> None:
    """Raise an error if a stop forbids to move or power servos without a driver.

    Args:
        folder: folder of the stops.
        ports: serial ports of the servos.
        arm: path of arm.yaml. Its stops count in every namespace.

    Raises:
        JobError: a stop is in force (the message says how to end it), or stops cannot be read.
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


def _make_files(files: Collection[Path]) -> None:
    for file in files:
        if not os.path.lexists(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()


def _of_arm(namespace: str, arm: str) -> str:
    return f"{namespace} {os.path.realpath(arm)}"


def names_of_port(port: str) -> list[str]:
    """Return the names by which files know a port: as given, and the device to which it leads."""
    # The number of a pseudo-terminal is soon reused for another one
    ports = (port, os.path.realpath(port))
    return [f"port {name}" for name in ports if name == port or "/pts/" not in name]


def file_name(text: str) -> str:
    """Return a file name for any text: its last 60 legible characters, and a hash."""
    legible = re.sub(r"[^A-Za-z0-9]+", "_", text)[-60:].strip("_")
    return f"{legible}-{hashlib.blake2s(text.encode(), digest_size=6).hexdigest()}"


def _describe_stop(stop: Stop, since: float, why: str = "") -> str:
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since))
    reason = f", {why}" if why else ""
    return f"{stop.value} since {at}{reason}"
