"""Errors of a servo bus by type, each with the data needed to act on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoState


class ServoBusError(JobError):
    """Base of every fault of the bus or of a servo on it."""

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self.args


class BusUnplugged(ServoBusError):  # noqa: N818
    """The serial port cannot be opened, is held by another process, or has gone away."""

    def __init__(self, port: str, why: str) -> None:
        super().__init__("the serial port is not usable", port=port, why=why)
        self.args = (port, why)
        self.port = port


class IncompleteReply(ServoBusError):  # noqa: N818
    """Some servos gave no usable answer after every retry.

    Attributes:
        silent: ids that sent nothing.
        corrupt: ids whose answer failed its checksum.
        answered: states of the servos that did answer.
    """

    reason_text = "no usable answer"

    def __init__(
        self,
        silent: Sequence[int],
        corrupt: Sequence[int] = (),
        answered: Mapping[int, ServoState] | None = None,
        attempts: int = 1,
    ) -> None:
        super().__init__(
            self.reason_text,
            silent=list(silent),
            corrupt=list(corrupt),
            answered=sorted(answered or {}),
            attempts=attempts,
        )
        self.args = (tuple(silent), tuple(corrupt), dict(answered or {}), attempts)
        self.silent = tuple(silent)
        self.corrupt = tuple(corrupt)
        self.answered: dict[int, ServoState] = dict(answered or {})
        self.attempts = attempts

    @property
    def ids(self) -> tuple[int, ...]:
        """Every servo without a usable answer."""
        return tuple(sorted({*self.silent, *self.corrupt}))


class ServoTimeout(IncompleteReply):
    """At least one servo was silent."""

    reason_text = "servos did not answer in time"


class ServoChecksum(IncompleteReply):
    """Every servo answered, but at least one answer was damaged on the way."""

    reason_text = "answers of servos failed their checksum"


class ServoFault(ServoBusError):  # noqa: N818
    """A servo reports an alarm of its own (overheating, overload, voltage, sensor)."""

    def __init__(self, servo_id: int, flags: ServoAlarm) -> None:
        super().__init__("the servo reports an alarm", id=servo_id, alarm=flags.name or int(flags))
        self.args = (servo_id, flags)
        self.servo_id = servo_id
        self.flags = flags


class ServoRejected(ServoBusError):  # noqa: N818
    """A servo refused an instruction (range, access, length); the code is the servo's own."""

    def __init__(self, servo_id: int, code: int) -> None:
        super().__init__("the servo refused the instruction", id=servo_id, code=code)
        self.args = (servo_id, code)
        self.servo_id = servo_id
        self.code = code
