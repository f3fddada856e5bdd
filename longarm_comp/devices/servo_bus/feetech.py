"""Feetech STS/SMS serial protocol: ``FF FF id length instruction params... ~sum``.

Source: Feetech, "SMS/STS series memory table" and "Communication protocol manual"; signed values
are sign and magnitude, low byte first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from longarm_comp.devices.servo_bus.dialect import Block, Dialect, Reply
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

_HEADER = b"\xff\xff"
_BROADCAST = 0xFE
_SYNC_READ, _SYNC_WRITE = 0x82, 0x83
_LONGEST = 250
_ALARM_BITS = {
    0: ServoAlarm.VOLTAGE,
    1: ServoAlarm.SENSOR,
    2: ServoAlarm.OVERHEAT,
    3: ServoAlarm.CURRENT,
    5: ServoAlarm.OVERLOAD,
}


def _sts(name: str, number: int, friction: float | None = None) -> ServoModel:
    return ServoModel(name, "feetech", number, 4096, (0, 4095), (-30719, 30719), 1000.0, friction)


class FeetechSts(Dialect):
    """STS3215 and its family."""

    name = "feetech"
    models = (_sts("sts3215", 777, 0.18 / 2.7), _sts("sts3250", 2825))
    overhead = 6
    model = Block(3, 2)
    firmware = Block(0, 2)
    baudrates = (1_000_000, 500_000, 115_200, 57_600, 38_400)
    identity = Block(5, 1)
    turns = Block(9, 4)
    torque = Block(40, 1)
    goal = Block(41, 7)
    turns_lock = Block(55, 1)
    state = Block(56, 11)
    alarm = None

    def encode(self, servo_id: int, instruction: int, params: bytes = b"") -> bytes:
        """The instruction frame."""
        body = bytes((servo_id, len(params) + 2, instruction)) + params
        return _HEADER + body + bytes((_checksum(body),))

    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        return self.encode(
            _BROADCAST, _SYNC_READ, bytes((block.address, block.length)) + bytes(ids)
        )

    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        params = b"".join(bytes((servo_id,)) + value for servo_id, value in values.items())
        return self.encode(_BROADCAST, _SYNC_WRITE, bytes((block.address, block.length)) + params)

    def decode(self, buffer: bytearray, final: bool) -> list[Reply]:
        replies: list[Reply] = []
        while (start := buffer.find(_HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < self.overhead:
                break
            servo_id, length = buffer[2], buffer[3]
            if servo_id >= _BROADCAST or not 2 <= length <= _LONGEST:
                del buffer[0]
                continue
            end = length + 4
            if len(buffer) < end and not final:
                return replies
            intact = len(buffer) >= end and _checksum(buffer[2 : end - 1]) == buffer[end - 1]
            if intact:
                replies.append(Reply(servo_id, buffer[4], bytes(buffer[5 : end - 1])))
                del buffer[:end]
            else:
                # The length itself may be what is damaged, so only the header is given up.
                replies.append(Reply(servo_id, 0, b"", intact=False))
                del buffer[:2]
        return replies

    def refusal(self, error: int) -> int:
        return 0

    def alarms(self, error: int) -> ServoAlarm:
        return self.alarm_flags(error)

    def alarm_flags(self, value: int) -> ServoAlarm:
        flags = ServoAlarm.NONE
        for bit in range(8):
            if value >> bit & 1:
                flags |= _ALARM_BITS.get(bit, ServoAlarm.OTHER)
        return flags

    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        speed = min(round(speed_ticks_s), 0x7FFF) if speed_ticks_s else 0
        # acceleration 0 (the servo's maximum), position, time (unused), speed
        return b"\0" + _signed(ticks, 15) + b"\0\0" + max(speed, 0).to_bytes(2, "little")

    def turns_bytes(self, many: bool) -> bytes:
        low, high = (0, 0) if many else (0, 4095)
        return low.to_bytes(2, "little") + high.to_bytes(2, "little")

    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        return ServoState(
            position_ticks=_value(data[0:2], 15),
            velocity_ticks_s=float(_value(data[2:4], 15)),
            load=_value(data[4:6], 10) / model.full_load,
            voltage_v=data[6] / 10.0,
            temperature_c=float(data[7]),
            moving=bool(data[10]),
            error_flags=alarms | self.alarm_flags(data[9]),
        )


def _checksum(body: bytes | bytearray) -> int:
    return ~sum(body) & 0xFF


def _signed(value: int, sign_bit: int) -> bytes:
    return (abs(value) | (value < 0) << sign_bit).to_bytes(2, "little")


def _value(data: bytes, sign_bit: int) -> int:
    raw = int.from_bytes(data, "little")
    magnitude = raw & ((1 << sign_bit) - 1)
    return -magnitude if raw >> sign_bit & 1 else magnitude
