"""Interface of an emulated protocol: instruction frames in, status frames out, registers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from longarm_comp.sim.servo_emulator.motor import Motor

BROADCAST = 0xFE


class Device:
    """One servo on the wire: its memory and its mechanics."""

    def __init__(self, servo_id: int, memory: bytearray, motor: Motor) -> None:
        self.servo_id = servo_id
        self.memory = memory
        self.motor = motor
        self.pending: tuple[int, bytes] | None = None
        self.kept = bytes(memory)

    def put(self, address: int, length: int, value: int) -> None:
        """Store an unsigned little-endian value."""
        self.memory[address : address + length] = value.to_bytes(length, "little")

    def get(self, address: int, length: int) -> int:
        """An unsigned little-endian value."""
        return int.from_bytes(self.memory[address : address + length], "little")


class Wire(ABC):
    """One emulated protocol; stateless.

    Attributes:
        kept_below: registers below this address outlive a loss of power.
    """

    name: ClassVar[str]
    kept_below: ClassVar[int]

    @abstractmethod
    def device(self, servo_id: int, motor: Motor) -> Device:
        """A servo with this protocol's factory memory."""

    def power_cycle(self, device: Device) -> None:
        """State after a loss of power: kept registers, torque off, no alarm."""
        motor = device.motor
        fresh = self.device(device.servo_id, motor).memory
        device.memory[:] = device.kept[: self.kept_below] + fresh[self.kept_below :]
        device.pending = None
        motor.torque_on, motor.speed_limit, motor.goal = False, 0.0, motor.position
        motor.clear_alarms()

    def read(self, device: Device, address: int, length: int) -> bytes:
        """Registers as they are now."""
        return bytes(device.memory[address : address + length])

    @abstractmethod
    def take(self, buffer: bytearray) -> list[bytes]:
        """Remove whole, undamaged instruction frames from the front of ``buffer``."""

    @abstractmethod
    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        """Carry out one instruction; the replies, in the order in which they go out."""
