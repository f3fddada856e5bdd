"""An emulated bus with the faults of lines and adapters, and two servos of one id."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from longarm_comp.sim.servo_emulator.emulator import ServoEmulator, WireFaults
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from longarm_comp.sim.servo_emulator.wire import Device


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
    """``echo``: every instruction is sent back first, as adapters that hear themselves do."""

    twins: Mapping[int, Device] = {}
    echo = False

    def __init__(self, protocol: str, start: Mapping[int, float], spec: MotorSpec | None = None):
        super().__init__(protocol, start, spec)
        self.faults: LineFaults = LineFaults()

    def add_twin(self, servo_id: int, ticks: float) -> None:
        """Another servo with the same id; both answer at once, and low wins."""
        self.twins = {servo_id: self._wire.device(servo_id, Motor(MotorSpec(), ticks))}

    def _answers(self, frame: bytes) -> list[tuple[int, bytes]]:
        replies = super()._answers(frame)
        others = dict(self._wire.answer(frame, self.twins)) if replies else {}
        heard = [(0, frame)] if self.echo else []
        return heard + [
            (i, bytes(a & b for a, b in zip(reply, others.get(i, reply), strict=False)))
            for i, reply in replies
        ]
