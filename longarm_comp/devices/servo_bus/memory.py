"""The registers that a servo keeps without power and that decide what a command means to it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass


def decode_unsigned(data: bytes) -> int:
    return int.from_bytes(data, "little")


def decode_signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


def sign_magnitude(bit: int) -> Callable[[bytes], int]:
    """Return a decoder of numbers whose sign is bit ``bit`` and whose size is in the bits below."""

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

    name: str  # the maker's name; for a part of a register, followed by the part
    address: int
    length: int = 1
    value: Callable[[bytes], int] = decode_unsigned
    factory: int | None = None  # value from the factory; None: not the same in all models
    places: bool = False
    """Whether it decides what a position means. If so, it must not change after the setup."""
    allowed: tuple[int, ...] = ()  # values with which goals are understood correctly; empty: any
    otherwise: str = ""  # the effect of another value, in words


@dataclass(frozen=True, slots=True)
class ServoMemory:
    """The registers of one servo.

    Attributes:
        values: value of each register, by name.
        many_turns: whether it may turn more than once; None: it follows no goal positions.
        goals: lowest and highest goal that its own limits allow, ticks; None: any.
        speed_ticks_s: highest speed that it accepts, ticks/s; None: any.
    """

    registers: tuple[Register, ...]
    values: Mapping[str, int]
    many_turns: bool | None
    goals: tuple[int, int] | None
    speed_ticks_s: float | None

    def describe_jump(self, ticks: float) -> str:
        """Say why a servo at ``ticks`` would jump when its torque goes on; empty if it does not."""
        if self.goals is None or self.goals[0] <= ticks <= self.goals[1]:
            return ""
        return (
            f"stands at {ticks:.0f}, beyond its own limits {self.goals[0]} to "
            f"{self.goals[1]}, and would move there: turn it back by hand ({self.changes})"
        )

    @property
    def placing(self) -> dict[str, int]:
        """Values, by name, of registers that decide positions and are not as from the factory."""
        return {
            r.name: self.values[r.name]
            for r in self.registers
            if r.places and self.values[r.name] != r.factory
        }

    @property
    def changes(self) -> str:
        """The registers that are not as from the factory, in words, with addresses."""
        own = [r for r in self.registers if r.factory not in (None, self.values[r.name])]
        return ", ".join(map(self.describe, own)) or "its registers are as from the factory"

    @property
    def notable(self) -> str:
        """The registers that are not as from the factory or differ among models, with addresses."""
        own = [r for r in self.registers if self.values[r.name] != r.factory]
        return ", ".join(map(self.describe, own))

    def describe(self, register: Register) -> str:
        """Return a register's name, value and address, in words."""
        return f"{register.name} = {self.values[register.name]} (register {register.address})"
