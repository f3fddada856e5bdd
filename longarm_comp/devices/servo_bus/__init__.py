"""Serial buses of smart servos: one file a protocol, one interface, typed faults."""

from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import (
    FoundServo,
    Scan,
    models,
    open_bus,
    protocols,
    scan_line,
    usable_ports,
)
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
