"""Faults on the wire of the emulated bus, applied to replies before they are sent."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class WireFaults:
    """Replies to lose, damage, cut or delay; counts go down as replies are sent.

    Attributes:
        silent: servos that hear and move but answer nothing.
        drops, corrupt, cuts: how many of a servo's next replies are lost, have a damaged checksum,
            or are sent by half.
        delays_s: by how much a servo's replies are late, s.
        noise: bytes put on the line ahead of the next reply.
        echo: every instruction is sent back first, as adapters that hear themselves do.
    """

    silent: set[int] = field(default_factory=set)
    drops: Counter[int] = field(default_factory=Counter)
    corrupt: Counter[int] = field(default_factory=Counter)
    cuts: Counter[int] = field(default_factory=Counter)
    delays_s: dict[int, float] = field(default_factory=dict)
    noise: bytes = b""
    echo: bool = False

    def apply(self, servo_id: int, reply: bytes) -> tuple[float, bytes]:
        """Delay (s) and bytes that are sent for ``reply``."""
        if servo_id in self.silent or _take(self.drops, servo_id):
            return 0.0, b""
        if _take(self.corrupt, servo_id):
            reply = reply[:-1] + bytes((reply[-1] ^ 0x5A,))
        if _take(self.cuts, servo_id):
            reply = reply[: len(reply) // 2]
        noise, self.noise = self.noise, b""
        return self.delays_s.get(servo_id, 0.0), noise + reply


def _take(counts: Counter[int], servo_id: int) -> bool:
    if counts[servo_id] <= 0:
        return False
    counts[servo_id] -= 1
    return True
