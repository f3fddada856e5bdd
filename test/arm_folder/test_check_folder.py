"""`longarm check` of an arm's folder: what is wrong, missing or not yet measured."""

from pathlib import Path

import pytest
from arm_folders import NODES, levels, replaced
from cli_shell import Shell

FAULTS = {
    "an arm in millimetres": ("arm", r"a_m: 0.16", "a_m: 160.0", ""),
    "an unknown key": ("arm", "tip:", "top:", "top"),
    "a soft tube": ("arm", r"E_pa: [\d.e+]+", "E_pa: 2.1e6", "links"),
    "degrees taken for radians": (
        "arm", r"(limits_deg): \[-60.0, 60.0\]", r"\1: [-3438, 3438]", "joints.joint1.limits_deg"),
    "other limits": ("servo_driver", r"upper: [\d.]+", "upper: 0.9", "joints.joint1"),
    "wider limits": ("servo_driver", r"upper: 1.04\d+", "upper: 1.2", "joints.joint1.upper"),
    "a slide that turns": (
        "arm", r"type: revolute(.*)limits_deg: \[-60.0, 60.0\]",
        r"type: prismatic\1limits_m: [-1.05, 1.05]", "servo_driver.yaml: joints.joint1.type"),
    "degrees a second": (
        "servo_driver", r"(max_velocity): [\d.]+", r"\1: 45.0", "joints.joint1.max_velocity"),
    "milliseconds": (
        "servo_driver", r"silence_s: [\d.]+", "silence_s: 250.0", "follower.silence_s"),
    "another joint": ("servo_driver", "joint6:", "joint7:", "joints"),
    "an id twice": ("servo_driver", "servo_id: 2", "servo_id: 1", "joints.joint2.servo_id"),
    "cameras that look away": (
        "simulated_arm", r"axis: \[.*\]", "axis: [0.7, -0.7, 0.0]", "camera, marker"),
    "a camera elsewhere": ("stereo_bridge", r"xyz: \[[-\d.]+", "xyz: [0.5", "hand_eye"),
    "a number as text": ("stereo_bridge", r"tag_m: [\d.]+", "tag_m: big", "marker.tag_m"),
    "an unknown parameter": ("simulated_arm", "seed:", "sead:", "sead"),
    "too few cycles": ("servo_driver", "rate_hz: [0-9.]+", "rate_hz: 2.0", "rate_hz"),
    "no cycles": ("servo_driver", "rate_hz: [0-9.]+", "rate_hz: 0.0", "rate_hz"),
    "a rate as text": ("servo_driver", "rate_hz: [0-9.]+", "rate_hz: fast", "rate_hz"),
    "an unknown parameter of the driver": ("servo_driver", "trim:", "trimm:", "trimm"),
}  # fmt: skip


@pytest.mark.parametrize(("node", "old", "new", "where"), FAULTS.values(), ids=FAULTS)
def test_check_names_what_is_wrong(
    shell: Shell, mine: Path, node: str, old: str, new: str, where: str
) -> None:
    replaced(mine / f"{node}.yaml", old, new)
    where = where if ".yaml" in where else f"{node}.yaml: {where}".removesuffix(": ")
    assert "cannot be used yet" in shell.refused("check", mine, code=3)
    listed = [line for line in shell.out.splitlines() if line.startswith("implausible")]
    assert any(line.split()[1].startswith(where.split()[0]) and where in line for line in listed)


@pytest.mark.parametrize("name", ["arm.yaml", *(f"{node}.yaml" for node in NODES)])
def test_check_names_a_missing_file(mine: Path, name: str) -> None:
    (mine / name).unlink()
    assert levels(mine, "missing") == [name]


def test_half_a_file_is_missing_the_rest(mine: Path) -> None:
    file = mine / "stereo_bridge.yaml"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[: len(lines) // 2]))
    assert levels(mine, "missing") == ["stereo_bridge.yaml"]


def test_what_was_measured_is_no_longer_listed(shell: Shell, mine: Path) -> None:
    before = levels(mine, "unmeasured")
    assert [where.split(":")[0] for where in before] == [
        *("servo_driver.yaml", "stereo_bridge.yaml", "stereo_bridge.yaml", "stereo_bridge.yaml"),
        *("samples.csv", "cameras"),
    ]
    servos = mine / "servo_driver.yaml"
    servos.write_text(servos.read_text().replace("zero_ticks: 2048.0", "zero_ticks: 1990.0"))
    bridge = mine / "stereo_bridge.yaml"
    replaced(bridge, r"tip_in_marker: \[.*\]", "tip_in_marker: [0.0, 0.001, 0.0]")
    (mine / "samples.csv").write_text("")
    after = levels(mine, "unmeasured")
    assert after == ["stereo_bridge.yaml: hand_eye", "stereo_bridge.yaml: marker", "cameras"]
    listed = shell.json("check", mine)
    assert [f["where"] for f in listed if f["level"] != "declared"] == after
    assert "no such" not in shell.err
    assert shell.refused("check", shell.folder / "nowhere").startswith("longarm: ")
