"""An arm's folder whose servo file is wrong, the emulated bus as it really is, and a hand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cli_shell import Shell
from faulty_bus import FaultyBus

from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator

ROWS = ("d=0.1 limits=-60..60", "alpha=90 limits=-30..50", "type=prismatic a=0.3 limits=0..0.1")


@dataclass(frozen=True)
class TrueJoint:
    """A joint as it really is; ``si_per_tick`` in rad or m."""

    servo_id: int
    direction: int
    zero: float
    si_per_tick: float

    def ticks(self, value: float) -> float:
        return self.zero + self.direction * value / self.si_per_tick

    def value(self, ticks: float) -> float:
        return self.direction * (ticks - self.zero) * self.si_per_tick


TRUE = {
    "joint1": TrueJoint(1, -1, 1500.0, 2 * math.pi / 40960),
    "joint2": TrueJoint(2, +1, 2048.0, 2 * math.pi / 40960),
    "joint3": TrueJoint(3, -1, 2600.0, 2 * math.pi * 0.008 / 4096),
}
"""The file of `folder` has ids 1, 2, 3, every direction + and every zero 2048."""
POSE = {"joint1": math.radians(-60.0), "joint2": math.radians(10.0), "joint3": 0.02}
POSE_FLAGS = ("--pose", "joint1=-60", "--pose", "joint2=10", "--pose", "joint3=20")


def folder(shell: Shell, model: str, to: Path | str = "mine") -> Path:
    rows = [word for row in ROWS for word in ("--joint", row)]
    assert shell("init", to, *rows, "--tip-at", 0.1, 0, 0, "--servos", model) == 0, shell.err
    file = shell.folder / "mine" / "servo_driver.yaml"
    text = file.read_text().replace("reply_timeout_s: 0.02", "reply_timeout_s: 0.2")
    file.write_text(text)
    return shell.folder / "mine"


@contextmanager
def bus(protocol: str) -> Iterator[FaultyBus]:
    """The true servos, in the pose."""
    start = {TRUE[name].servo_id: TRUE[name].ticks(POSE[name]) for name in TRUE}
    emulator = FaultyBus(protocol, start)
    with emulator:
        yield emulator


def off_by(file: Path, emulator: ServoEmulator) -> dict[str, float]:
    """Joint values that the driver reads with a file, less the true ones, in ticks."""
    config, at = ServoConfig.load(file), emulator.positions()
    return {
        name: (config.joints[name].to_si(at[config.joints[name].servo_id])
               - true.value(at[true.servo_id])) / true.si_per_tick
        for name, true in TRUE.items()
    }  # fmt: skip
