"""Which servos are on a line: every id is asked alone, at one protocol and rate after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus.dialect import Block, Dialect
from longarm_comp.devices.servo_bus.exchange import Answers, BusCounters, ask
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.registry import models, protocols

ALL_IDS = range(253)
_LOOKS, _DAMAGED = 5, 2
"""States read of a servo that answers, and damaged ones among them that are no accident."""

Tell = Callable[[str, float], None]
"""Told what is being asked and the share done, 0 to 1."""


@dataclass(frozen=True, slots=True)
class FoundServo:
    """One id that answered.

    Attributes:
        model: its name; empty where the model number is unknown here.
        firmware: version, numbers with points.
        clash: its answers are damaged or doubled, as when two servos have the same id.
    """

    servo_id: int
    model_number: int
    model: str
    firmware: str
    clash: bool


@dataclass(frozen=True, slots=True)
class Scan:
    """Servos on a line that speak one protocol at one rate."""

    port: str
    protocol: str
    baudrate: int
    servos: tuple[FoundServo, ...]

    @property
    def clashes(self) -> tuple[int, ...]:
        """Ids that more than one servo seems to have."""
        return tuple(servo.servo_id for servo in self.servos if servo.clash)


def scan_line(
    port: str,
    protocol: str | None = None,
    baudrate: int | None = None,
    ids: Iterable[int] = ALL_IDS,
    reply_timeout_s: float = 0.02,
    tell: Tell = lambda text, share: None,
) -> Scan | None:
    """The first protocol and rate at which a servo answers, with all servos that answer then.

    Args:
        protocol, baudrate: only this one; None: all that are known, one after the other.

    Returns:
        None where nothing answered.

    Raises:
        BusUnplugged: the port cannot be opened, or does not have the rate.
    """
    if protocol is not None and protocol not in protocols():
        raise InputError("servo bus", "protocol", protocol, ", ".join(protocols()))
    asked = list(ids)
    tries = [
        (name, rate)
        for name in ([protocol] if protocol else protocols())
        for rate in ([baudrate] if baudrate else protocols()[name].baudrates)
    ]
    for k, (name, rate) in enumerate(tries):
        line = SerialPort(port, rate, reply_timeout_s)
        try:
            servos = []
            for n, servo_id in enumerate(asked):
                tell(f"{name}, {rate} bit/s, id {servo_id}", (k + n / len(asked)) / len(tries))
                servo = look(line, protocols()[name](), name, servo_id)
                servos += [servo] if servo else []
        finally:
            line.close()
        if servos:
            return Scan(port, name, rate, tuple(servos))
    return None


def usable_ports() -> list[tuple[str, str]]:
    """Serial ports of this machine that may lead to a bus: device and description."""
    from serial.tools import list_ports

    found = sorted(list_ports.comports(), key=lambda port: port.device)
    return [(p.device, p.description or "") for p in found if p.vid is not None]


def look(line: SerialPort, dialect: Dialect, protocol: str, servo_id: int) -> FoundServo | None:
    """One id. A twin's model number is the same and its state is not, so both are read."""
    counters = BusCounters()

    def read(block: Block, retries: int = 1) -> Answers:
        def request(missing: Sequence[int]) -> bytes:
            return dialect.sync_read(missing, block)

        return ask(line, dialect, request, [servo_id], block.length, retries, counters)

    first = read(dialect.model)
    if first.silent:
        return None
    states = [read(dialect.state, retries=0) for _ in range(_LOOKS)]
    damaged = sum(servo_id not in answers.replies for answers in [first, *states])
    doubled = counters.stray_frames + counters.stale_bytes > 0 and not counters.timeouts
    number = _number(first, servo_id)
    version = read(dialect.firmware).replies.get(servo_id)
    return FoundServo(
        servo_id,
        number,
        next((m.name for m in models().values() if (m.protocol, m.model_number) ==
              (protocol, number)), ""),
        ".".join(map(str, version.data)) if version else "",
        damaged >= _DAMAGED or doubled,
    )  # fmt: skip


def _number(answers: Answers, servo_id: int) -> int:
    reply = answers.replies.get(servo_id)
    return int.from_bytes(reply.data, "little") if reply else 0
