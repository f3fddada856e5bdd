"""State, model and errors of servos, the same for every protocol.

The ``facts`` of an error hold the data needed to act on it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag

from longarm_comp.core.errors import JobError


class ServoAlarm(IntFlag):
    """Alarms that a servo raises itself; each protocol maps its own bits to these."""

    NONE = 0
    VOLTAGE = 1
    SENSOR = 2
    OVERHEAT = 4
    CURRENT = 8
    OVERLOAD = 16
    OTHER = 32

    @property
    def words(self) -> str:
        return self.name or str(int(self))


@dataclass(frozen=True, slots=True)
class ServoState:
    """One read-back of one servo."""

    position_ticks: int  # encoder position; may be negative or above one turn in multi-turn use
    velocity_ticks_s: float  # encoder ticks a second
    load: float  # drive effort as a signed share of the servo's maximum, -1 to 1
    voltage_v: float  # supply voltage at the servo
    temperature_c: float  # inside the case
    error_flags: ServoAlarm = ServoAlarm.NONE  # alarms it raises now


@dataclass(frozen=True, slots=True)
class ServoModel:
    """A kind of servo, from its data sheet."""

    name: str  # as written in the configuration
    protocol: str  # name of the wire protocol
    model_number: int  # what it answers to a ping
    ticks_per_turn: int  # encoder ticks in one turn of the horn
    single_turn: tuple[int, int]  # lowest and highest goal in ordinary position mode, ticks
    multi_turn: tuple[int, int]  # lowest and highest goal if it may turn more than once, ticks
    full_load: float  # present-load (or present-current) reading at full effort
    friction: float | None = None
    """Friction as a share of full effort: current without load / current at stall, by the data
    sheet; None: not known. It limits how well a payload can be estimated from the load."""
    top_speed_ticks_s: float | None = None
    """Speed without load at the highest voltage of the data sheet, ticks/s; None: not known."""


class ServoBusError(JobError):
    """Base of every fault of the bus or of a servo on it."""


class BusUnplugged(ServoBusError):  # noqa: N818
    """The serial port cannot be opened, is held by another process, or has gone away."""

    def __init__(self, reason: str = "the serial port is not usable", **facts: object) -> None:
        super().__init__(reason, **facts)


class IncompleteReply(ServoBusError):  # noqa: N818
    """Some servos did not answer after all retries, or their answers were damaged.

    ``facts`` usually has the ids of silent servos (``silent``), of servos whose answer failed its
    checksum (``corrupt``), and of those that answered (``answered``).

    Attributes:
        states: states of the servos that answered, by id.
    """

    def __init__(
        self, reason: str, states: Mapping[int, ServoState] | None = None, **facts: object
    ) -> None:
        super().__init__(reason, **facts)
        self.states: dict[int, ServoState] = dict(states or {})


class ServoFault(ServoBusError):  # noqa: N818
    """A servo reports an alarm, refuses an instruction, or would jump if it were switched on."""
