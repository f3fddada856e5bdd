"""List of the protocols and servo models. A new protocol is one file and one line here."""

from __future__ import annotations

from collections.abc import Mapping

from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.dialect import Dialect
from longarm_comp.devices.servo_bus.dynamixel import DynamixelX
from longarm_comp.devices.servo_bus.feetech import FeetechSts
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import ServoModel

PROTOCOLS: dict[str, type[Dialect]] = {"feetech": FeetechSts, "dynamixel": DynamixelX}

_ONE_TURN = (0, 4095)
_STS_TURNS = (-30719, 30719)
_X_TURNS = (-1048575, 1048575)


def _sts(name: str, number: int) -> ServoModel:
    return ServoModel(name, "feetech", number, 4096, _ONE_TURN, _STS_TURNS, 1000.0)


def _x(name: str, number: int, full_load: float) -> ServoModel:
    return ServoModel(name, "dynamixel", number, 4096, _ONE_TURN, _X_TURNS, full_load)


MODELS: dict[str, ServoModel] = {
    model.name: model
    for model in (
        _sts("sts3215", 777),
        _sts("sts3250", 2825),
        _x("xl330-m077", 1190, 1750.0),  # present current, 1 mA a unit
        _x("xl330-m288", 1200, 1750.0),
        _x("xl430-w250", 1060, 1000.0),  # present load, 0.1 % a unit
        _x("xm430-w350", 1020, 1193.0),  # present current, 2.69 mA a unit
        _x("xm540-w270", 1120, 2047.0),
    )
}


def open_bus(
    protocol: str,
    port: str,
    baudrate: int,
    models: Mapping[int, ServoModel],
    reply_timeout_s: float = 0.02,
    retries: int = 2,
) -> SerialServoBus:
    """Open a port and speak ``protocol`` on it.

    Raises:
        InputError: unknown protocol, or a servo model with another protocol.
        BusUnplugged: the port cannot be opened.
    """
    if protocol not in PROTOCOLS:
        raise InputError("servo bus", "protocol", protocol, ", ".join(PROTOCOLS))
    for servo_id, model in models.items():
        if model.protocol != protocol:
            raise InputError(
                "servo bus", f"servo {servo_id}", model.name, f"a model that speaks {protocol}"
            )
    line = SerialPort(port, baudrate, reply_timeout_s)
    return SerialServoBus(line, PROTOCOLS[protocol](), models, retries)
