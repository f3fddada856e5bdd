"""Dynamixel protocol 2.0: ``FF FF FD 00 id length instruction params... crc``, byte-stuffed.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0" and the control tables of the X series; two's
complement, low byte first; CRC-16 with polynomial 0x8005, initial value 0, not reflected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from longarm_comp.devices.servo_bus.dialect import Block, Dialect, Reply
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

_HEADER = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_BROADCAST = 0xFE
_SYNC_READ, _SYNC_WRITE, _STATUS = 0x82, 0x83, 0x55
_LONGEST = 1024
_ALERT = 0x80
_VELOCITY_TICKS_S = 0.229 / 60.0 * 4096
"""One unit of velocity is 0.229 turns a minute."""
_ALARM_BITS = {
    0: ServoAlarm.VOLTAGE,
    2: ServoAlarm.OVERHEAT,
    3: ServoAlarm.SENSOR,
    4: ServoAlarm.CURRENT,
    5: ServoAlarm.OVERLOAD,
}


def _x(name: str, number: int, full_load: float, friction: float | None = None) -> ServoModel:
    turns = (0, 4095), (-1048575, 1048575)
    return ServoModel(name, "dynamixel", number, 4096, *turns, full_load, friction)


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_CRC_TABLE = _crc_table()


class DynamixelX(Dialect):
    """X series (XL330, XL430, XM430, XM540) with their common control table."""

    name = "dynamixel"
    models = (
        _x("xl330-m077", 1190, 1750.0),  # present current, 1 mA a unit
        _x("xl330-m288", 1200, 1750.0),
        _x("xl430-w250", 1060, 1000.0),  # present load, 0.1 % a unit
        _x("xm430-w350", 1020, 1193.0, 0.13 / 3.21),  # present current, 2.69 mA a unit
        _x("xm540-w270", 1120, 2047.0),
    )
    overhead = 11
    model = Block(0, 2)
    firmware = Block(6, 1)
    baudrates = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000)
    identity = Block(7, 1)
    turns = Block(11, 1)
    turns_lock = None
    torque = Block(64, 1)
    alarm = Block(70, 1)
    goal = Block(108, 12)
    state = Block(122, 25)

    def encode(self, servo_id: int, instruction: int, params: bytes = b"") -> bytes:
        """The instruction frame."""
        body = (bytes((instruction,)) + params).replace(_PLAIN, _STUFFED)
        frame = _HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
        return frame + _crc(frame).to_bytes(2, "little")

    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        return self.encode(_BROADCAST, _SYNC_READ, _range(block) + bytes(ids))

    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        params = b"".join(bytes((servo_id,)) + value for servo_id, value in values.items())
        return self.encode(_BROADCAST, _SYNC_WRITE, _range(block) + params)

    def decode(self, buffer: bytearray, final: bool) -> list[Reply]:
        replies: list[Reply] = []
        while (start := buffer.find(_HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < self.overhead:
                break
            servo_id, length, kind = buffer[4], buffer[5] | buffer[6] << 8, buffer[7]
            if kind != _STATUS or servo_id >= _BROADCAST or not 4 <= length <= _LONGEST:
                del buffer[0]
                continue
            end = length + 7
            if len(buffer) < end and not final:
                return replies
            crc = int.from_bytes(buffer[end - 2 : end], "little")
            if len(buffer) >= end and _crc(buffer[: end - 2]) == crc:
                body = bytes(buffer[8 : end - 2]).replace(_STUFFED, _PLAIN)
                replies.append(Reply(servo_id, body[0], body[1:]))
                del buffer[:end]
            else:
                # The length itself may be what is damaged, so only the header is given up.
                replies.append(Reply(servo_id, 0, b"", intact=False))
                del buffer[:4]
        return replies

    def refusal(self, error: int) -> int:
        return error & ~_ALERT

    def alarms(self, error: int) -> ServoAlarm | None:
        return None if error & _ALERT else ServoAlarm.NONE

    def alarm_flags(self, value: int) -> ServoAlarm:
        flags = ServoAlarm.NONE
        for bit in range(8):
            if value >> bit & 1:
                flags |= _ALARM_BITS.get(bit, ServoAlarm.OTHER)
        return flags

    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        # profile acceleration 0 (none), profile velocity, goal position
        speed = max(1, min(round(speed_ticks_s / _VELOCITY_TICKS_S), 32767)) if speed_ticks_s else 0
        return bytes(4) + speed.to_bytes(4, "little") + ticks.to_bytes(4, "little", signed=True)

    def turns_bytes(self, many: bool) -> bytes:
        return b"\x04" if many else b"\x03"

    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        return ServoState(
            position_ticks=_value(data[10:14]),
            velocity_ticks_s=_value(data[6:10]) * _VELOCITY_TICKS_S,
            load=_value(data[4:6]) / model.full_load,
            voltage_v=_value(data[22:24]) / 10.0,
            temperature_c=float(data[24]),
            moving=bool(data[0]),
            error_flags=alarms,
        )


def _crc(frame: bytes | bytearray) -> int:
    crc = 0
    for byte in frame:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def _range(block: Block) -> bytes:
    return block.address.to_bytes(2, "little") + block.length.to_bytes(2, "little")


def _value(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)
