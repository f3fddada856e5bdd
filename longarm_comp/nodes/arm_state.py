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
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_of, tilt_of

NO_JOINTS = "no joint_states yet"
"""What `kinematics` says of its targets on /diagnostics until it knows the joints."""


class ArmState:
    """Subscribes to the arm's topics. Values are replaced whole, so other threads may read them.

    Args:
        refused: called for every message that is refused, with its kind and the reason.
        moved: called with every joint reading (n,).
    """

    def __init__(
        self,
        node: Node,
        arm: Arm,
        refused: Callable[[str, str], None],
        moved: Callable[[np.ndarray], None],
    ) -> None:
        self._arm, self._refused = arm, refused
        self._on_moved = moved
        self.readings = Readings(started_s=time.monotonic())
        self._joints: tuple[np.ndarray, float] | None = None
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
        self._joints = q, time.monotonic()
        self._on_moved(q)

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
