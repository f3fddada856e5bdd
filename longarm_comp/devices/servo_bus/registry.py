"""The known protocols and servo models, and the search for servos on a serial line."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import cache, partial

from serial.tools import list_ports

from longarm_comp.core.entry_points import protocols_of_other_packages
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.dialect import Dialect
from longarm_comp.devices.servo_bus.dynamixel import DynamixelX
from longarm_comp.devices.servo_bus.feetech import FeetechSts
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import IncompleteReply, ServoFault, ServoModel

GROUP = "longarm_comp.servo_protocols"
"""Entry-point group under which other packages register their protocols."""


@cache
def protocols() -> dict[str, type[Dialect]]:
    """Return all protocols by name. Raises InputError if a package registers a taken name."""
    known: dict[str, type[Dialect]] = {kind.name: kind for kind in (FeetechSts, DynamixelX)}
    for kind, source in protocols_of_other_packages(GROUP, Dialect):
        names = [kind.name, *(model.name for model in kind.models)]
        taken = {*known, *(model.name for other in known.values() for model in other.models)}
        for new in names:
            if new in taken:
                raise InputError(source, "name", new, "a name that no other protocol or servo has")
        known[kind.name] = kind
    return known


@cache
def models() -> dict[str, ServoModel]:
    return {model.name: model for kind in protocols().values() for model in kind.models}


def open_bus(
    protocol: str,
    port: str,
    baudrate: int,
    servos: Mapping[int, ServoModel],
    reply_timeout_s: float = 0.02,
    retries: int = 2,
) -> SerialServoBus:
    """Open a port for a known protocol. Raises BusUnplugged.

    Args:
        servos: model of each servo, by id.
        reply_timeout_s: longest wait for a reply, s.
        retries: repetitions of an instruction without a good reply.
    """
    line = SerialPort(port, baudrate, reply_timeout_s)
    return SerialServoBus(line, protocols()[protocol](), servos, retries)


_ALL_IDS = range(253)
_PATIENCE_S = 0.2
"""Longest wait, s, for a servo that may already have the id that is to be given."""
_LOOKS, _DAMAGED = 5, 2
"""Number of states that are read from a found servo, and number of damaged replies from which on
several servos seem to have its id."""


@dataclass(frozen=True, slots=True)
class FoundServo:
    servo_id: int
    model_number: int
    model: str  # its name; empty where the model number is unknown here
    firmware: str  # version, numbers with points
    clash: bool  # its answers are damaged or doubled, as when two servos have the same id
    alarm: str = ""  # its present alarms, in words
    memory: Mapping[str, int] = field(default_factory=dict)
    """Registers that decide what a command means to the servo, by name."""
    told: str = ""  # registers not as from the factory, or that differ among models, with addresses


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


def _ask_each(
    port: str,
    protocol: str,
    baudrate: int,
    tell: Callable[[str, float], None],
    ids: Sequence[int],
    patience_s: float,
) -> dict[int, FoundServo]:
    """Ask ids one after the other; return the servos that answer, by id."""
    found = {}
    with closing(SerialPort(port, baudrate, patience_s)) as line:
        for n, servo_id in enumerate(ids):
            tell(f"{protocol}, {baudrate} bit/s, id {servo_id}", n / len(ids))
            if servo := look(line, protocols()[protocol](), servo_id):
                found[servo_id] = servo
    return found


def scan_line(
    port: str,
    protocol: str | None,
    baudrate: int | None,
    ids: Sequence[int],
    reply_timeout_s: float,
    tell: Callable[[str, float], None],
    expected: Collection[int] = (),
) -> Scan | None:
    """Find the first protocol and rate at which a servo answers, and all servos that answer there.

    Args:
        protocol, baudrate: the only one to try; None: all known ones, one after the other.
        reply_timeout_s: longest wait per id, s.
        tell: called with a text about the present id, and the share done, 0 to 1.
        expected: ids that should be there. If one is silent, it is asked again with ten times the
            wait. So is every servo whose answers were not clear, because a late answer looks like
            that of a second servo.

    Returns:
        The servos found; None if nothing answered.

    Raises:
        BusUnplugged: the port cannot be opened, or does not have the rate.
        InputError: the protocol is not known.
    """
    if protocol is not None and protocol not in protocols():
        raise InputError("servo bus", "protocol", protocol, ", ".join(protocols()))
    tries = [
        (name, rate)
        for name in ([protocol] if protocol else protocols())
        for rate in ([baudrate] if baudrate else protocols()[name].baudrates)
    ]
    for k, (name, rate) in enumerate(tries):

        def tell_share(said: str, share: float, k: int = k) -> None:
            tell(said, (k + share) / len(tries))

        ask = partial(_ask_each, port, name, rate, tell_share)
        if heard := ask(ids, reply_timeout_s):
            clear = {servo_id for servo_id, servo in heard.items() if not servo.clash}
            unclear = ({*expected}.intersection(ids) | heard.keys()) - clear
            heard |= ask(sorted(unclear), 10.0 * reply_timeout_s)
            return Scan(port, name, rate, tuple(heard[i] for i in sorted(heard)))
    return None


def list_usable_ports() -> list[tuple[str, str]]:
    """List device and description of this machine's USB serial ports, which may lead to a bus."""
    found = sorted(list_ports.comports(), key=lambda port: port.device)
    return [(p.device, p.description or "") for p in found if p.vid is not None]


