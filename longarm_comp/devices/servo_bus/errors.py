"""Errors of a servo bus by type. What is needed to act on one is in its ``facts``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.state import ServoState


class ServoBusError(JobError):
    """Base of every fault of the bus or of a servo on it."""


class BusUnplugged(ServoBusError):  # noqa: N818
    """The serial port cannot be opened, is held by another process, or has gone away."""

    def __init__(self, reason: str = "the serial port is not usable", **facts: object) -> None:
        super().__init__(reason, **facts)


class IncompleteReply(ServoBusError):  # noqa: N818
    """Some servos gave no usable answer after every retry.

    ``facts`` has the ids of the silent, of those whose answer failed its checksum (``corrupt``),
    and of those that answered.

    Attributes:
        states: of the servos that did answer, by id.
    """

    def __init__(
        self, reason: str, states: Mapping[int, ServoState] | None = None, **facts: object
    ) -> None:
        super().__init__(reason, **facts)
        self.states: dict[int, ServoState] = dict(states or {})


class ServoTimeout(IncompleteReply):
    """At least one servo was silent."""


class ServoChecksum(IncompleteReply):
    """Every servo answered, but at least one answer was damaged on the way."""


class ServoFault(ServoBusError):  # noqa: N818
    """A servo reports an alarm of its own (overheating, overload, voltage, sensor)."""


class ServoRejected(ServoBusError):  # noqa: N818
    """A servo refused an instruction (range, access, length); the code is the servo's own."""
