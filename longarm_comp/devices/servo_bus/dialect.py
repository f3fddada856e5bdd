"""Interface of a wire protocol: frames, registers and units as bytes, without a port.

This package makes its own frames because the vendors' libraries have these faults.  Both poll the
port until a time-out of 34-50 ms on the wall clock, and stay "busy" for ever after an exception
from an unplugged port.  dynamixel-sdk gives up a sync read at the first silent servo and drops the
status byte of the others.  scservo_sdk never empties the input, so that it takes a late answer for
the next one.  The tests use the libraries as an independent reference for every byte.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.devices.servo_bus.memory import Register, ServoMemory
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState

BROADCAST = 0xFE  # id that addresses all servos, the same for Dynamixel and Feetech


@dataclass(frozen=True, slots=True)
class Reply:
    """A received status frame. ``intact`` is False if its checksum is wrong."""

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
    """Return a limit in whole units of a register in which 0 means no limit.

    A ``limit`` above 0 becomes 1 to ``most``; 0 or less becomes 0.
    """
    return min(max(round(limit / unit), 1), most) if limit > 0.0 else 0


class Dialect(ABC):
    """Encoding and decoding of one protocol; stateless."""

    name: ClassVar[str]  # as written in the configuration
    models: ClassVar[tuple[ServoModel, ...]]  # the servos that speak it
    header: ClassVar[bytes]  # bytes that every status frame begins with
    overhead: ClassVar[int]  # bytes of a status frame besides its data
    alarm_bits: ClassVar[Mapping[int, ServoAlarm]]
    """Alarm by bit number of the servo's alarm byte; any other bit means OTHER."""
    model: ClassVar[Block]  # the servo's model number
    firmware: ClassVar[Block]  # the version of the servo's firmware
    baudrates: ClassVar[tuple[int, ...]]
    """Usual rates of servos of this protocol, bit/s; the factory setting first."""
    state: ClassVar[Block]  # everything a ``ServoState`` needs, in one read
    goal: ClassVar[Block]  # goal position with its speed
    goal_position: ClassVar[Block]  # goal position alone, within ``goal``
    torque: ClassVar[Block]  # one byte, 0 free, 1 driven
    turns: ClassVar[Block]
    """Registers that decide between one turn and many; the servo keeps them without power."""
    turns_lock: ClassVar[Block | None] = None
    """Write 0 here before and 1 after changing ``turns`` or ``identity``; None: no lock."""
    identity: ClassVar[Block | None] = None  # the id itself; None: it is set with the maker's tool
    alarm: ClassVar[Block | None] = None
    """Register of the alarms, if the status byte only tells that there is one."""
    registers: ClassVar[tuple[Register, ...]] = ()
    """Registers that a servo keeps without power and that decide the meaning of goals; or none."""
    goal_limits: ClassVar[tuple[str, str] | None] = None
    """Names of the registers of the lowest and the highest goal within one turn."""
    speed_limit: ClassVar[tuple[str, float] | None] = None
    """Name of the register of the highest speed, and the size of its unit, ticks/s."""

    def decode(self, buffer: bytearray, final: bool) -> list[Reply]:
        """Remove all status frames from the front of ``buffer`` and return them.

        Only the first byte of a damaged frame is removed, because its length may be wrong.

        Args:
            final: whether no more bytes will come, so that an incomplete frame is a damaged one.
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
        """Return the length of the status frame that begins with ``start``; 0 if it is none.

        ``start`` has at least ``overhead`` bytes.
        """

    @abstractmethod
    def reply(self, frame: bytes) -> Reply:
        """Decode a status frame; ``intact`` is False if its checksum is wrong."""

    @abstractmethod
    def sync_read(self, ids: Sequence[int], block: Block) -> bytes:
        """Make the frame that asks all ids for ``block``; the servos answer one after the other."""

    @abstractmethod
    def sync_write(self, block: Block, values: Mapping[int, bytes]) -> bytes:
        """Make the frame that writes ``block`` of all ids at once; no servo answers."""

    def refusal(self, error: int) -> int:
        """Return the refusal code in a status byte; 0 if the instruction was not refused."""
        return 0

    def alarms(self, error: int) -> ServoAlarm | None:
        """Return the alarms in a status byte; None: it flags one, and ``alarm`` must be read."""
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
        """Return the bytes of the block ``goal``; speed 0 means the servo's own maximum."""

    def goal_position_bytes(self, ticks: int) -> bytes:
        """Return the bytes of the block ``goal_position``."""
        start = self.goal_position.address - self.goal.address
        return self.goal_bytes(ticks, 0.0)[start : start + self.goal_position.length]

    @abstractmethod
    def ticks_of(self, position: bytes) -> int:
        """Decode a position or a goal position, ticks."""

    @abstractmethod
    def turns_bytes(self, many: bool) -> bytes:
        """Return the bytes of the block ``turns`` for many turns, or for one."""

    def turn_at_power_on(self, model: ServoModel, stored: Mapping[str, int]) -> tuple[int, int]:
        """Return the lowest and highest position that a servo for many turns reads at power-on.

        Where it is not known by how much an offset or a reversal shifts this turn, the range has
        only what the servo reads there in any case. Otherwise a zero could be a turn off and nobody
        would notice.

        Args:
            stored: registers that decide positions, by name; all others are as from the factory.
        """
        low = model.single_turn[0]
        return low, low + model.ticks_per_turn - 1

    def model_name(self, number: int) -> str:
        """Return the name of the model with this number; empty if unknown."""
        return next((model.name for model in self.models if model.model_number == number), "")

    def turns_of(self, data: bytes) -> bool | None:
        """Tell whether the bytes of ``turns`` mean many turns; None if they mean another mode."""
        return {self.turns_bytes(True): True, self.turns_bytes(False): False}.get(data)

    def turns_said(self, data: bytes) -> str:
        """Return the registers of ``turns`` with their values, in words."""
        first, end = self.turns.address, self.turns.address + self.turns.length
        said = [
            f"{r.name} = {r.value(data[r.address - first :][: r.length])}"
            for r in self.registers
            if first <= r.address < end
        ]
        return ", ".join(said) or data.hex()

    @property
    def memory(self) -> Block:
        """The smallest block that holds all registers and ``turns``."""
        blocks = [*(Block(r.address, r.length) for r in self.registers), self.turns]
        start = min(block.address for block in blocks)
        return Block(start, max(block.address + block.length for block in blocks) - start)

    def memory_of(self, data: bytes) -> ServoMemory:
        """Decode the bytes of the block ``memory``."""
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
        """Decode the bytes of the block ``state``."""