def look(line: SerialPort, dialect: Dialect, servo_id: int) -> FoundServo | None:
    """Ask which servo has an id; None if none answers.

    A late answer of the id asked before can hide this servo, or look like a second one.  So if the
    line was disturbed, the id is asked once more when the line is quiet.
    """
    found, disturbed = _look_once(line, dialect, servo_id)
    if disturbed:
        while line.receive(1):
            pass
        again, _ = _look_once(line, dialect, servo_id)
        found = again or found
    return found


def _look_once(line: SerialPort, dialect: Dialect, servo_id: int) -> tuple[FoundServo | None, bool]:
    """Ask an id once; return the servo or None, and whether the line was disturbed.

    States are read because those of two servos with the same id and model differ.
    """
    bus = SerialServoBus(line, dialect, {}, retries=1)
    counters, first = bus.counters, bus.ask([servo_id], dialect.model)
    if first.silent:
        return None, bool(counters.stray_frames or counters.stale_bytes)
    states = [bus.ask([servo_id], dialect.state, retries=0) for _ in range(_LOOKS)]
    damaged = sum(servo_id not in answers.replies for answers in [first, *states])
    stray = bool(counters.stray_frames or counters.stale_bytes)
    reply = first.replies.get(servo_id)
    number = int.from_bytes(reply.data, "little") if reply else 0
    version = bus.ask([servo_id], dialect.firmware).replies.get(servo_id)
    kept = None
    with suppress(IncompleteReply, ServoFault):
        kept = bus.memory([servo_id])[servo_id]
    alarms = bus.alarms([servo_id])
    found = FoundServo(
        servo_id,
        number,
        dialect.model_name(number),
        ".".join(map(str, version.data)) if version else "",
        damaged >= _DAMAGED or (stray and not counters.timeouts),
        alarms.get(servo_id, ""),
        kept.values if kept else {},
        kept.notable if kept else "",
    )
    return found, stray or found.clash


def change_servo_id(found: Scan, servo_id: int) -> int:
    """Write a new id into the memory of the only servo of a scan; its torque is switched off.

    The scan may have asked only some ids, so the new id is asked before and after the change.

    Returns:
        The id that the servo had before.

    Raises:
        InputError: the new id is not 0 to 252.
        JobError: not exactly one servo is on the line, the ids of this protocol can only be set
            with the maker's tool, another servo has the new id, or the servo does not answer to it.
        BusUnplugged: the port cannot be opened.
    """
    if servo_id not in _ALL_IDS:
        raise InputError("servo set-id", "ID", servo_id, f"0 to {_ALL_IDS[-1]}")
    ids = [servo.servo_id for servo in found.servos]
    if len(ids) != 1 or found.clashes:
        raise JobError("connect one servo alone, or several get the same id", ids=ids)
    dialect, old = protocols()[found.protocol](), ids[0]
    if dialect.identity is None:
        raise JobError(f"ids of {found.protocol} are set with its maker's tool")
    with closing(SerialPort(found.port, found.baudrate, reply_timeout_s=_PATIENCE_S)) as line:
        if servo_id != old and look(line, dialect, servo_id) is not None:
            raise JobError("another servo has this id: connect one servo alone", id=servo_id)
        line.send(dialect.sync_write(dialect.torque, {old: b"\0"}))
        if dialect.turns_lock is not None:
            line.send(dialect.sync_write(dialect.turns_lock, {old: b"\0"}))
        line.send(dialect.sync_write(dialect.identity, {old: bytes((servo_id,))}))
        if dialect.turns_lock is not None:  # also of a servo that did not hear its new id
            locked = dict.fromkeys((old, servo_id), b"\1")
            line.send(dialect.sync_write(dialect.turns_lock, locked))
        for _ in range(3):
            if (renamed := look(line, dialect, servo_id)) is None:
                continue
            if renamed.clash:
                why = "two servos have this id now, or the line is bad: scan one servo alone"
                raise JobError(why, id=servo_id, before=old)
            return old
    raise JobError("the servo does not answer to its new id: scan again", id=servo_id, before=old)
