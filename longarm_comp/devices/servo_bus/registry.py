"""The protocols and servo models: of this package, and of entry points of the group `GROUP`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from longarm_comp.core.entry_points import protocols_of_other_packages
from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.dialect import Dialect
from longarm_comp.devices.servo_bus.dynamixel import DynamixelX
from longarm_comp.devices.servo_bus.feetech import FeetechSts
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import ServoModel

GROUP = "longarm_comp.servo_protocols"
"""Group of the entry points of protocols from other packages."""


@cache
def protocols() -> dict[str, type[Dialect]]:
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
    """The servos of all protocols, by name."""
    return {model.name: model for kind in protocols().values() for model in kind.models}


def open_bus(
    protocol: str,
    port: str,
    baudrate: int,
    servos: Mapping[int, ServoModel],
    reply_timeout_s: float = 0.02,
    retries: int = 2,
) -> SerialServoBus:
    """Open a port and speak ``protocol`` on it.

    Raises:
        InputError: unknown protocol, or a servo model with another protocol.
        BusUnplugged: the port cannot be opened.
    """
    if protocol not in protocols():
        raise InputError("servo bus", "protocol", protocol, ", ".join(protocols()))
    for servo_id, model in servos.items():
        if model.protocol != protocol:
            raise InputError(
                "servo bus", f"servo {servo_id}", model.name, f"a model that speaks {protocol}"
            )
    line = SerialPort(port, baudrate, reply_timeout_s)
    return SerialServoBus(line, protocols()[protocol](), servos, retries)
