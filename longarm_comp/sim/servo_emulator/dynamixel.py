"""The emulated side of Dynamixel protocol 2.0, written from the maker's e-Manual (XL430-W250)."""

from __future__ import annotations

from collections.abc import Mapping

from longarm_comp.sim.servo_emulator.motor import (
    CURRENT,
    OVERHEAT,
    OVERLOAD,
    SENSOR,
    VOLTAGE,
    Motor,
)
from longarm_comp.sim.servo_emulator.wire import BROADCAST, Device, Wire

PING, READ, WRITE, REG_WRITE, ACTION, REBOOT = 1, 2, 3, 4, 5, 8
SYNC_READ, SYNC_WRITE, BULK_READ = 0x82, 0x83, 0x92
MODEL, FIRMWARE, ID, MODE, MAX_POSITION, MIN_POSITION = 0, 6, 7, 11, 48, 52
TORQUE, HARDWARE_ERROR, PROFILE_VELOCITY, GOAL = 64, 70, 112, 116
MOVING, LOAD, VELOCITY, POSITION, VOLTS, TEMPERATURE = 122, 126, 128, 132, 144, 146
MEMORY = 147
BAD_INSTRUCTION, BAD_RANGE, OVER_LIMIT, NO_ACCESS = 2, 4, 6, 7
_HARDWARE_BITS = {VOLTAGE: 1, OVERHEAT: 4, SENSOR: 8, CURRENT: 16, OVERLOAD: 32}
_SPEED_UNIT = 0.229 * 4096 / 60  # ticks/s
_EXTENDED = 4


