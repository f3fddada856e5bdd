"""Robots as URDF: one of this file, every public one, and what another library says of them."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.urdf_file import UrdfRobot, resting

CHAIN = """<robot name="lift">
  <link name="base"/>
  <link name="a"><inertial><origin xyz="0.1 0 0.02"/><mass value="1.5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="b"><inertial><origin xyz="0 0.2 0" rpy="1 2 3"/><mass value="0.5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="c"/>
  <link name="side"><inertial><mass value="0.3"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="ja" type="prismatic"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0 1.5707963267948966 0"/><axis xyz="0 -1 0"/>
    <limit lower="-0.1" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="jb" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0 0.1 0" rpy="0.3 0 0.2"/><axis xyz="0 -1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="ja" multiplier="1.5" offset="0.02"/></joint>
  <joint name="jc" type="revolute"><parent link="b"/><child link="c"/>
    <axis xyz="1 1 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="js" type="fixed"><parent link="b"/><child link="side"/>
    <origin xyz="0 0 0.4"/></joint>
</robot>
"""


def example(name: str) -> Path:
    """A public robot's URDF out of the package `example-robot-data`."""
    for path in public_robots():
        if path.as_posix().endswith(f"/robots/{name}"):
            return path
    pytest.skip("example-robot-data is not installed")


@cache
def public_robots() -> list[Path]:
    """Every URDF of the package `example-robot-data`; none where it is not installed."""
    for entry in map(Path, sys.path):
        folder = entry / "cmeel.prefix" / "share" / "example-robot-data" / "robots"
        if folder.is_dir():
            return sorted(folder.rglob("*.urdf"))
    return []


def compare(path: Path, base: str, tip: str, arm: Arm, q: np.ndarray) -> None:
    """Tip pose and gravity torques at joints (N, n), another library's against this one's."""
    pin = pytest.importorskip("pinocchio")
    robot = pin.buildModelFromUrdf(str(path))
    robot.gravity.linear = np.array(arm.gravity_mps2)
    data = robot.createData()
    model = Model(arm)
    rows, offset = arm.mixing
    rests = {j.name: resting(j) for j in UrdfRobot(path).joints.values() if j.moves}
    rest = np.zeros(robot.nv)
    for name, value in rests.items():
        rest[robot.joints[robot.getJointId(name)].idx_v] = value
    for each in q:
        v = rest.copy()
        for joint, value in zip(arm.joints, rows @ each + offset, strict=True):
            if joint.type != "fixed":
                v[robot.joints[robot.getJointId(joint.name)].idx_v] = value
        configuration = pin.integrate(robot, pin.neutral(robot), v)
        pin.framesForwardKinematics(robot, data, configuration)
        base_pose, tip_pose = (data.oMf[robot.getFrameId(link, pin.BODY)] for link in (base, tip))
        expected = (base_pose.inverse() * tip_pose).homogeneous
        assert np.abs(model.pose(each) - expected).max() < 1e-9
        torque = pin.computeGeneralizedGravity(robot, data, configuration)
        posture = model.posture(unstack(each))
        for row, name in zip(arm.commanded, arm.joint_names, strict=True):
            if not arm.joints[row - 1].moves:  # beside the chain: what it carries itself is no part
                continue
            station = posture.bearing(row)
            turning = arm.joints[row - 1].type == "revolute"
            carried = posture.moment(station) if turning else posture.force(station)
            mine = float(carried[2])
            assert mine == pytest.approx(
                -torque[robot.joints[robot.getJointId(name)].idx_v], abs=1e-8
            )


def drawn(arm: Arm, rng: np.random.Generator, count: int = 10) -> np.ndarray:
    """(count, n) joints inside the limits."""
    return arm.lower + rng.random((count, arm.n)) * (arm.upper - arm.lower)
