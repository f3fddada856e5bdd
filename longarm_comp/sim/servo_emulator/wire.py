"""Interface of an emulated protocol: instruction frames in, status frames out, registers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from enum import IntEnum
from typing import ClassVar

from longarm_comp.sim.servo_emulator.motor import Motor


class Told(IntEnum):
    """Instructions of Dynamixel and of Feetech."""

    PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83


class Device:
    """One servo on the wire: its memory and its mechanics."""

    def __init__(self, servo_id: int, memory: bytearray, motor: Motor) -> None:
        self.servo_id = servo_id
        self.memory = memory
        self.motor = motor
        self.kept = bytes(memory)

    def put(self, address: int, length: int, value: int) -> None:
        """Store an unsigned little-endian value."""
        self.memory[address : address + length] = value.to_bytes(length, "little")

    def get(self, address: int, length: int) -> int:
        """Return an unsigned little-endian value."""
        return int.from_bytes(self.memory[address : address + length], "little")


class Wire(ABC):
    """One emulated protocol; stateless."""

    name: ClassVar[str]  # the protocol's
    kept_below: ClassVar[int]  # registers below this address outlive a loss of power
    ticks_per_turn: ClassVar[float] = 4096.0  # of its servos

    @abstractmethod
    def device(self, servo_id: int, motor: Motor) -> Device:
        """Return a servo with this protocol's factory memory."""

    def power_cycle(self, device: Device) -> None:
        """Take a servo's power away and give it back.

        Kept registers stay, torque is off, and alarms are cleared as by `Motor.clear_alarms`.
        """
        motor = device.motor
        fresh = self.device(device.servo_id, motor).memory
        device.memory[:] = device.kept[: self.kept_below] + fresh[self.kept_below :]
        motor.torque_on, motor.speed_limit, motor.goal = False, 0.0, motor.position
        motor.clear_alarms()

    @abstractmethod
    def take(self, buffer: bytearray) -> list[bytes]:
        """Remove all whole instruction frames from ``buffer``; return those without damage."""

    @abstractmethod
    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        """Carry out one instruction; return the replies in the order in which they go out."""


class RegisterWire(Wire):
    """A protocol with the instructions of Dynamixel."""

    word: ClassVar[int]  # bytes of an address, and of a length

    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        target, instruction, params = self.parts(frame)
        if instruction in (Told.SYNC_READ, Told.SYNC_WRITE):
            address, length = self.words(params)
            rest = params[2 * self.word :]
            if instruction == Told.SYNC_READ:
                asked = [devices[i] for i in rest if i in devices]
                return [self.status(d, *self.read(d, address, length)) for d in asked]
            for start in range(0, len(rest) - length, length + 1):
                if rest[start] in devices:
                    data = rest[start + 1 : start + 1 + length]
                    self.write(devices[rest[start]], address, data)
            return []
        hearing = [devices[target]] if target in devices else []
        return [self.status(d, *self.carry_out(d, instruction, params)) for d in hearing]

    def carry_out(self, device: Device, instruction: int, params: bytes) -> tuple[int, bytes]:
        """Carry out an instruction to one servo; return error code and data of its answer."""
        if instruction == Told.READ:
            return self.read(device, *self.words(params))
        if instruction == Told.WRITE:
            address = int.from_bytes(params[: self.word], "little")
            return self.write(device, address, params[self.word :]), b""
        return 0, b""

    def words(self, params: bytes) -> tuple[int, int]:
        """Return the address and the length that parameters begin with; IndexError if missing."""
        if len(params) < 2 * self.word:
            raise IndexError
        first, second = params[: self.word], params[self.word : 2 * self.word]
        return int.from_bytes(first, "little"), int.from_bytes(second, "little")

    @abstractmethod
    def parts(self, frame: bytes) -> tuple[int, int, bytes]:
        """Return id, instruction and parameters of a frame."""

    @abstractmethod
    def read(self, device: Device, address: int, length: int) -> tuple[int, bytes]:
        """Return the error code (0: done) and the present content of registers."""

    @abstractmethod
    def write(self, device: Device, address: int, data: bytes) -> int:
        """Write registers; return the error code (0: done)."""

    @abstractmethod
    def status(self, device: Device, error: int, data: bytes) -> tuple[int, bytes]:
        """Return the id and the status frame of an answer."""
