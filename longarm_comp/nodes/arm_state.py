"""State of the arm as heard on the graph: joints, last command, readings of circumstances."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Float64, String
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_of, path_of, tilt_of
from longarm_comp.nodes.worker import ManualCallbackGroup

NO_JOINTS = "no joint_states yet"
"""What `kinematics` says of its targets on /diagnostics until it knows the joints."""


class ArmState:
    """Subscribes to the arm's topics. Values are replaced whole, so other threads may read them.

    Args:
        refused: called for every message that is refused, with its kind and the reason.
        commanded: called for every command, with its joints (n,) and their history on arrival.
        moved: called with every joint reading (n,).

    Attributes:
        commands: subscriptions to the commands and to what became of them. The worker takes
            them, so that each is known before the next target.
    """

    def __init__(
        self,
        node: Node,
        arm: Arm,
        refused: Callable[[str, str], None],
        commanded: Callable[[np.ndarray, History], None],
        moved: Callable[[np.ndarray], None],
    ) -> None:
        self._arm, self._refused = arm, refused
        self._on_command, self._on_moved = commanded, moved
        self.readings = Readings(started_s=time.monotonic())
        self.history = History.unknown(arm.n)
        self._joints: tuple[np.ndarray, float] | None = None
        self._commanded: np.ndarray | None = None
        graph.JOINT_STATES.subscription(node, self._on_joints)
        self.commands = (
            graph.JOINT_TRAJECTORY.subscription(node, self._on_trajectory, ManualCallbackGroup()),
            graph.LOST_MOVE.subscription(node, self._on_lost, ManualCallbackGroup()),
        )
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

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Record the move of any command, whoever sent it, in the history of the joints."""
        try:
            path = path_of(message, self._arm)
        except InputError as error:
            self._refused("bad joint_trajectory", str(error))
            return
        before = self._commanded if self._commanded is not None else self.joints
        self.history = self.history.after(path, before)
        self._commanded = path[-1]
        self._on_command(path[-1], self.history)

    def _on_lost(self, message: String) -> None:
        """A move that the driver did not take, or broke off: where joints came from is unknown."""
        self.history = History.unknown(self._arm.n)
        self._commanded = None

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
