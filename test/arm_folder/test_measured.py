"""The record of what was measured: it counts as long as the values are those measured."""

import re
from pathlib import Path

import pytest
from arm_folders import levels, replaced
from cli_shell import Shell

from longarm_comp.arm_folder.check import check_folder
from longarm_comp.arm_folder.measured import CAMERAS, SIDES, camera_path, note_measured


@pytest.fixture
def mine(shell: Shell) -> Path:
    assert shell("init", "mine", "--like", "demo") == 0, shell.err
    return shell.folder / "mine"


def test_what_was_measured_counts_until_its_values_change(mine: Path) -> None:
    servos, bridge = mine / "servo_driver.yaml", mine / "stereo_bridge.yaml"
    cameras = [camera_path(mine, side) for side in SIDES]
    cameras[0].parent.mkdir()
    for camera in cameras:
        camera.write_text("as calibrated")

    def measured_of(*edits: tuple[Path, str, str]) -> set[str]:
        """Measure all, edit some, and return what still counts as measured."""
        for file in (servos.name, bridge.name, CAMERAS):
            note_measured(mine, file, "a command", {"n": 3})
        before = {edit[0]: edit[0].read_text() for edit in edits}
        for edit in edits:
            replaced(*edit)
        for found in check_folder(mine):
            if "changed since" in found.text:
                assert found.level == "unmeasured" and "longarm a command: n 3" in found.text
        still = set(levels(mine, "measured"))
        for file, text in before.items():
            file.write_text(text)
        return still

    everything = {servos.name, bridge.name, CAMERAS}
    silent = {f"{bridge.name}: hand_eye", f"{servos.name}: zero_ticks"}
    assert measured_of() == everything and silent.isdisjoint(levels(mine, "unmeasured"))
    speed, tag = (
        (servos, r"max_velocity: [\d.]+", "max_velocity: 0.01"),
        (bridge, r"tag_m: [\d.]+", "tag_m: 0.055"),
    )
    assert measured_of(speed, tag) == everything
    for key in ("servo_id: 1,", "zero_ticks: 2048.0"):
        other = re.sub(r"\d+", "9", key, count=1)
        assert measured_of((servos, key, other)) == {bridge.name, CAMERAS}
    assert measured_of((bridge, r"xyz: \[[-\d.]+", "xyz: [0.125")) == {servos.name, CAMERAS}
    assert measured_of((cameras[1], "as", "not as")) == {servos.name}  # the head saw through it
    assert measured_of((bridge, "ros__parameters", "ros_parameters")) == {servos.name, CAMERAS}

    replaced(cameras[0], "as", "not as")
    listed = levels(mine, "unmeasured")
    assert {CAMERAS, bridge.name, f"{bridge.name}: hand_eye"} <= set(listed)
    record = mine / "measured.yaml"
    record.write_text(re.sub(r"  of: \w+\n", "", record.read_text()))  # by an earlier version
    assert set(levels(mine, "measured")) == everything
