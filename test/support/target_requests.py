"""Targets as messages to `kinematics`, and as requests."""

import numpy as np
from geometry_msgs.msg import PoseStamped

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes.messages import joints_message
from longarm_interfaces.srv import Compensate


def pose(target: np.ndarray, frame: str = "base") -> PoseStamped:
    """The message of a pose (4, 4), or of a position (3,), m."""
    made = PoseStamped()
    made.header.frame_id = frame
    p, o = made.pose.position, made.pose.orientation
    p.x, p.y, p.z = (target[:3, 3] if target.ndim == 2 else target).tolist()
    if target.ndim == 2:
        o.x, o.y, o.z, o.w = quaternion.from_rotation(target[:3, :3]).tolist()
    return made


def request(matrix: np.ndarray, arm: Arm, **more: object) -> Compensate.Request:
    seed = joints_message(arm, arm.mid)
    return Compensate.Request(**{"target": pose(matrix), "seed": seed, **more})
