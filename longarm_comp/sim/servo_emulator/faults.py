"""Faults on the wire of the emulated bus, applied to replies before they are sent."""

from __future__ import annotations

from collections import Counter


class WireFaults:
    """Replies to lose, damage, cut or delay. Counts go down as replies are sent."""

    def __init__(self) -> None:
        self.silent: set[int] = set()
        self.drops: Counter[int] = Counter()
        self.bad_checksums: Counter[int] = Counter()
        self.cuts: Counter[int] = Counter()
        self.delays_s: dict[int, float] = {}
        self.noise = b""
        self.echo = False
        """Send every instruction back first, as adapters that hear themselves do."""

    def silence(self, servo_id: int) -> None:
        """The servo hears and moves but answers nothing any more."""
        self.silent.add(servo_id)

    def speak(self, servo_id: int) -> None:
        """End of ``silence``."""
        self.silent.discard(servo_id)

    def drop(self, servo_id: int, count: int = 1) -> None:
        """Lose the next ``count`` replies."""
        self.drops[servo_id] += count

    def corrupt(self, servo_id: int, count: int = 1) -> None:
        """Damage the checksum of the next ``count`` replies."""
        self.bad_checksums[servo_id] += count

    def cut(self, servo_id: int, count: int = 1) -> None:
        """Send only the first half of the next ``count`` replies."""
        self.cuts[servo_id] += count

    def delay(self, servo_id: int, seconds: float) -> None:
        """Send this servo's replies late; 0 ends it."""
        self.delays_s[servo_id] = seconds

    def before_next(self, junk: bytes) -> None:
        """Put junk bytes on the line ahead of the next reply."""
        self.noise += junk

    def apply(self, servo_id: int, reply: bytes) -> tuple[float, bytes]:
        """Delay (s) and bytes that are sent for ``reply``."""
        if servo_id in self.silent or _take(self.drops, servo_id):
            return 0.0, b""
        if _take(self.bad_checksums, servo_id):
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
