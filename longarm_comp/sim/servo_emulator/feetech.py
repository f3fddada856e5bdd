"""The emulated side of the Feetech STS protocol, written from the maker's memory table."""

from enum import IntEnum

from longarm_comp.sim.servo_emulator.motor import Motor
from longarm_comp.sim.servo_emulator.wire import Device, RegisterWire

_STEPS = 3  # operating mode in which a goal is a number of steps
_STATUS_BITS = {"voltage": 1, "sensor": 2, "overheat": 4, "current": 8, "overload": 32}


class _At(IntEnum):
    """Addresses in the memory table, and its length."""

    FIRMWARE, MODEL, ID, MIN_ANGLE, MAX_ANGLE, MAX_TORQUE = 0, 3, 5, 9, 11, 16
    PHASE, RESOLUTION, OFFSET, MODE = 18, 30, 31, 33
    TORQUE, GOAL, GOAL_SPEED, LOCK = 40, 42, 46, 55
    POSITION, SPEED, LOAD, VOLTS, TEMPERATURE, STATUS, MOVING = 56, 58, 60, 62, 63, 65, 66
    MEMORY = 87


class FeetechWire(RegisterWire):
    """The Feetech STS protocol with the memory table of the STS3215."""

    name = "feetech"
    kept_below = _At.TORQUE
    word = 1

    def device(self, servo_id: int, motor: Motor) -> Device:
        device = Device(servo_id, bytearray(_At.MEMORY), motor)
        device.put(_At.FIRMWARE, 2, 3 | 10 << 8)
        device.put(_At.MODEL, 2, motor.spec.model or 777)
        device.put(_At.ID, 1, servo_id)
        device.put(_At.MIN_ANGLE, 2, 0)
        device.put(_At.MAX_ANGLE, 2, 4095)
        device.put(_At.MAX_TORQUE, 2, 1000)
        device.put(_At.PHASE, 1, 12)
        device.put(_At.RESOLUTION, 1, 1)
        device.put(_At.LOCK, 1, 1)
        device.put(_At.GOAL, 2, _sign_magnitude(round(motor.position), 15))
        device.kept = bytes(device.memory)
        return device

    def take(self, buffer: bytearray) -> list[bytes]:
        frames = []
        while len(buffer) >= 6:
            if buffer[0] != 0xFF or buffer[1] != 0xFF or buffer[2] == 0xFF or buffer[3] < 2:
                del buffer[0]
                continue
            end = buffer[3] + 4
            if len(buffer) < end:
                break
            if (sum(buffer[2:end]) & 0xFF) == 0xFF:
                frames.append(bytes(buffer[:end]))
                del buffer[:end]
            else:
                del buffer[0]
        return frames

    def parts(self, frame: bytes) -> tuple[int, int, bytes]:
        return frame[2], frame[4], frame[5:-1]

    def status(self, device: Device, error: int, data: bytes) -> tuple[int, bytes]:
        body = bytes((device.servo_id, len(data) + 2, _status_bits(device.motor))) + data
        return device.servo_id, b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))

    def read(self, device: Device, address: int, length: int) -> tuple[int, bytes]:
        _refresh_memory(device)
        return 0, bytes(device.memory[address : address + length])

    def write(self, device: Device, address: int, data: bytes) -> int:
        end = address + len(data)
        if end > _At.POSITION or not data:
            return 0
        device.memory[address:end] = data
        if not device.get(_At.LOCK, 1):
            device.kept = bytes(device.memory)  # while locked, changes last until power is lost
        device.servo_id = device.get(_At.ID, 1)
        motor = device.motor
        if address <= _At.GOAL_SPEED < end:
            motor.speed_limit = float(device.get(_At.GOAL_SPEED, 2) & 0x7FFF)
        if address <= _At.TORQUE < end:
            motor.clear_alarms()
            motor.switch(device.get(_At.TORQUE, 1) == 1)
        if address <= _At.GOAL < end:
            if not motor.torque_on:
                motor.switch(True)  # a goal wakes an STS servo up
            low, high = device.get(_At.MIN_ANGLE, 2), device.get(_At.MAX_ANGLE, 2)
            low, high = (low, high) if high else (-30719, 30719)
            asked = _decode_signed(device.get(_At.GOAL, 2))
            goal = float(max(low, min(high, asked)))
            if device.get(_At.MODE, 1) == _STEPS:
                motor.goal = motor.position + goal
            elif device.get(_At.MODE, 1) == 0:
                motor.goal = goal + _offset(device) + motor.reading - _seen_ticks(device)
        return 0


def _refresh_memory(device: Device) -> None:
    """Bring the read-only part of the memory up to date."""
    motor = device.motor
    device.put(_At.TORQUE, 1, int(motor.torque_on))
    device.put(_At.POSITION, 2, _sign_magnitude(_seen_ticks(device) - _offset(device), 15))
    device.put(_At.SPEED, 2, _sign_magnitude(round(motor.velocity), 15))
    device.put(_At.LOAD, 2, _sign_magnitude(round(motor.effort * motor.spec.load_units), 10))
    device.put(_At.VOLTS, 1, round(motor.voltage_v * 10))
    device.put(_At.TEMPERATURE, 1, round(motor.temperature_c))
    device.put(_At.STATUS, 1, _status_bits(motor))
    device.put(_At.MOVING, 1, int(motor.moving))


def _seen_ticks(device: Device) -> int:
    """Return the ticks that the encoder knows: in ordinary mode those within its turn."""
    many = not device.get(_At.MAX_ANGLE, 2)
    motor = device.motor
    return motor.reading if many else motor.reading % motor.spec.ticks_per_turn


def _status_bits(motor: Motor) -> int:
    return sum(_STATUS_BITS[name] for name in motor.alarms)


def _sign_magnitude(value: int, bit: int) -> int:
    return min(abs(value), (1 << bit) - 1) | (int(value < 0) << bit)


def _offset(device: Device) -> int:
    return _decode_signed(device.get(_At.OFFSET, 2), 11)


def _decode_signed(raw: int, bit: int = 15) -> int:
    size = raw & ((1 << bit) - 1)
    return -size if raw >> bit & 1 else size
