"""State of the arm as heard on the graph: joints and readings of circumstances."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Float64

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.joint_trust import JointTrust
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import efforts_of, joints_of, tilt_of
from longarm_comp.nodes.orders import untimely
from longarm_comp.nodes.stamps import stamp_ns

NO_JOINTS = "no joint_states yet"
"""What `kinematics` says of its targets on /diagnostics until it knows the joints."""


class ArmState:
    """Subscribes to the arm's topics. Values are replaced whole, so other threads may read them.

    Args:
        refused: called for every message that is refused, with its kind and the reason.
        moved: called with every joint reading (n,) that is believed, and its time (ROS clock, s).
        max_age_s: older joint readings are not believed.
        rate: ranges of a joint per second; readings that move faster are not believed.
    """

    def __init__(
        self,
        node: Node,
        arm: Arm,
        refused: Callable[[str, str], None],
        moved: Callable[[np.ndarray, float], None],
        max_age_s: float,
        rate: float,
    ) -> None:
        self._trust, self._max_age_s = JointTrust(arm, rate), max_age_s
        self._clock = node.get_clock()
        self._arm, self._refused = arm, refused
        self._on_moved = moved
        self.readings = Readings(started_s=time.monotonic())
        self._joints: tuple[np.ndarray, float] | None = None
        self.effort = np.full(arm.n, np.nan)
        graph.JOINT_STATES.subscription(node, self._on_joints)
        graph.TEMPERATURE.subscription(node, self._on_temperature)
        graph.PAYLOAD.subscription(node, self._on_payload)
        graph.INCLINATION.subscription(node, self._on_inclination)

    @property
    def joints(self) -> np.ndarray | None:
        """(n,) last joint reading, rad and m; None before the first."""
        held = self._joints
        return None if held is None else held[0]

    @property
    def age_s(self) -> float:
        """Age of the joint reading, s; infinite before the first."""
        held = self._joints
        return math.inf if held is None else time.monotonic() - held[1]

    def _on_joints(self, message: JointState) -> None:
        try:
            q = joints_of(message, self._arm, "joint_states")
        except InputError as error:
            self._refused("bad joint_states", str(error))
            return
        stamp, now = stamp_ns(message.header.stamp), time.monotonic()
        if stamp and (why := self.untimely(stamp, self._max_age_s)):
            self._trust.distrust(f"joint_states are doubtful: the last {why}")
        elif self._trust.read(q, 1e-9 * stamp if stamp else now):
            self._joints, self.effort = (q, now), efforts_of(message, self._arm)
            self._on_moved(q, 1e-9 * (stamp or self._clock.now().nanoseconds))
            return
        self._refused("doubtful joint_states", self._trust.doubt)

    @property
    def doubt(self) -> str:
        """Why the arm must not be moved from where `joints` say that it is; empty if it may."""
        if self._joints is None:
            return self._trust.doubt or NO_JOINTS
        old = f"the last joint_states is {self.age_s:.1f} s old"
        return self._trust.doubt or (old if self.age_s > self._max_age_s else "")

    def untimely(self, stamp: int, max_age_s: float) -> str:
        """Why a message of that stamp (ns) is too old, or of the future; empty if it is not."""
        return untimely(self._clock, stamp, max_age_s)

    def _on_temperature(self, message: Temperature) -> None:
        self._read("temperature", {"temperature_c": message.temperature})

    def _on_payload(self, message: Float64) -> None:
        self._read("payload", {"payload_kg": message.data})

    def _on_inclination(self, message: Imu) -> None:
        try:
            row, columns = tilt_of(message)
        except InputError as error:
            self._refused("bad inclination", str(error))
            return
        self._read(f"inclination {row}", columns)

    def _read(self, source: str, columns: dict[str, float]) -> None:
        if all(math.isfinite(value) for value in columns.values()):
            self.readings = self.readings.told(source, columns, time.monotonic())
        else:
            self._refused(f"bad {source}", f"{source}: {columns} is not finite")
