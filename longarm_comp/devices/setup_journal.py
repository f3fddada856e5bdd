"""Files with the values that servos had stored before a setup, to write them back."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from longarm_comp.core.errors import JobError
from longarm_comp.core.files import write_text
from longarm_comp.devices.servo_bus.bus import Change, SerialServoBus
from longarm_comp.devices.servo_bus.state import IncompleteReply
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import file_name

if TYPE_CHECKING:
    from longarm_comp.devices.servo_config import BusConfig

_FILES, _HELD = "servo_setup", "have not stored again what they had before"


class SetupJournal:
    """A record of what the servos of one arm had stored before the first of them was changed.

    It belongs to the arm, not to a port, because another arm may come to this port: only a setup
    or driver of the arm writes the values back or ends it.

    Args:
        state: the arm's own folder for files that outlast a process; empty: the user's.
        arm: path of arm.yaml; empty if not known. Such an arm has no entries.
        line: port, as the user gave it, and protocol of the servos.
    """

    def __init__(self, state: str, arm: str | Path, line: SerialServoBus | BusConfig) -> None:
        self._arm, self._line = os.path.realpath(arm) if str(arm) else "", line
        self._folder = state_folder(state)
        self.path = self._folder / _FILES / f"{file_name(f'{line.protocol} {self._arm}')}.json"

    def read(self) -> dict[int, Change]:
        """Return the changes to undo, by servo id. Raises JobError if the file is damaged."""
        try:
            return _changes(json.loads(self.path.read_text("utf-8")))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise JobError(_say_damaged(self.path), why=str(error)) from error

    def begin(self, changes: Mapping[int, Change]) -> None:
        """Add changes that are about to be made, by servo id; earlier entries are kept."""
        self._write(dict(changes) | self.read())

    def _write(self, changes: Mapping[int, Change]) -> None:
        of = {"arm": self._arm, "port": self._line.port, "protocol": self._line.protocol}
        turns = {str(i): [had.hex(), new.hex()] for i, (had, new) in changes.items()}
        write_text(self.path, json.dumps(of | {"turns": turns}) + "\n")

    def end(self, ids: Collection[int]) -> list[str]:
        """Remove the entries of these servos; nothing of them will be written back.

        Returns:
            A sentence about the servos that had entries; none if there were none.

        Raises:
            JobError: the file is damaged or cannot be removed.
        """
        entries = self.read()
        ended = sorted(entries.keys() & set(ids))
        left = {i: change for i, change in entries.items() if i not in ids}
        try:
            if left:  # replaced, so that a process that is killed here loses none of them
                self._write(left)
            else:
                self.path.unlink(missing_ok=True)
        except OSError as error:
            raise JobError(f"{self.path} cannot be removed: {error.strerror}") from error
        said = f"a setup of servos {ended} was broken off; they are set as configured"
        return [said] if ended else []

    def write_back(self, bus: SerialServoBus) -> list[int]:
        """Write the old values back to the servos that still hold the new ones.

        The torque of these servos is switched off.

        Returns:
            Ids of the servos that do not answer. They stay in the journal.
        """
        silent = []
        for servo_id, (had, new) in self.read().items():
            try:
                if bus.turns([servo_id])[servo_id] == new:
                    bus.store_turns({servo_id: had})
            except IncompleteReply:
                silent.append(servo_id)
            else:
                self.end([servo_id])
        return silent

    def describe_others(self) -> list[str]:
        """Return a sentence about each journal of another arm at this port."""
        folders = dict.fromkeys((self._folder, state_folder()))
        return [said for at in folders for said in describe_left(at, self._line.port, self.path)]


def describe_left(folder: Path, port: str, own: Path | None = None) -> Iterator[str]:
    """Yield a sentence about each setup at a port that was broken off and not put right yet.

    Damaged files are told at every port, because theirs is not known.

    Args:
        folder: folder for files that outlast a process.
        own: a file to leave out.
    """
    device = os.path.realpath(port)
    slug = re.sub(r"[^A-Za-z0-9]+", "-", device).strip("-")
    for file in sorted((folder / _FILES).glob("*.json")):
        if file == own:
            continue
        try:
            data = json.loads(file.read_text("utf-8"))
            ids = sorted(_changes(data))
            at = data.get("port")
            here = at is not None and os.path.realpath(at) == device
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            yield _say_damaged(file)
            continue
        if here:
            yield (
                f"a setup of {data.get('arm')} was broken off: servos {ids} {_HELD} ({file}); its "
                "next `longarm servo setup` or start of its driver sees to it"
            )
        if at is None and file.stem.startswith(f"{slug}-"):  # version 0.1.0 wrote it
            yield (
                f"a setup was broken off at this port: servos {ids} {_HELD}, and of which arm is "
                f"not known; look at them with `longarm servo scan`, then delete {file}"
            )


def _changes(data: Any) -> dict[int, Change]:
    turns = data["turns"].items()
    return {int(i): (bytes.fromhex(had), bytes.fromhex(new)) for i, (had, new) in turns}


def _say_damaged(file: Path) -> str:
    return (
        f"{file} is damaged: it holds what servos had stored before a setup changed it; look at "
        "the servos with `longarm servo scan`, then delete it"
    )
