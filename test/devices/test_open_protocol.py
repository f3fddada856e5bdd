"""`docs/add_a_protocol.md`: a protocol from outside drives servos like those of the package."""

import json
import os
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from places import ROOT

from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.motor import MotorSpec

EXAMPLE = ROOT / "examples" / "custom_protocol.py"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A package with both sides of the example's protocol, as pip leaves it."""
    wire = "[longarm_comp.servo_wires]\nmaker = maker_servo:MakerWire\n"
    return installed(tmp_path / "site", "maker", "maker_servo:MakerServo", wire=wire)


def installed(folder: Path, entry: str, target: str, text: str = "", wire: str = "") -> Path:
    record = folder / "maker_servo-1.0.dist-info"
    record.mkdir(parents=True)
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: maker-servo\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(
        f"[longarm_comp.servo_protocols]\n{entry} = {target}\n{wire}"
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
    wire = runpy.run_path(str(EXAMPLE))["MakerWire"]
    with ServoEmulator(wire(), {1: 2048.0, 2: 1000.0}, MotorSpec(overload_s=0.3)) as made:
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
    assert [s["memory"] for s in found["servos"]] == [{"turns": 0}, {"turns": 0}]


DRIVE = """
import sys, time
from longarm_comp.devices.servo_config import ServoConfig
config = ServoConfig.load(sys.argv[1])
bus = config.open_bus()
bus.torque([1, 2], on=True)
bus.write_goal({1: 2100, 2: 940}, {1: 2000.0, 2: 2000.0})
end = time.monotonic() + 300
while (now := {i: s.position_ticks for i, s in bus.read([1, 2]).items()}) != {1: 2100, 2: 940}:
    assert time.monotonic() < end, now
print(bus.read([1])[1].voltage_v, bus.counters.checksum_errors)
bus.close()
"""
BEGIN = """
import sys
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_config import ServoConfig
ServoArm(ServoConfig.load(sys.argv[1])).close()
"""


def test_a_configuration_names_it_and_its_servos_move(
    site: Path, emulator: ServoEmulator, tmp_path: Path
) -> None:
    joint = {"type": "revolute", "zero_ticks": 2048, "direction": 1, "gear_ratio": 1.0,
             "lower": -1.0, "upper": 1.0, "max_velocity": 1.0, "model": "maker-12bit"}  # fmt: skip
    data = {
        "bus": {"protocol": "maker", "port": emulator.port, "baudrate": 115200,
                "reply_timeout_s": 0.15},
        "follower": {"silence_s": 0.5},
        "joints": {"a": joint | {"servo_id": 1}, "b": joint | {"servo_id": 2}},
    }  # fmt: skip
    (tmp_path / "servos.yaml").write_text(yaml.safe_dump(data))
    done = run(site, "-c", DRIVE, tmp_path / "servos.yaml")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["7.4", "0"]
    assert run(site, "-c", BEGIN, tmp_path / "servos.yaml").returncode == 0
    emulator._devices[2].memory[3] = 9
    done = run(site, "-c", BEGIN, tmp_path / "servos.yaml")
    assert "servo 2 of b: turns = 9 (register 3); allowed: 0 or 1: it takes no goals" in done.stderr


SIMULATED = """
import sys
from pathlib import Path
from longarm_comp.cli.run import run
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import read_arm
assert run(sys.argv[1:]) == 0
graph = BringUp(arm=Path("mine/arm.yaml").absolute(), sim=True).with_servos(Path("scratch"))
file = graph.file("servo_driver")
arm = read_arm(file)
at = {"joint1": 0.1, "joint2": 0.2}
start = {j.servo_id: j.ticks(at[j.name]) for j in arm.joints}
with ServoEmulator(arm.protocol, start, link=Path("bus")) as made:
    config = ServoConfig.load(file)
    bus = ServoConfig.parse(config.model_dump() | {"bus": {**config.bus.model_dump(),
        "port": "bus", "reply_timeout_s": 0.2}, "follower": {"silence_s": 0.6}}, "here").open_bus()
    ticks = {i: s.position_ticks for i, s in bus.read([1, 2]).items()}
print({k: round(v, 3) for k, v in arm.values(ticks).items()})
"""
ROWS = ("--joint", "alpha=0 d=0.1 limits=-60..60", "--joint", "alpha=90 limits=0..70",
        "--tip-at", 0.3, 0, 0, "--servos", "maker-12bit")  # fmt: skip


def test_a_simulated_arm_has_its_servos(site: Path, tmp_path: Path) -> None:
    done = run(site, "-c", SIMULATED, "init", "mine", *ROWS)
    assert done.returncode == 0, done.stderr
    assert "longarm up mine/arm.yaml --sim" in done.stderr
    assert done.stdout == "{'joint1': 0.1, 'joint2': 0.2}\n"


def test_servos_that_are_not_emulated_are_not_simulated(tmp_path: Path) -> None:
    site = installed(tmp_path / "site", "maker", "maker_servo:MakerServo")
    done = run(site, "-c", SIMULATED, "init", "mine", *ROWS)
    assert "longarm up" in done.stderr and "--sim" not in done.stderr
    assert "servo_driver.yaml: protocol: 'maker'; allowed: for a simulated arm" in done.stderr


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
