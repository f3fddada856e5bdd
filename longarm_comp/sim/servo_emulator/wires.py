"""The emulated protocols: of this package, and of entry points of the group `GROUP`."""

from functools import cache

from longarm_comp.core.entry_points import protocols_of_other_packages
from longarm_comp.core.errors import InputError
from longarm_comp.sim.servo_emulator.dynamixel import DynamixelWire
from longarm_comp.sim.servo_emulator.feetech import FeetechWire
from longarm_comp.sim.servo_emulator.wire import Wire

GROUP = "longarm_comp.servo_wires"
"""Group of the entry points of emulated protocols from other packages."""


@cache
def list_wires() -> dict[str, Wire]:
    """Return the servos' side of all protocols that are emulated, by name.

    Raises InputError if a package registers a name that is taken.
    """
    known: dict[str, Wire] = {wire.name: wire for wire in (FeetechWire(), DynamixelWire())}
    for kind, source in protocols_of_other_packages(GROUP, Wire):
        if kind.name in known:
            raise InputError(source, "name", kind.name, "a name that no other protocol has")
        known[kind.name] = kind()
    return known


def wire_of(protocol: str, where: object) -> Wire:
    """Return the servos' side of a protocol. Raises InputError for one that is not emulated."""
    if protocol not in list_wires():
        allowed = f"for a simulated arm {', '.join(list_wires())} (docs/add_a_protocol.md)"
        raise InputError(where, "protocol", protocol, allowed)
    return list_wires()[protocol]
