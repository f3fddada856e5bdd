"""Serial buses of smart servos: one file a protocol, one interface, typed faults."""
