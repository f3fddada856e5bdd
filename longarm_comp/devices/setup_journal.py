"""A file with the values that servos had stored before a setup, to write them back."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Mapping

from longarm_comp.core.errors import JobError
from longarm_comp.core.files import write_text
from longarm_comp.devices.servo_bus.bus import Change, SerialServoBus
from longarm_comp.devices.servo_bus.state import IncompleteReply
from longarm_comp.devices.state_folder import state_folder


class SetupJournal:
    """The journal of one port and protocol. It is written before the first servo is changed."""

    def __init__(self, port: str, protocol: str) -> None:
        place = f"{os.path.realpath(port)}-{protocol}"
        slug = re.sub(r"[^A-Za-z0-9]+", "-", place).strip("-")
        self.path = state_folder() / "servo_setup" / f"{slug}.json"

    def read(self) -> dict[int, Change]:
        """Return the changes to undo, by servo id. Raises JobError if the file is damaged."""
        try:
            data = json.loads(self.path.read_text("utf-8"))
            return {
                int(i): (bytes.fromhex(had), bytes.fromhex(new))
                for i, (had, new) in data["turns"].items()
            }
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise JobError(
                f"{self.path} is damaged: it holds what servos had stored before a setup changed "
                "it; look at the servos with `longarm servo scan`, then delete it",
                why=str(error),
            ) from error

    def begin(self, changes: Mapping[int, Change]) -> None:
        """Add changes that are about to be made, by servo id; earlier entries are kept."""
        self._write(dict(changes) | self.read())

    def _write(self, changes: Mapping[int, Change]) -> None:
        turns = {str(i): [had.hex(), new.hex()] for i, (had, new) in changes.items()}
        write_text(self.path, json.dumps({"turns": turns}) + "\n")

    def end(self, ids: Collection[int]) -> None:
        """Remove the entries of these servos; nothing of them will be written back.

        Raises JobError if the file is damaged or cannot be removed.
        """
        left = {i: change for i, change in self.read().items() if i not in ids}
        if left:  # replaced, so that a process that is killed here loses none of them
            self._write(left)
            return
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise JobError(f"{self.path} cannot be removed: {error.strerror}") from error

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
