"""An emulated bus with the faults of lines and adapters, and two servos of one id."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from longarm_comp.sim.servo_emulator.emulator import ServoEmulator, WireFaults
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from longarm_comp.sim.servo_emulator.wire import Device

SYNC_WRITE = 0x83


def wait_until(done: Callable[[], bool], limit_s: float = 180.0) -> bool:
    """Wait for ``done``; the limit is only there to end a broken test."""
    end = time.monotonic() + limit_s
    while not done() and time.monotonic() < end:
        time.sleep(0.005)
    return done()


@dataclass
class LineFaults(WireFaults):
    """Also late replies, and bytes that come ahead of the next reply."""

    delays_s: dict[int, float] = field(default_factory=dict)
    noise: bytes = b""

    def apply(self, servo_id: int, reply: bytes) -> bytes:
        time.sleep(self.delays_s.get(servo_id, 0.0))
        noise, self.noise = self.noise, b""
        return noise + super().apply(servo_id, reply)


class FaultyBus(ServoEmulator):
    """An emulated bus with faults.

    ``echo``: every instruction is sent back first, as adapters that hear themselves do.
    ``loses``: tells of an instruction that writes whether no servo hears it.
    """

    twins: Mapping[int, Device] = {}
    echo = False
    loses: Callable[[], bool] | None = None

    def __init__(
        self,
        protocol: str,
        start: Mapping[int, float],
        spec: MotorSpec | None = None,
        link: Path | None = None,
    ) -> None:
        super().__init__(protocol, start, spec, link)
        self.faults: LineFaults = LineFaults()

    def add_twin(self, servo_id: int, ticks: float) -> None:
        """Another servo with the same id; both answer at once, and low wins."""
        self.twins = {servo_id: self._wire.device(servo_id, Motor(MotorSpec(), ticks))}

    def _answer_frame(self, frame: bytes) -> list[tuple[int, bytes]]:
        writes = frame[7 if self.protocol == "dynamixel" else 4] == SYNC_WRITE
        if writes and self.loses is not None and self.loses():
            return []
        replies = super()._answer_frame(frame)
        others = dict(self._wire.answer(frame, self.twins)) if replies else {}
        heard = [(0, frame)] if self.echo else []
        return heard + [
            (i, bytes(a & b for a, b in zip(reply, others.get(i, reply), strict=False)))
            for i, reply in replies
        ]
