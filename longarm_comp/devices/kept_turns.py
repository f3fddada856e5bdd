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
        joints: names of all joints; all are taken for away if the file cannot be read.

    Attributes:
        away: names of these joints, as they are or shall be in the file.
    """

    def __init__(self, folder: Path, arm: str, port: str, joints: Collection[str]) -> None:
        name = file_name(os.path.realpath(arm) if arm else f"port {port}")
        self._file = folder / TURNS / f"{name}.txt"
        self._disk, self._writing = futures.ThreadPoolExecutor(1), futures.Future[None]()
        self._writing.set_result(None)
        self.away: frozenset[str] = frozenset()
        try:
            self.away = frozenset(self._file.read_text("utf-8").splitlines())
        except FileNotFoundError:
            pass
        except (OSError, ValueError):
            self.away = frozenset(joints)

    def keep(self, away: frozenset[str]) -> None:
        """Write the joints that are away, beside the caller; call it again after every reading."""
        if self._writing.done() and (away != self.away or self._writing.exception()):
            text = "".join(f"{name}\n" for name in sorted(away))
            self.away, self._writing = away, self._disk.submit(write_text, self._file, text)
