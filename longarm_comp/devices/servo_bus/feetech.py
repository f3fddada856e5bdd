"""Feetech STS/SMS serial protocol: ``FF FF id length instruction params... ~sum``.

Signed values have a sign bit and a magnitude, low byte first.  Source: Feetech, "SMS/STS series
memory table" and "Communication protocol manual".
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from longarm_comp.devices.servo_bus.dialect import BROADCAST, Block, Dialect, Reply, limit_units
from longarm_comp.devices.servo_bus.memory import Register, one_bit, sign_magnitude
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

_HEADER = b"\xff\xff"
_SYNC_READ, _SYNC_WRITE = 0x82, 0x83
_position, _load = sign_magnitude(15), sign_magnitude(10)
_LONGEST = 250  # largest length field of a frame, bytes: a larger one is damaged


def _sts_model(name: str, number: int, top_rpm: float, friction: float | None = None) -> ServoModel:
    turns, top = ((0, 4095), (-30719, 30719)), top_rpm / 60.0 * 4096
    return ServoModel(name, "feetech", number, 4096, *turns, 1000.0, friction, top)


class FeetechSts(Dialect):
    """STS3215 and its family."""

    name = "feetech"
    models = (_sts_model("sts3215", 777, 50.0, 0.18 / 2.7), _sts_model("sts3250", 2825, 79.0))
    header = _HEADER
    overhead = 6
    alarm_bits: ClassVar = {
        0: ServoAlarm.VOLTAGE,
        1: ServoAlarm.SENSOR,
        2: ServoAlarm.OVERHEAT,
        3: ServoAlarm.CURRENT,
        5: ServoAlarm.OVERLOAD,
    }
    model = Block(3, 2)
    firmware = Block(0, 2)
    baudrates = (1_000_000, 500_000, 115_200, 57_600, 38_400)
    identity = Block(5, 1)
    turns = Block(9, 4)
    torque = Block(40, 1)
    goal = Block(41, 7)
    goal_position = Block(42, 2)
    turns_lock = Block(55, 1)
    state = Block(56, 11)
    registers = (
        Register("min_angle_limit", 9, 2, factory=0),
        Register("max_angle_limit", 11, 2, factory=4095),
        Register("max_torque_limit", 16, 2, factory=1000),
        Register("phase", 18),
        Register("phase_position_reversed", 18, value=one_bit(7), factory=0, places=True),
        Register("protection_current", 28, 2),
        Register(
            "angular_resolution",
            30,
            factory=1,
            allowed=(1,),
            otherwise="a tick would be another angle",
        ),
        Register("homing_offset", 31, 2, sign_magnitude(11), factory=0, places=True),
        Register(
            "operating_mode",
            33,
            factory=0,
            allowed=(0,),
            otherwise="a goal would be a speed, an effort or a number of steps",
        ),
    )
    goal_limits = ("min_angle_limit", "max_angle_limit")

    def encode(self, servo_id: int, instruction: int, params: bytes = b"") -> bytes:
        body = bytes((servo_id, len(params) + 2, instruction)) + params
        return _HEADER + body + bytes((_compute_checksum(body),))

    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        return self.encode(BROADCAST, _SYNC_READ, bytes((block.address, block.length)) + bytes(ids))

    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        params = b"".join(bytes((servo_id,)) + value for servo_id, value in values.items())
        return self.encode(BROADCAST, _SYNC_WRITE, bytes((block.address, block.length)) + params)

    def frame_length(self, start: bytearray) -> int:
        servo_id, length = start[2], start[3]
        return length + 4 if servo_id < BROADCAST and 2 <= length <= _LONGEST else 0

    def reply(self, frame: bytes) -> Reply:
        return Reply(frame[2], frame[4], frame[5:-1], _compute_checksum(frame[2:-1]) == frame[-1])

    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        speed = limit_units(speed_ticks_s, 1.0, 0x7FFF)
        # acceleration 0 (the servo's maximum), position, time (unused), speed
        goal = abs(ticks) | (ticks < 0) << 15
        return b"\0" + goal.to_bytes(2, "little") + b"\0\0" + speed.to_bytes(2, "little")

    def ticks_of(self, position: bytes) -> int:
        return _position(position)

    def turns_bytes(self, many: bool) -> bytes:
        low, high = (0, 0) if many else (0, 4095)
        return low.to_bytes(2, "little") + high.to_bytes(2, "little")

    def turns_of(self, data: bytes) -> bool:
        return data == self.turns_bytes(True)  # otherwise the bytes are the limits of one turn

    def turn_at_power_on(self, model: ServoModel, stored: Mapping[str, int]) -> tuple[int, int]:
        low, high = super().turn_at_power_on(model, stored)
        if stored.get("phase_position_reversed"):  # not documented: it may count down from 0
            return low, low
        # Nor is whether an offset shifts the turn: only what both turns have is sure
        shift = -stored.get("homing_offset", 0)
        return max(low, low + shift), min(high, high + shift)

    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        return ServoState(
            position_ticks=self.ticks_of(data[0:2]),
            velocity_ticks_s=float(_position(data[2:4])),
            load=_load(data[4:6]) / model.full_load,
            voltage_v=data[6] / 10.0,
            temperature_c=float(data[7]),
            error_flags=alarms | self.alarm_flags(data[9]),
        )


def _compute_checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF
