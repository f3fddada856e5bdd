"""An arm's folder whose servo file is wrong, the emulated bus as it really is, and a hand."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from cli_shell import Shell
from faulty_bus import FaultyBus

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_arm import ServoArm
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
MODELS = {"feetech": "sts3215", "dynamixel": "xl430-w250"}
POSE_FLAGS = ("--pose", "joint1=-60", "--pose", "joint2=10", "--pose", "joint3=20")


def folder(shell: Shell, model: str, to: Path | str = "mine") -> Path:
    rows = [word for row in ROWS for word in ("--joint", row)]
    assert shell("init", to, *rows, "--tip-at", 0.1, 0, 0, "--servos", model) == 0, shell.err
    file = shell.folder / "mine" / "servo_driver.yaml"
    _be_patient(file)
    return shell.folder / "mine"


def direct(shell: Shell, model: str) -> Path:
    """A folder of two joints on their servos' horns, which turn once."""
    rows = [word for row in ROWS[:2] for word in ("--joint", row)]
    words = ("--tip-at", 0.1, 0, 0, "--servos", model, "--hobby")
    assert shell("init", "mine", *rows, *words) == 0, shell.err
    file = shell.folder / "mine" / "servo_driver.yaml"
    _be_patient(file)
    return shell.folder / "mine"


def _be_patient(file: Path) -> None:
    """Emulated servos share a busy machine with the test."""
    text = file.read_text().replace("reply_timeout_s: 0.02", "reply_timeout_s: 0.2")
    file.write_text(text.replace("silence_s: 0.25", "silence_s: 0.6"))


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


OFFSETS = {"feetech": (31, 2, 1 << 11 | 300), "dynamixel": (20, 4, 300)}
"""Address, length and value with which a servo says 300 ticks more than its encoder."""
LIMITS = {"feetech": ((9, 2), (11, 2)), "dynamixel": ((52, 4), (48, 4))}
NAMES = {
    "feetech": ("min_angle_limit", "max_angle_limit"),
    "dynamixel": ("min_position_limit", "max_position_limit"),
}


@contextmanager
def two(protocol: str) -> Iterator[ServoEmulator]:
    """Two directly driven servos, with the ids 1 and 2."""
    with ServoEmulator(protocol, {1: 2048.0, 2: 2048.0}) as emulator:
        yield emulator


def store(emulator: ServoEmulator, servo_id: int, address: int, length: int, value: int) -> None:
    device = emulator._devices[servo_id]
    device.put(address, length, value)
    device.kept = bytes(device.memory)


def limit(emulator: ServoEmulator, servo_id: int, low: int, high: int) -> None:
    for (address, length), value in zip(LIMITS[emulator.protocol], (low, high), strict=True):
        store(emulator, servo_id, address, length, value)


def stored(emulator: ServoEmulator) -> dict[int, bytes]:
    """What outlives a loss of power, by id."""
    kept = emulator._wire.kept_below
    return {i: device.kept[:kept] for i, device in emulator._devices.items()}


def configured(mine: Path, emulator: ServoEmulator) -> ServoConfig:
    file = mine / "servo_driver.yaml"
    file.write_text(re.sub(r"port: [^,]+", f"port: {emulator.port}", file.read_text()))
    return ServoConfig.load(file)


def refuses(config: ServoConfig) -> str:
    """Why the driver does not begin with the servos."""
    with pytest.raises(JobError) as caught:
        ServoArm(config)
    return str(caught.value)
