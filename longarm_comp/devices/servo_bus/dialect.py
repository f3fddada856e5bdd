"""Interface of a wire protocol: frames, registers and units as bytes, without a port.

The frames are our own for these faults of the vendors' libraries: both poll the port until a
time-out of 34-50 ms on the wall clock, give up a sync read at the first silent servo and drop the
status byte of the others (dynamixel-sdk), never empty the input so that a late answer is taken for
the next one (scservo_sdk), and stay "busy" for ever after an exception from an unplugged port.
The tests use them as an independent reference for every byte.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.devices.servo_bus.memory import Register, ServoMemory
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

BROADCAST = 0xFE  # id of all servos, which Feetech has taken over from Dynamixel


@dataclass(frozen=True, slots=True)
class Reply:
    """A received status frame; ``intact`` is False when its checksum failed."""

    servo_id: int
    error: int
    data: bytes
    intact: bool = True


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive registers that are read or written together."""

    address: int
    length: int


def limit_units(limit: float, unit: float, most: int) -> int:
    """Return a limit in whole units of its register, where 0 means none: 0 only for none."""
    return min(max(round(limit / unit), 1), most) if limit > 0.0 else 0


class Dialect(ABC):
    """Encoding and decoding of one protocol; stateless."""

    name: ClassVar[str]  # as written in the configuration
    models: ClassVar[tuple[ServoModel, ...]]  # the servos that speak it
    header: ClassVar[bytes]  # bytes that every status frame begins with
    overhead: ClassVar[int]  # bytes of a status frame besides its data
    alarm_bits: ClassVar[Mapping[int, ServoAlarm]]
    """Alarm of each bit of the servo's alarm byte; any other bit is OTHER."""
    model: ClassVar[Block]  # the servo's model number
    firmware: ClassVar[Block]  # its version
    baudrates: ClassVar[tuple[int, ...]]
    """Rates that servos of this protocol are used at, the factory's first."""
    state: ClassVar[Block]  # everything a ``ServoState`` needs, in one read
    goal: ClassVar[Block]  # goal position with its speed
    goal_position: ClassVar[Block]  # goal position alone, within ``goal``
    torque: ClassVar[Block]  # one byte, 0 free, 1 driven
    turns: ClassVar[Block]
    """What decides between one turn and many, kept by the servo when unpowered."""
    turns_lock: ClassVar[Block | None] = None
    """Write 0 here before and 1 after changing ``turns`` or ``identity``; None: no lock."""
    identity: ClassVar[Block | None] = None  # the id itself; None: it is set with the maker's tool
    alarm: ClassVar[Block | None] = None
    """Register of the alarms, for when the status byte only flags that there is one."""
    registers: ClassVar[tuple[Register, ...]] = ()
    """What servos keep without power and what decides the meaning of goals; none: nothing does."""
    goal_limits: ClassVar[tuple[str, str] | None] = None
    """Registers of the lowest and the highest goal within one turn, by name."""
    speed_limit: ClassVar[tuple[str, float] | None] = None
    """Register of the highest speed, by name, and ticks a second of its unit."""

    def decode(self, buffer: bytearray, final: bool) -> list[Reply]:
        """Take every status frame off the front of ``buffer``; ``final``: no more bytes come.

        Of a damaged frame only the first byte is taken: its length may be what is damaged.
        """
        replies: list[Reply] = []
        while (start := buffer.find(self.header)) >= 0:
            del buffer[:start]
            if len(buffer) < self.overhead:
                break
            end = self.frame_length(buffer)
            if end and len(buffer) < end and not final:
                break
            intact = False
            if end:
                reply = self.reply(bytes(buffer[:end]))
                intact = reply.intact and len(buffer) >= end
                replies.append(reply if intact else Reply(reply.servo_id, 0, b"", intact=False))
            del buffer[: end if intact else 1]
        return replies

    @abstractmethod
    def frame_length(self, start: bytearray) -> int:
        """Return the length of the status frame at ``start`` (``overhead`` or more); 0: none."""

    @abstractmethod
    def reply(self, frame: bytes) -> Reply:
        """Decode a status frame; it is not intact where its checksum is wrong."""

    @abstractmethod
    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        """Make the frame that asks every id for ``block``; each answers in turn."""

    @abstractmethod
    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        """Make the frame that writes ``block`` of every id at once; nobody answers."""

    def refusal(self, error: int) -> int:
        """Return the refusal code in a status byte; 0 if the instruction was not refused."""
        return 0

    def alarms(self, error: int) -> ServoAlarm | None:
        """Return the alarms in a status byte; None: there are some, and ``alarm`` must be read."""
        return self.alarm_flags(error)

    def alarm_flags(self, value: int) -> ServoAlarm:
        """Convert the servo's alarm bits to ``ServoAlarm``."""
        flags = ServoAlarm.NONE
        for bit in range(8):
            if value >> bit & 1:
                flags |= self.alarm_bits.get(bit, ServoAlarm.OTHER)
        return flags

    @abstractmethod
    def goal_bytes(self, ticks: int, speed_ticks_s: float) -> bytes:
        """Make the contents of ``goal``; speed 0 is the servo's own maximum (`limit_units`)."""

    def goal_position_bytes(self, ticks: int) -> bytes:
        """Make the contents of ``goal_position``."""
        start = self.goal_position.address - self.goal.address
        return self.goal_bytes(ticks, 0.0)[start : start + self.goal_position.length]

    @abstractmethod
    def ticks_of(self, position: bytes) -> int:
        """Decode a position or a goal position."""

    @abstractmethod
    def turns_bytes(self, many: bool) -> bytes:
        """Make the contents of ``turns`` for one turn or many."""

    def model_name(self, number: int) -> str:
        """Name of the model with a number; empty where it is unknown."""
        return next((model.name for model in self.models if model.model_number == number), "")

    def turns_of(self, data: bytes) -> bool | None:
        """Return whether the bytes mean many turns; None where they mean another mode."""
        return {self.turns_bytes(True): True, self.turns_bytes(False): False}.get(data)

    def turns_said(self, data: bytes) -> str:
        """Name the registers of ``turns`` with their values."""
        first, end = self.turns.address, self.turns.address + self.turns.length
        said = [
            f"{r.name} = {r.value(data[r.address - first :][: r.length])}"
            for r in self.registers
            if first <= r.address < end
        ]
        return ", ".join(said) or data.hex()

    @property
    def memory(self) -> Block:
        """The block that holds every register and ``turns``."""
        blocks = [*(Block(r.address, r.length) for r in self.registers), self.turns]
        start = min(block.address for block in blocks)
        return Block(start, max(block.address + block.length for block in blocks) - start)

    def memory_of(self, data: bytes) -> ServoMemory:
        """Decode the contents of ``memory``."""
        start = self.memory.address

        def cut(address: int, length: int) -> bytes:
            return data[address - start : address - start + length]

        values = {r.name: r.value(cut(r.address, r.length)) for r in self.registers}
        many = self.turns_of(cut(self.turns.address, self.turns.length))
        goals = speed = None
        if self.goal_limits is not None and many is False:
            goals = values[self.goal_limits[0]], values[self.goal_limits[1]]
        if self.speed_limit is not None:
            speed = values[self.speed_limit[0]] * self.speed_limit[1]
        return ServoMemory(self.registers, values, many, goals, speed)

    @abstractmethod
    def state_of(self, data: bytes, alarms: ServoAlarm, model: ServoModel) -> ServoState:
        """Decode the contents of ``state``."""
