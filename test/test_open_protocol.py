"""`docs/add_a_protocol.md`: a protocol from outside drives servos like those of the package."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
import yaml

from longarm_comp.sim.servo_emulator import MotorSpec, ServoEmulator
from longarm_comp.sim.servo_emulator.motor import Motor
from longarm_comp.sim.servo_emulator.wire import Device, Wire

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "custom_protocol.py"


class MakerWire(Wire):
    """The servo's side, written from the table at the head of the example."""

    name, kept_below = "maker", 4

    def device(self, servo_id: int, motor: Motor) -> Device:
        device = Device(servo_id, bytearray(18), motor)
        device.put(0, 2, 7)
        device.put(2, 1, 3)
        return device

    def take(self, buffer: bytearray) -> list[bytes]:
        frames = []
        while len(buffer) >= 6:
            one = 1 if buffer[1] == 1 else 1 + buffer[3]
            end = 6 + buffer[4] * one
            if buffer[0] != 0xAA or buffer[1] not in (1, 2):
                del buffer[0]
            elif len(buffer) < end:
                break
            else:
                frames += (
                    [bytes(buffer[:end])]
                    if sum(buffer[: end - 1]) & 0xFF == buffer[end - 1]
                    else []
                )
                del buffer[:end]
        return frames

    def answer(self, frame: bytes, devices: Mapping[int, Device]) -> list[tuple[int, bytes]]:
        _, kind, address, length, count = frame[:5]
        if kind == 1:
            asked = [devices[i] for i in frame[5 : 5 + count] if i in devices]
            return [(d.servo_id, self._reply(d, address, length)) for d in asked]
        for start in range(5, 5 + count * (1 + length), 1 + length):
            if device := devices.get(frame[start]):
                data = frame[start + 1 : start + 1 + length]
                device.memory[address : address + length] = data
                if address == 4:
                    device.motor.switch(bool(data[0]))
                if address == 5:
                    device.motor.goal, device.motor.speed_limit = map(
                        float, struct.unpack("<hH", data)
                    )
        return []

    def _reply(self, device: Device, address: int, length: int) -> bytes:
        motor = device.motor
        device.memory[4] = motor.torque_on
        device.memory[9:18] = struct.pack(
            "<hhhBBB", round(motor.position), round(motor.velocity), round(1000 * motor.effort),
            round(10 * motor.voltage_v), round(motor.temperature_c), motor.moving,
        )  # fmt: skip
        alarms = ("overheat" in motor.alarms) | ("overload" in motor.alarms) << 1
        body = (
            bytes((0x55, device.servo_id, alarms, length))
            + device.memory[address : address + length]
        )
        return body + bytes((sum(body) & 0xFF,))


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A package with the example's protocol, as pip leaves it."""
    return installed(tmp_path / "site", "maker", "maker_servo:MakerServo")


def installed(folder: Path, entry: str, target: str, text: str = "") -> Path:
    record = folder / "maker_servo-1.0.dist-info"
    record.mkdir(parents=True)
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: maker-servo\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(
        f"[longarm_comp.servo_protocols]\n{entry} = {target}\n"
    )
    (folder / "maker_servo.py").write_text(EXAMPLE.read_text() + text)
    return folder


def run(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(map(str, (ROOT, site)))
    return subprocess.run(
        [sys.executable, *map(str, words)], env={**os.environ, "PYTHONPATH": path}, cwd=site,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture
def emulator() -> Iterator[ServoEmulator]:
    with ServoEmulator(MakerWire(), {1: 2048.0, 2: 1000.0}, MotorSpec(overload_s=0.3)) as made:
        yield made


def test_a_scan_finds_its_servos(site: Path, emulator: ServoEmulator) -> None:
    words = ("servo", "scan", "--port", emulator.port, "--protocol", "maker", "--ids", "1-3")
    done = run(site, "-m", "longarm_comp", *words, "--timeout", 0.15, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["protocol"] == "maker" and found["baudrate"] == 115_200
    assert [(s["servo_id"], s["model"], s["firmware"]) for s in found["servos"]] == [
        (1, "maker-12bit", "3"), (2, "maker-12bit", "3"),
    ]  # fmt: skip


DRIVE = """
import sys, time
from longarm_comp.devices.servo_config import ServoConfig
config = ServoConfig.load(sys.argv[1])
bus = config.open_bus()
bus.torque([1, 2], on=True)
bus.write_goal({1: 2100, 2: 940}, {1: 2000.0, 2: 2000.0})
end = time.monotonic() + 20
while (now := {i: s.position_ticks for i, s in bus.read([1, 2]).items()}) != {1: 2100, 2: 940}:
    assert time.monotonic() < end, now
print(bus.read([1])[1].voltage_v, bus.counters.checksum_errors)
"""


def test_a_configuration_names_it_and_its_servos_move(
    site: Path, emulator: ServoEmulator, tmp_path: Path
) -> None:
    joint = {"type": "revolute", "zero_ticks": 2048, "direction": 1, "gear_ratio": 1.0,
             "lower": -1.0, "upper": 1.0, "max_velocity": 1.0, "model": "maker-12bit"}  # fmt: skip
    data = {
        "bus": {"protocol": "maker", "port": emulator.port, "baudrate": 115200,
                "reply_timeout_s": 0.15},
        "joints": {"a": joint | {"servo_id": 1}, "b": joint | {"servo_id": 2}},
    }  # fmt: skip
    (tmp_path / "servos.yaml").write_text(yaml.safe_dump(data))
    done = run(site, "-c", DRIVE, tmp_path / "servos.yaml")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["7.4", "0"]


@pytest.mark.parametrize(
    ("entry", "target", "said"),
    [
        ("maker", "maker_servo:Nothing", "maker_servo:Nothing that can be loaded"),
        ("other", "maker_servo:MakerServo", "the protocol's own, maker"),
        ("maker", "maker_servo:Dialect", "a class of Dialect, nothing abstract"),
        ("feetech", "maker_servo:Twin", "a name that no other protocol or servo has"),
    ],
)
def test_a_broken_entry_point_is_one_line(
    tmp_path: Path, entry: str, target: str, said: str
) -> None:
    twin = '\n\nclass Twin(MakerServo):\n    name = "feetech"\n'
    site = installed(tmp_path / "site", entry, target, twin)
    failed = run(site, "-m", "longarm_comp", "servo", "scan", "--port", "none", "--protocol", "x")
    assert failed.returncode == 2
    assert failed.stderr.startswith(f"longarm: package maker-servo 1.0, entry point {entry}: ")
    assert said in failed.stderr and len(failed.stderr.splitlines()) == 1
