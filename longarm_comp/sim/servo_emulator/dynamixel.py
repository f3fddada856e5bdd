"""The emulated side of Dynamixel protocol 2.0, written from the maker's e-Manual (XL430-W250)."""

from enum import IntEnum

from longarm_comp.sim.servo_emulator.motor import Motor
from longarm_comp.sim.servo_emulator.wire import Device, RegisterWire, Told

_HARDWARE_BITS = {"voltage": 1, "overheat": 4, "sensor": 8, "current": 16, "overload": 32}
_SPEED_UNIT = 0.229 * 4096 / 60  # ticks/s
_POSITION, _EXTENDED = 3, 4  # operating modes
_REVERSE, _TIME_BASED = 1, 4  # bits of the drive mode


class _At(IntEnum):
    """Addresses in the control table, and its length."""

    MODEL, FIRMWARE, ID, DRIVE_MODE, MODE, OFFSET = 0, 6, 7, 10, 11, 20
    PWM_LIMIT, CURRENT_LIMIT, VELOCITY_LIMIT, MAX_POSITION, MIN_POSITION = 36, 38, 44, 48, 52
    TORQUE, HARDWARE_ERROR, PROFILE_VELOCITY, GOAL = 64, 70, 112, 116
    MOVING, LOAD, VELOCITY, POSITION, VOLTS, TEMPERATURE = 122, 126, 128, 132, 144, 146
    MEMORY = 147


class _Refused(IntEnum):
    """Error codes of a status frame."""

    BAD_INSTRUCTION, BAD_RANGE, OVER_LIMIT, NO_ACCESS = 2, 4, 6, 7


