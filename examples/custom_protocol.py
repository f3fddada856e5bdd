"""A servo protocol from outside the package: a servo built around a microcontroller.

    request  AA  1 address length n  id ... id                sum    (read)
             AA  2 address length n  id data ... id data      sum    (write)
    reply    55  id alarms length    data                     sum

`docs/add_a_protocol.md` explains it; the tests run both sides against each other.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import ClassVar

from longarm_comp.devices.servo_bus.dialect import Block, Dialect, Reply, limit_units
from longarm_comp.devices.servo_bus.memory import Register
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState
from longarm_comp.sim.servo_emulator.motor import Motor
from longarm_comp.sim.servo_emulator.wire import Device, Wire

READ, WRITE = 1, 2


class MakerServo(Dialect):
    """Registers: model 0, firmware 2, turns 3, torque 4, goal 5, speed 7, state 9."""

    name = "maker"
    models = (ServoModel("maker-12bit", "maker", 7, 4096, (0, 4095), (-30000, 30000), 1000.0),)
    header = b"\x55"
    overhead = 5
    alarm_bits: ClassVar = {0: ServoAlarm.OVERHEAT, 1: ServoAlarm.OVERLOAD}
    model = Block(0, 2)
    firmware = Block(2, 1)
    baudrates = (115_200,)
    turns = Block(3, 1)
    torque = Block(4, 1)
    goal = Block(5, 4)
    goal_position = Block(5, 2)
    state = Block(9, 9)
    registers = (Register("turns", 3, factory=0, allowed=(0, 1), otherwise="it takes no goals"),)

    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        """Each servo answers when those before it in the list have answered."""
        return _request(READ, block, len(ids), bytes(ids))

    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        """Servos do not answer a write."""
        data = b"".join(bytes((servo_id,)) + value for servo_id, value in values.items())
        return _request(WRITE, block, len(values), data)

    def frame_length(self, start: bytearray) -> int:
        """Bytes of a reply."""
        return start[3] + self.overhead

    def reply(self, frame: bytes) -> Reply:
        """Id, alarms and data, with the sum of all bytes at the end."""
        return Reply(frame[1], frame[2], frame[4:-1], sum(frame[:-1]) & 0xFF == frame[-1])

    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        """Position, and speed with 0 for as fast as it can."""
        return struct.pack("<hH", ticks, limit_units(speed_ticks_s, 1.0, 0xFFFF))

    def ticks_of(self, position: bytes) -> int:
        """Position, as it is sent and read."""
        return int(struct.unpack("<h", position)[0])

    def turns_bytes(self, many: bool) -> bytes:
        """1 counts turns."""
        return bytes((many,))

    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        """Position, speed, load (1/1000), voltage (0.1 V), temperature (deg C), moving."""
        ticks, speed, load, volts, celsius, _ = struct.unpack("<hhhBBB", data)
        return ServoState(
            position_ticks=ticks,
            velocity_ticks_s=float(speed),
            load=load / model.full_load,
            voltage_v=volts / 10.0,
            temperature_c=float(celsius),
            error_flags=alarms,
        )


def _request(kind: int, block: Block, count: int, data: bytes) -> bytes:
    body = bytes((0xAA, kind, block.address, block.length, count)) + data
    return body + bytes((sum(body) & 0xFF,))


class MakerWire(Wire):
    """The servo's side of the protocol above: `longarm up --sim` emulates it."""

    name, kept_below = "maker", 4

    def device(self, servo_id: int, motor: Motor) -> Device:
        """Model 7, firmware 3."""
        return Device(servo_id, bytearray((7, 0, 3)) + bytearray(15), motor)

    def take(self, buffer: bytearray) -> list[bytes]:
        """Whole requests with a correct sum; other bytes are skipped."""
        frames = []
        while len(buffer) >= 6:
            one = 1 if buffer[1] == READ else 1 + buffer[3]
            end = 6 + buffer[4] * one
            if buffer[0] != 0xAA or buffer[1] not in (READ, WRITE):
                del buffer[0]
            elif len(buffer) < end:
                break
            else:
                if sum(buffer[: end - 1]) & 0xFF == buffer[end - 1]:
                    frames.append(bytes(buffer[:end]))
                del buffer[:end]
        return frames

    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        """Each servo that is asked answers; what is written moves it."""
        _, kind, address, length, count = frame[:5]
        if kind == READ:
            asked = [devices[i] for i in frame[5 : 5 + count] if i in devices]
            return [(d.servo_id, self._reply(d, address, length)) for d in asked]
        for start in range(5, 5 + count * (1 + length), 1 + length):
            if device := devices.get(frame[start]):
                data = frame[start + 1 : start + 1 + length]
                device.memory[address : address + length] = data
                if address == 4:
                    device.motor.switch(bool(data[0]))
                if address == 5:
                    goal, speed = struct.unpack("<hH", device.memory[5:9])
                    device.motor.goal, device.motor.speed_limit = float(goal), float(speed)
        return []

    def _reply(self, device: Device, address: int, length: int) -> bytes:
        motor = device.motor
        device.memory[4] = motor.torque_on
        device.memory[9:18] = struct.pack(
            "<hhhBBB", round(motor.position), round(motor.velocity), round(1000 * motor.effort),
            round(10 * motor.voltage_v), round(motor.temperature_c), motor.moving,
        )  # fmt: skip
        alarms = ("overheat" in motor.alarms) | ("overload" in motor.alarms) << 1
        data = device.memory[address : address + length]
        body = bytes((0x55, device.servo_id, alarms, length)) + data
        return body + bytes((sum(body) & 0xFF,))
