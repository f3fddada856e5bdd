"""A servo's memory without power: registers that decide what a command means to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass


def decode_unsigned(data: bytes) -> int:
    return int.from_bytes(data, "little")


def decode_signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


def sign_magnitude(bit: int) -> Callable[[bytes], int]:
    """Return a decoder of numbers with their sign in a bit and their size in the bits below."""

    def value(data: bytes) -> int:
        raw = decode_unsigned(data)
        size = raw & ((1 << bit) - 1)
        return -size if raw >> bit & 1 else size

    return value


def one_bit(bit: int) -> Callable[[bytes], int]:
    return lambda data: decode_unsigned(data) >> bit & 1


@dataclass(frozen=True, slots=True)
class Register:
    """One value in a servo's memory, as a protocol describes it."""

    name: str  # the maker's; of a part of a register with the part behind it
    address: int
    length: int = 1
    value: Callable[[bytes], int] = decode_unsigned
    factory: int | None = None  # value from the factory; None: not the same in all models
    places: bool = False
    """Whether it decides what a position means. Then it must be as it was at the setup."""
    allowed: tuple[int, ...] = ()  # values with which goals mean what they say; none: any
    otherwise: str = ""  # what another value does


@dataclass(frozen=True, slots=True)
class ServoMemory:
    """The registers of one servo.

    Attributes:
        many_turns: whether it turns more than once; None: it follows no goal positions.
        goals: lowest and highest goal that it takes, by its own limits; None: any.
        speed_ticks_s: highest speed that it takes; None: any.
    """

    registers: tuple[Register, ...]
    values: Mapping[str, int]
    many_turns: bool | None
    goals: tuple[int, int] | None
    speed_ticks_s: float | None

    def describe_jump(self, ticks: float) -> str:
        """Say why a servo at ``ticks`` would jump when it is driven; empty where it would not."""
        if self.goals is None or self.goals[0] <= ticks <= self.goals[1]:
            return ""
        return (
            f"stands at {ticks:.0f}, beyond its own limits {self.goals[0]} to "
            f"{self.goals[1]}, and would move there: turn it back by hand ({self.changes})"
        )

    @property
    def placing(self) -> dict[str, int]:
        """Registers that decide what a position means and are not as from the factory."""
        return {
            r.name: self.values[r.name]
            for r in self.registers
            if r.places and self.values[r.name] != r.factory
        }

    @property
    def changes(self) -> str:
        """The registers that are not as from the factory, with addresses."""
        own = [r for r in self.registers if r.factory not in (None, self.values[r.name])]
        return ", ".join(map(self.describe, own)) or "its registers are as from the factory"

    @property
    def notable(self) -> str:
        """The registers that are not as from the factory or differ among models, with addresses."""
        own = [r for r in self.registers if self.values[r.name] != r.factory]
        return ", ".join(map(self.describe, own))

    def describe(self, register: Register) -> str:
        """Write a register's name, value and address."""
        return f"{register.name} = {self.values[register.name]} (register {register.address})"