class DynamixelWire(Wire):
    """XL430-W250; the rest of the X series shares its table."""

    name = "dynamixel"
    kept_below = TORQUE

    def device(self, servo_id: int, motor: Motor) -> Device:
        device = Device(servo_id, bytearray(MEMORY), motor)
        device.put(MODEL, 2, motor.spec.model or 1060)
        device.put(FIRMWARE, 1, 45)
        device.put(ID, 1, servo_id)
        device.put(MODE, 1, 3)
        device.put(MAX_POSITION, 4, 4095)
        device.put(GOAL, 4, round(motor.position) & 0xFFFFFFFF)
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
            if _crc16(bytes(buffer[: end - 2])) == int.from_bytes(buffer[end - 2 : end], "little"):
                frames.append(bytes(buffer[:end]))
                del buffer[:end]
            else:
                del buffer[0]
        return frames

    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        target, instruction = frame[4], frame[7]
        params = frame[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        if instruction == SYNC_READ:
            address, length = _word(params, 0), _word(params, 2)
            asked = [devices[i] for i in params[4:] if i in devices]
            return [_status(d, *self._read(d, address, length)) for d in asked]
        if instruction == BULK_READ:
            items = [params[start : start + 5] for start in range(0, len(params) - 4, 5)]
            return [
                _status(devices[p[0]], *self._read(devices[p[0]], _word(p, 1), _word(p, 3)))
                for p in items
                if p[0] in devices
            ]
        if instruction == SYNC_WRITE:
            address, length = _word(params, 0), _word(params, 2)
            for start in range(4, len(params) - length, length + 1):
                device = devices.get(params[start])
                if device is not None:
                    self._write(device, address, params[start + 1 : start + 1 + length])
            return []
        hearing = [devices[target]] if target in devices else []
        if target == BROADCAST:
            hearing = list(devices.values())
        replies = [_status(d, *self._single(d, instruction, params)) for d in hearing]
        return replies if target != BROADCAST or instruction == PING else []

    def _single(self, device: Device, instruction: int, params: bytes) -> tuple[int, bytes]:
        """Carry out an instruction to one servo: (error code, data)."""
        if instruction == PING:
            return 0, bytes(device.memory[MODEL : MODEL + 2]) + bytes((device.memory[FIRMWARE],))
        if instruction == READ:
            return self._read(device, _word(params, 0), _word(params, 2))
        if instruction == WRITE:
            return self._write(device, _word(params, 0), params[2:]), b""
        if instruction == REG_WRITE:
            device.pending = (_word(params, 0), params[2:])
            return 0, b""
        if instruction == ACTION and device.pending is not None:
            pending, device.pending = device.pending, None
            return self._write(device, *pending), b""
        if instruction == REBOOT:
            device.motor.clear_alarms()
            device.motor.switch(False)
            return 0, b""
        return BAD_INSTRUCTION, b""

    def _read(self, device: Device, address: int, length: int) -> tuple[int, bytes]:
        if address + length > MEMORY:
            return BAD_RANGE, b""
        return 0, self.read(device, address, length)

    def read(self, device: Device, address: int, length: int) -> bytes:
        _refresh(device)
        return bytes(device.memory[address : address + length])

    def _write(self, device: Device, address: int, data: bytes) -> int:
        """Write registers; the error code (0: done)."""
        end = address + len(data)
        motor = device.motor
        if end > MEMORY or (address < TORQUE and motor.torque_on) or end > MOVING:
            return NO_ACCESS
        if address <= GOAL < end:
            goal = int.from_bytes(data[GOAL - address : GOAL - address + 4], "little", signed=True)
            low, high = device.get(MIN_POSITION, 4), device.get(MAX_POSITION, 4)
            if device.get(MODE, 1) == _EXTENDED:
                low, high = -1048575, 1048575
            if not low <= goal <= high:
                return OVER_LIMIT
            motor.goal = float(goal)
        device.memory[address:end] = data
        device.kept, device.servo_id = bytes(device.memory), device.get(ID, 1)
        if address <= TORQUE < end:
            if not motor.torque_on:
                motor.goal = motor.position
            motor.switch(device.get(TORQUE, 1) == 1)
        if address <= PROFILE_VELOCITY < end:
            motor.speed_limit = device.get(PROFILE_VELOCITY, 4) * _SPEED_UNIT
        return 0


def _refresh(device: Device) -> None:
    """Bring the read-only part of the memory up to date."""
    motor = device.motor
    device.put(TORQUE, 1, int(motor.torque_on))
    device.put(HARDWARE_ERROR, 1, sum(_HARDWARE_BITS[name] for name in motor.alarms))
    device.put(GOAL, 4, round(motor.goal) & 0xFFFFFFFF)
    device.put(MOVING, 1, int(motor.moving))
    device.put(LOAD, 2, round(motor.effort * motor.spec.load_units) & 0xFFFF)
    device.put(VELOCITY, 4, round(motor.velocity / _SPEED_UNIT) & 0xFFFFFFFF)
    device.put(POSITION, 4, motor.reading & 0xFFFFFFFF)
    device.put(VOLTS, 2, round(motor.voltage_v * 10))
    device.put(TEMPERATURE, 1, round(motor.temperature_c))


def _status(device: Device, error: int, data: bytes) -> tuple[int, bytes]:
    error |= 0x80 if device.motor.alarms else 0
    body = (bytes((0x55, error)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    size = (len(body) + 2).to_bytes(2, "little")
    frame = b"\xff\xff\xfd\x00" + bytes((device.servo_id,)) + size + body
    return device.servo_id, frame + _crc16(frame).to_bytes(2, "little")


def _shifted(register: int) -> int:
    """The CRC register after eight more zero bits, as the e-Manual's division defines it."""
    for _ in range(8):
        register = (register << 1) ^ (0x18005 if register & 0x8000 else 0)
    return register


_SHIFTED = tuple(_shifted(byte << 8) for byte in range(256))


def _crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x8005, initial value 0, not reflected."""
    register = 0
    for byte in data:
        register = _SHIFTED[(register >> 8) ^ byte] ^ ((register & 0xFF) << 8)
    return register


def _word(data: bytes, start: int) -> int:
    return int.from_bytes(data[start : start + 2], "little")
