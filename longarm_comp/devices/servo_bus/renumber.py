"""Give the one servo on a line another id, and see that it answers to it."""

from __future__ import annotations

from contextlib import closing

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.registry import protocols
from longarm_comp.devices.servo_bus.scan import ALL_IDS, Scan, look


def renumber(found: Scan, servo_id: int, reply_timeout_s: float = 0.05) -> int:
    """Write an id into the memory of the only servo of a scan; its torque goes off.

    Returns:
        The id that it had.

    Raises:
        InputError: no id of a servo.
        JobError: several servos are on the line, or it does not answer to its new id.
    """
    if servo_id not in ALL_IDS:
        raise InputError("servo set-id", "ID", servo_id, f"0 to {ALL_IDS[-1]}")
    ids = [servo.servo_id for servo in found.servos]
    if len(ids) != 1 or found.clashes:
        raise JobError("connect one servo alone, or several get the same id", ids=ids)
    dialect, old = protocols()[found.protocol](), ids[0]
    if dialect.identity is None:
        raise JobError(f"ids of {found.protocol} are set with its maker's tool")
    with closing(SerialPort(found.port, found.baudrate, reply_timeout_s)) as line:
        line.send(dialect.sync_write(dialect.torque, {old: b"\0"}))
        if dialect.turns_lock is not None:
            line.send(dialect.sync_write(dialect.turns_lock, {old: b"\0"}))
        line.send(dialect.sync_write(dialect.identity, {old: bytes((servo_id,))}))
        if dialect.turns_lock is not None:
            line.send(dialect.sync_write(dialect.turns_lock, {servo_id: b"\1"}))
        for _ in range(3):
            if look(line, dialect, found.protocol, servo_id) is not None:
                return old
    raise JobError("the servo does not answer to its new id: scan again", id=servo_id, before=old)
