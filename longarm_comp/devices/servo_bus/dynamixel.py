"""Dynamixel protocol 2.0: ``FF FF FD 00 id length instruction params... crc``, byte-stuffed.

Numbers are in two's complement, low byte first.  The CRC-16 has the polynomial 0x8005 and the
initial value 0, and is not reflected.  Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0" and the
control tables of the X series.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from longarm_comp.devices.servo_bus.dialect import BROADCAST, Block, Dialect, Reply, limit_units
from longarm_comp.devices.servo_bus.memory import Register, decode_signed, one_bit
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

_HEADER = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_SYNC_READ, _SYNC_WRITE, _STATUS = 0x82, 0x83, 0x55
_LONGEST = 1024  # largest length field of a frame, bytes: a larger one is damaged
_ALERT = 0x80
_VELOCITY_TICKS_S = 0.229 / 60.0 * 4096
"""One unit of velocity, 0.229 turns a minute, in ticks/s."""


def _x_model(
    name: str, number: int, full_load: float, top_rpm: float, friction: float | None = None
) -> ServoModel:
    turns, top = ((0, 4095), (-1048575, 1048575)), top_rpm / 60.0 * 4096
    return ServoModel(name, "dynamixel", number, 4096, *turns, full_load, friction, top)


def _divide_by_crc(crc: int) -> int:
    """Return the CRC after eight more zero bits."""
    for _ in range(8):
        crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


_CRC_TABLE = tuple(_divide_by_crc(byte << 8) for byte in range(256))


class DynamixelX(Dialect):
    """X series (XL330, XL430, XM430, XM540) with their common control table."""

    name = "dynamixel"
    models = (
        _x_model("xl330-m077", 1190, 1750.0, 456.0),  # present current, 1 mA a unit
        _x_model("xl330-m288", 1200, 1750.0, 123.0),
        _x_model("xl430-w250", 1060, 1000.0, 61.0),  # present load, 0.1 % a unit
        _x_model("xm430-w350", 1020, 1193.0, 57.0, 0.13 / 3.21),  # present current, 2.69 mA a unit
        _x_model("xm540-w270", 1120, 2047.0, 37.0),
    )
    header = _HEADER
    overhead = 11
    alarm_bits: ClassVar = {
        0: ServoAlarm.VOLTAGE,
        2: ServoAlarm.OVERHEAT,
        3: ServoAlarm.SENSOR,
        4: ServoAlarm.CURRENT,
        5: ServoAlarm.OVERLOAD,
    }
    model = Block(0, 2)
    firmware = Block(6, 1)
    baudrates = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000)
    identity = Block(7, 1)
    turns = Block(11, 1)
    torque = Block(64, 1)
    alarm = Block(70, 1)
    goal = Block(108, 12)
    goal_position = Block(116, 4)
    state = Block(122, 25)
    registers = (
        Register("drive_mode_reverse", 10, value=one_bit(0), factory=0, places=True),
        Register(
            "drive_mode_time_based",
            10,
            value=one_bit(2),
            factory=0,
            allowed=(0,),
            otherwise="a velocity would be taken for a time in ms",
        ),
        Register(
            "operating_mode",
            11,
            factory=3,
            allowed=(3, 4),
            otherwise="it does not go to positions, or not with its full current",
        ),
        Register("homing_offset", 20, 4, decode_signed, factory=0, places=True),
        Register("pwm_limit", 36, 2, factory=885),
        Register("current_limit", 38, 2),
        Register("velocity_limit", 44, 4),
        Register("max_position_limit", 48, 4, decode_signed, factory=4095),
        Register("min_position_limit", 52, 4, decode_signed, factory=0),
    )
    goal_limits = ("min_position_limit", "max_position_limit")
    speed_limit = ("velocity_limit", _VELOCITY_TICKS_S)

    def encode(self, servo_id: int, instruction: int, params: bytes = b"") -> bytes:
        body = (bytes((instruction,)) + params).replace(_PLAIN, _STUFFED)
        frame = _HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
        return frame + _compute_crc(frame).to_bytes(2, "little")

    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        return self.encode(BROADCAST, _SYNC_READ, _encode_block(block) + bytes(ids))

    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        params = b"".join(bytes((servo_id,)) + value for servo_id, value in values.items())
        return self.encode(BROADCAST, _SYNC_WRITE, _encode_block(block) + params)

    def frame_length(self, start: bytearray) -> int:
        servo_id, length, kind = start[4], start[5] | start[6] << 8, start[7]
        known = kind == _STATUS and servo_id < BROADCAST and 4 <= length <= _LONGEST
        return length + 7 if known else 0

    def reply(self, frame: bytes) -> Reply:
        body = frame[8:-2].replace(_STUFFED, _PLAIN)
        intact = _compute_crc(frame[:-2]) == int.from_bytes(frame[-2:], "little")
        return Reply(frame[4], body[0], body[1:], intact)

    def refusal(self, error: int) -> int:
        return error & ~_ALERT

    def alarms(self, error: int) -> ServoAlarm | None:
        return None if error & _ALERT else ServoAlarm.NONE

    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        # profile acceleration 0 (none), profile velocity, goal position
        speed = limit_units(speed_ticks_s, _VELOCITY_TICKS_S, 32767)
        return bytes(4) + speed.to_bytes(4, "little") + ticks.to_bytes(4, "little", signed=True)

    def ticks_of(self, position: bytes) -> int:
        return decode_signed(position)

    def turns_bytes(self, many: bool) -> bytes:
        return b"\x04" if many else b"\x03"

    def turn_at_power_on(self, model: ServoModel, stored: Mapping[str, int]) -> tuple[int, int]:
        low, high = super().turn_at_power_on(model, stored)
        shift = stored.get("homing_offset", 0)
        if stored.get("drive_mode_reverse"):  # not documented: it may count down from 0
            high = low
        return low + shift, high + shift

    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        return ServoState(
            position_ticks=self.ticks_of(data[10:14]),
            velocity_ticks_s=decode_signed(data[6:10]) * _VELOCITY_TICKS_S,
            load=decode_signed(data[4:6]) / model.full_load,
            voltage_v=decode_signed(data[22:24]) / 10.0,
            temperature_c=float(data[24]),
            error_flags=alarms,
        )


def _compute_crc(frame: bytes) -> int:
    crc = 0
    for byte in frame:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def _encode_block(block: Block) -> bytes:
    return block.address.to_bytes(2, "little") + block.length.to_bytes(2, "little")
