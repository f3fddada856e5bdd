"""Serial buses of smart servos: one file a protocol, one interface, typed faults."""

from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus, protocols
from longarm_comp.devices.servo_bus.scan import FoundServo, Scan, scan_line, usable_ports
from longarm_comp.devices.servo_bus.state import (
    BusUnplugged,
    IncompleteReply,
    ServoAlarm,
    ServoBusError,
    ServoChecksum,
    ServoFault,
    ServoModel,
    ServoRejected,
    ServoState,
    ServoTimeout,
)
