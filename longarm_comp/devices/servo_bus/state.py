"""State of a servo and its model, the same for every protocol."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag


class ServoAlarm(IntFlag):
    """Alarms a servo raises by itself; each protocol maps its own bits onto these."""

    NONE = 0
    VOLTAGE = 1
    SENSOR = 2
    OVERHEAT = 4
    CURRENT = 8
    OVERLOAD = 16
    OTHER = 32


@dataclass(frozen=True, slots=True)
class ServoState:
    """One read-back of one servo."""

    position_ticks: int  # encoder position; may be negative or above one turn in multi-turn use
    velocity_ticks_s: float  # encoder ticks a second
    load: float  # drive effort as a signed share of the servo's maximum, -1 to 1
    voltage_v: float  # supply voltage at the servo
    temperature_c: float  # inside the case
    moving: bool  # whether the servo reports that it moves
    error_flags: ServoAlarm = ServoAlarm.NONE  # alarms it raises now


@dataclass(frozen=True, slots=True)
class ServoModel:
    """A kind of servo, from its data sheet.

    Attributes:
        name: as written in the configuration.
        protocol: name of the wire protocol.
        model_number: what it answers to a ping.
        ticks_per_turn: encoder ticks in one turn of the horn.
        single_turn: lowest and highest goal in ordinary position mode, ticks.
        multi_turn: the same when it may turn more than once.
        full_load: present-load (or present-current) reading at full effort.
        friction: share of full effort that turns it free: its current then over that at a stall;
            None: its data sheet does not say. It bounds what its load tells of a payload.
    """

    name: str
    protocol: str
    model_number: int
    ticks_per_turn: int
    single_turn: tuple[int, int]
    multi_turn: tuple[int, int]
    full_load: float
    friction: float | None = None
