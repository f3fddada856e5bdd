"""Keeps in files which joints of an arm stand where their reading needs a count of turns."""

import os
import time
from collections.abc import Collection, Mapping
from concurrent import futures
from pathlib import Path

from longarm_comp.core.errors import JobError
from longarm_comp.core.files import write_text
from longarm_comp.devices.servo_bus.state import ServoState
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.stop_latch import file_name, names_of_port
from longarm_comp.devices.turn_counts import TurnCounts

TURNS = "servo_turns"  # the folder of these files


class KeptTurns:
    """The joints whose servos stand outside the turn from which they count after power-on.

    Such a servo reads within this turn again after a loss of power, so the next process sees that
    the count may be lost. A thread writes, so that a disk delays no cycle.

    Each name of the arm has a file: its arm.yaml, its port as given, and the device to which a link
    at this port leads. The first of them that is there counts: an arm.yaml may have been moved.

    Args:
        folder: folder for files that outlast a process.
        arm: path of arm.yaml; empty if not known.
        joints: names of all joints; all are taken for away if the file cannot be read, or names
            others: a joint has another name since.

    Attributes:
        away: names of these joints, as they were last read.
    """

    def __init__(self, folder: Path, arm: str, port: str, joints: Collection[str]) -> None:
        names = [os.path.realpath(arm)] * bool(arm) + names_of_port(port)
        self._files = [folder / TURNS / f"{file_name(name)}.txt" for name in names]
        self._disk, self._writing = futures.ThreadPoolExecutor(1), futures.Future[None]()
        self._writing.set_result(None)
        self._failed = ""  # why the write before the last failed
        self._kept: frozenset[str] | None = None  # in the files; None: not known
        self.away = self._read_files(frozenset(joints))

    def _read_files(self, known: frozenset[str]) -> frozenset[str]:
        for file in self._files:
            try:
                kept = frozenset(file.read_text("utf-8").splitlines())
            except FileNotFoundError:
                continue
            except (OSError, ValueError):
                return known
            return known if kept - known else kept
        return frozenset()

    def keep(self, away: frozenset[str], within_s: float | None = 0.0) -> None:
        """Write the joints that are away; call it after every reading.

        ``within_s``: longest wait for the disk, s; None: as long as it takes.
        """
        self.away = away
        if self._writing.done() and (away != self._kept or self.trouble):
            text = "".join(f"{name}\n" for name in sorted(away))
            self._failed = self.trouble
            self._kept, self._writing = away, self._disk.submit(self._write_files, text)
        futures.wait([self._writing], within_s)

    def _write_files(self, text: str) -> None:
        for file in self._files:
            write_text(file, text)

    @property
    def trouble(self) -> str:
        """The reason why the last write that ended failed; empty if it did not."""
        return str(self._writing.exception() or "") if self._writing.done() else self._failed


def keep_turns(
    folder: Path, arm: Path, config: ServoConfig, states: Mapping[int, ServoState]
) -> None:
    """Keep which joints are away by these readings, whose turns a person has seen to be right.

    Args as of `KeptTurns`. Raises JobError if they cannot be kept.
    """
    counts = TurnCounts(config)
    counts.trust(time.monotonic(), states)
    kept = KeptTurns(folder, str(arm), config.bus.port, config.ids)
    kept.keep(counts.away, within_s=None)
    if kept.trouble:
        raise JobError(f"servo turns cannot be kept: {kept.trouble}")
