"""Targets as messages to `kinematics`, and as requests."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes.messages import joints_message
from longarm_interfaces.srv import Compensate


def pose(matrix: np.ndarray, frame: str = "base") -> PoseStamped:
    made = PoseStamped()
    made.header.frame_id = frame
    p, o = made.pose.position, made.pose.orientation
    p.x, p.y, p.z = matrix[:3, 3].tolist()
    o.x, o.y, o.z, o.w = quaternion.from_rotation(matrix[:3, :3]).tolist()
    return made


def request(matrix: np.ndarray, arm: Arm, **more: object) -> Compensate.Request:
    seed = joints_message(arm, arm.mid)
    return Compensate.Request(**{"target": pose(matrix), "seed": seed, **more})
