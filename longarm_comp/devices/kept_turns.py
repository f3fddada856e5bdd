"""Keeps in a file which joints of an arm stand where their reading needs a count of turns."""

import os
from collections.abc import Collection
from concurrent import futures
from pathlib import Path

from longarm_comp.core.files import write_text
from longarm_comp.devices.stop_latch import file_name

TURNS = "servo_turns"  # the folder of these files


class KeptTurns:
    """The joints whose servos stand outside the turn from which they count after power-on.

    Such a servo reads within this turn again after a loss of power, so the next process sees that
    the count may be lost. A thread writes the file, so that a disk delays no cycle.

    Args:
        folder: folder for files that outlast a process.
        arm: path of arm.yaml; empty if not known: the arm is then known by its port.
        joints: names of all joints; all are taken for away if the file cannot be read, or names
            others: a joint has another name since.

    Attributes:
        away: names of these joints, as they were last read.
    """

    def __init__(self, folder: Path, arm: str, port: str, joints: Collection[str]) -> None:
        name = file_name(os.path.realpath(arm) if arm else f"port {port}")
        self._file = folder / TURNS / f"{name}.txt"
        self._disk, self._writing = futures.ThreadPoolExecutor(1), futures.Future[None]()
        self._writing.set_result(None)
        self._failed = ""  # why the write before the last failed
        self._kept: frozenset[str] | None = frozenset()  # in the file; None: not known
        try:
            self._kept = frozenset(self._file.read_text("utf-8").splitlines())
        except FileNotFoundError:
            pass
        except (OSError, ValueError):
            self._kept = None
        known = frozenset(joints)
        self.away = known if self._kept is None or self._kept - known else self._kept

    def keep(self, away: frozenset[str]) -> None:
        """Write the joints that are away, beside the caller; call it again after every reading."""
        self.away = away
        if self._writing.done() and (away != self._kept or self.trouble):
            text = "".join(f"{name}\n" for name in sorted(away))
            self._failed = self.trouble
            self._kept, self._writing = away, self._disk.submit(write_text, self._file, text)

    @property
    def trouble(self) -> str:
        """The reason why the last write that ended failed; empty if it did not."""
        return str(self._writing.exception() or "") if self._writing.done() else self._failed