class DynamixelWire(RegisterWire):
    """Dynamixel protocol 2.0; register table of the XL430-W250, which the X series shares."""

    name = "dynamixel"
    kept_below = _At.TORQUE
    word = 2

    def device(self, servo_id: int, motor: Motor) -> Device:
        device = Device(servo_id, bytearray(_At.MEMORY), motor)
        device.put(_At.MODEL, 2, motor.spec.model or 1060)
        device.put(_At.FIRMWARE, 1, 45)
        device.put(_At.ID, 1, servo_id)
        device.put(_At.MODE, 1, _POSITION)
        device.put(_At.PWM_LIMIT, 2, 885)
        device.put(_At.CURRENT_LIMIT, 2, 1193)
        device.put(_At.VELOCITY_LIMIT, 4, 265)
        device.put(_At.MAX_POSITION, 4, 4095)
        device.put(_At.GOAL, 4, round(motor.position) & 0xFFFFFFFF)
        device.kept = bytes(device.memory)
        return device

    def take(self, buffer: bytearray) -> list[bytes]:
        frames = []
        while len(buffer) >= 10:
            if buffer[:4] != b"\xff\xff\xfd\x00":
                del buffer[0]
                continue
            end = 7 + int.from_bytes(buffer[5:7], "little")
            if not 10 <= end <= 1024:
                del buffer[0]
                continue
            if len(buffer) < end:
                break
            if _crc_of(bytes(buffer[: end - 2])) == int.from_bytes(buffer[end - 2 : end], "little"):
                frames.append(bytes(buffer[:end]))
                del buffer[:end]
            else:
                del buffer[0]
        return frames

    def parts(self, frame: bytes) -> tuple[int, int, bytes]:
        return frame[4], frame[7], frame[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")

    def status(self, device: Device, error: int, data: bytes) -> tuple[int, bytes]:
        error |= 0x80 if device.motor.alarms else 0
        body = (bytes((0x55, error)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        size = (len(body) + 2).to_bytes(2, "little")
        frame = b"\xff\xff\xfd\x00" + bytes((device.servo_id,)) + size + body
        return device.servo_id, frame + _crc_of(frame).to_bytes(2, "little")

    def carry_out(self, device: Device, instruction: int, params: bytes) -> tuple[int, bytes]:
        if instruction == Told.PING:
            model, firmware = _At.MODEL, _At.FIRMWARE
            return 0, bytes(
                device.memory[model : model + 2] + device.memory[firmware : firmware + 1]
            )
        if instruction not in (Told.READ, Told.WRITE):
            return _Refused.BAD_INSTRUCTION, b""
        return super().carry_out(device, instruction, params)

    def read(self, device: Device, address: int, length: int) -> tuple[int, bytes]:
        if address + length > _At.MEMORY:
            return _Refused.BAD_RANGE, b""
        _refresh_memory(device)
        return 0, bytes(device.memory[address : address + length])

    def write(self, device: Device, address: int, data: bytes) -> int:
        end = address + len(data)
        motor = device.motor
        if end > _At.MEMORY or (address < _At.TORQUE and motor.torque_on) or end > _At.MOVING:
            return _Refused.NO_ACCESS
        if address <= _At.GOAL < end:
            goal = int.from_bytes(
                data[_At.GOAL - address : _At.GOAL - address + 4], "little", signed=True
            )
            low, high = device.get(_At.MIN_POSITION, 4), device.get(_At.MAX_POSITION, 4)
            if device.get(_At.MODE, 1) == _EXTENDED:
                low, high = -1048575, 1048575
            if not low <= goal <= high:
                return _Refused.OVER_LIMIT
        device.memory[address:end] = data
        device.kept, device.servo_id = bytes(device.memory), device.get(_At.ID, 1)
        if address <= _At.TORQUE < end:
            if not motor.torque_on:
                motor.goal = motor.position
            motor.switch(device.get(_At.TORQUE, 1) == 1)
        if address <= _At.GOAL < end and device.get(_At.MODE, 1) in (_POSITION, _EXTENDED):
            motor.goal = float(
                _sign_of(device) * (_signed_at(device, _At.GOAL) - _signed_at(device, _At.OFFSET))
            )
        if end > _At.PROFILE_VELOCITY and address <= _At.GOAL:
            profile = device.get(_At.PROFILE_VELOCITY, 4)
            if device.get(_At.DRIVE_MODE, 1) & _TIME_BASED:  # duration of a motion, ms
                way = abs(motor.goal - motor.position)
                motor.speed_limit = way / (profile / 1000.0) if profile else 0.0
            else:
                top = device.get(_At.VELOCITY_LIMIT, 4)
                motor.speed_limit = min(profile, top) * _SPEED_UNIT
        return 0


def _sign_of(device: Device) -> int:
    return -1 if device.get(_At.DRIVE_MODE, 1) & _REVERSE else 1


def _signed_at(device: Device, address: int) -> int:
    return int.from_bytes(device.memory[address : address + 4], "little", signed=True)


def _as_stored(device: Device, ticks: int) -> int:
    """Return an encoder position (ticks) as the servo stores it, with sign and offset."""
    return (_sign_of(device) * ticks + _signed_at(device, _At.OFFSET)) & 0xFFFFFFFF


def _refresh_memory(device: Device) -> None:
    """Bring the read-only part of the memory up to date."""
    motor = device.motor
    device.put(_At.TORQUE, 1, int(motor.torque_on))
    device.put(_At.HARDWARE_ERROR, 1, sum(_HARDWARE_BITS[name] for name in motor.alarms))
    device.put(_At.GOAL, 4, _as_stored(device, round(motor.goal)))
    device.put(_At.MOVING, 1, int(motor.moving))
    device.put(_At.LOAD, 2, round(motor.effort * motor.spec.load_units) & 0xFFFF)
    velocity = _sign_of(device) * round(motor.velocity / _SPEED_UNIT)
    device.put(_At.VELOCITY, 4, velocity & 0xFFFFFFFF)
    device.put(_At.POSITION, 4, _as_stored(device, motor.reading))
    device.put(_At.VOLTS, 2, round(motor.voltage_v * 10))
    device.put(_At.TEMPERATURE, 1, round(motor.temperature_c))


def _crc_of(data: bytes) -> int:
    """Compute CRC-16 with polynomial 0x8005, initial value 0, not reflected: the e-Manual's."""
    register = 0
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ (0x18005 if register & 0x8000 else 0)
    return register
