"""A driver and what a setup of servos that was broken off has left."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

import yaml
from driver_rig import Rig

from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.setup_journal import SetupJournal


def arm_in(folder: Path) -> Path:
    joints = [
        {"id": 1, "name": "shoulder", "type": "revolute", "limits_deg": [-29, 58]},
        {"id": 2, "name": "boom", "type": "prismatic", "alpha_deg": 90, "limits_m": [0, 0.1]},
    ]
    text = {"name": "arm", "convention": "mdh_craig", "tip": {"frame": 2}, "joints": joints}
    folder.mkdir()
    (folder / "arm.yaml").write_text(yaml.safe_dump(text))
    return folder / "arm.yaml"


def test_a_driver_ends_the_journal_of_its_own_arm_alone(rig: Rig, tmp_path: Path) -> None:
    mine, other = arm_in(tmp_path / "mine"), arm_in(tmp_path / "other")
    line, state = ServoConfig.load(rig.file).bus, tmp_path / "kept"
    journals = [SetupJournal(str(state), arm, line) for arm in (mine, other)]
    for journal in journals:
        journal.begin({1: (b"had", b"new")})
    rig.ends()
    driver = rig.start(arm=mine, state=state)
    rig.stage.spin(lambda: "they are set as configured" in rig.stage.output(driver))
    rig.is_idle()
    assert [sorted(journal.read()) for journal in journals] == [[], [1]]
    assert f"a setup of {other} was broken off" in rig.stage.output(driver)
    rig.ends()
    rig.start()
