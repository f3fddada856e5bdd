"""The driver as `kinematics` hears it: whether it takes trajectories, and what became of them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import History
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import ERROR, OK, WARN, Report
from longarm_comp.nodes.messages import driver_words, joints_of, path_of
from longarm_comp.nodes.worker import Worker
from longarm_interfaces.msg import DriverState, Motion

_SILENT_S = 3.0
"""A driver that has not told its state for so long is gone. It tells it twice a second."""


class DriverLink:
    """Subscribes to what the driver tells, and keeps the history of the joints.

    What counts as commanded is what the driver accepted. Without acknowledgements (a driver that
    gives none) it is what was published on `joint_trajectory`.

    Args:
        worker: hears it, so that what the driver tells is known before the next target.
        acknowledged: whether the driver tells its state and what becomes of trajectories.
        joints: the last joint reading (n,), or None.
        refused: called for every message that is refused, with its kind and the reason.

    Attributes:
        history: of the joints, when they have come to the end of what was commanded last.
        commanded: called for every command, with its joints (n,) and their history on arrival.
        told: called with every message on `motion`.
    """

    def __init__(
        self,
        worker: Worker,
        arm: Arm,
        *,
        acknowledged: bool,
        joints: Callable[[], np.ndarray | None],
        refused: Callable[[str, str], None],
    ) -> None:
        self._arm, self._joints, self._refused = arm, joints, refused
        self.acknowledged = acknowledged
        self.commanded: Callable[[np.ndarray, History], None] = lambda q, history: None
        self.told: Callable[[Motion], None] = lambda motion: None
        self.history = History.unknown(arm.n)
        self._end: np.ndarray | None = None
        self._state: DriverState | None = None
        self._heard_s = self._rival_s = -_SILENT_S
        self._known: set[str] = set()
        self._asked, self._answer = "", None
        if acknowledged:
            heard = {graph.MOTION: self._on_motion, graph.DRIVER_STATE: self._on_state}
        else:
            heard = {graph.JOINT_TRAJECTORY: self._on_trajectory}
        for topic, callback in heard.items():
            worker.hear(topic, callback)

    @property
    def refusal(self) -> str:
        """Why nothing can be sent now; empty where the driver takes trajectories."""
        if not self.acknowledged:
            return ""
        now, state = time.monotonic(), self._state
        if state is None:
            return "no servo_driver is on the graph"
        if now - self._rival_s < _SILENT_S:
            return "two drivers publish servo_driver/state: end one of them"
        if now - self._heard_s > _SILENT_S:
            return f"servo_driver has been silent for {now - self._heard_s:.0f} s"
        if state.state not in (DriverState.READY, DriverState.MOVING):
            why = f": {state.message}" if state.message else ""
            return f"servo_driver is {driver_words(state.state).partition(':')[0]}{why}"
        return ""

    def expect(self, name: str) -> None:
        """Wait from now on for the acknowledgement of the trajectory of that id."""
        self._asked, self._answer = name, None

    @property
    def answered(self) -> bool:
        """Whether the driver has said if it takes the trajectory; true where it never says."""
        return self._answer is not None or not self.acknowledged

    @property
    def not_accepted(self) -> str:
        """Why the trajectory that was expected is not taken up; empty where it is."""
        if not self.acknowledged:
            return ""
        if self._answer is None:
            return "sent, but not acknowledged by the driver in time, so it was withdrawn"
        refused = self._answer.event == Motion.REFUSED
        return f"the driver refused it: {self._answer.message}" if refused else ""

    def _on_motion(self, message: Motion) -> None:
        if message.event == Motion.ACCEPTED:
            self._accepted(message)
        elif message.event in (Motion.REPLACED, Motion.BROKEN_OFF):
            self.lose()
        if message.id == self._asked and message.event in (Motion.ACCEPTED, Motion.REFUSED):
            self._answer = message
        self.told(message)

    def _accepted(self, message: Motion) -> None:
        names = list(message.start.name)
        try:
            start = joints_of(message.start, self._arm, "start of motion")
            path = path_of(JointTrajectory(joint_names=names, points=message.points), self._arm)
        except InputError as error:
            self._refused("bad motion", str(error))
            self.lose()
            return
        self.went(path, start)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        try:
            path = path_of(message, self._arm)
        except InputError as error:
            self._refused("bad joint_trajectory", str(error))
            return
        self.went(path, self._end if self._end is not None else self._joints())

    def went(self, path: np.ndarray, start: np.ndarray | None) -> None:
        """Joints are on their way through (k, n) from a start (n,)."""
        self.history = self.history.after(path, start)
        self._end = path[-1]
        self.commanded(path[-1], self.history)

    def lose(self) -> None:
        """Where the joints come from is not known from here on."""
        self.history, self._end = History.unknown(self._arm.n), None

    def _on_state(self, message: DriverState) -> None:
        now, instance = time.monotonic(), message.instance
        known = self._state is not None and self._state.instance == instance
        if not known and instance in self._known:  # it speaks again after another one did
            if message.state == DriverState.UNCONFIGURED:
                return  # on leaving
            self._rival_s = now
        if not known:
            self._known.add(instance)
            self.lose()
        self._state, self._heard_s = message, now

    def report(self) -> Report:
        if not self.acknowledged:
            return Report(OK, "no acknowledgement is expected: what is sent counts as accepted")
        why = self.refusal
        if why:
            return Report(ERROR if self._rival_s > self._heard_s - _SILENT_S else WARN, why)
        return Report(OK, "the driver takes trajectories")
