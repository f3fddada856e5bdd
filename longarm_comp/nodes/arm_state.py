"""What a node knows of its arm: the model, and what the graph tells. Its parts read it here."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Imu, JointState

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.joint_trust import JointTrust
from longarm_comp.core.compensation.online import Readings, StaleContext
from longarm_comp.core.effects.catalogue import load_file
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.driver_link import DriverLink
from longarm_comp.nodes.frames import prefix_of
from longarm_comp.nodes.messages import efforts_of, joints_of, tilt_of
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.node import WATCH, ArmNode
from longarm_comp.nodes.orders import untimely
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.predictor_client import PredictorClient

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm"),
    Param("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    Param("effects", "", "Python files that define further effects, executed; : between paths"),
    Param("joints_max_age_s", 5.0, "joint_states older than this are not used", 0.1, 1e6),
    Param("joints_max_rate", 5.0, "faster motion is not believed; ranges a second", 0.1, 1e6),
    Param("context_max_age_s", 60.0, "older temperature, payload, tilt are not used", 0.1, 1e6),
    Param("predictor_timeout_s", 0.5, "longest wait for the predictor's answer", 0.01, 60.0),
    WATCH,
)
"""Parameters of every node that computes with the arm's state."""


NO_JOINTS = "no joint_states yet"
"""What `kinematics` says of its targets on /diagnostics until it knows the joints."""


class ArmState:
    """Subscribes to the arm's topics. Values are replaced whole, so other threads may read them.

    Args:
        capacity: jobs that may wait for the worker.

    Attributes:
        files: the declared arm and the model in use. base_frame: full name of its frame.
        readings: of circumstances. effort: (n,) N m and N, NaN where none is told.
        driver: what the driver tells; its history of the joints.
        worker: the thread that computes with all this.
        moved: called with every joint reading (n,) that is believed, and its time (ROS clock, s).
    """

    def __init__(self, node: ArmNode, capacity: int, *, trimmed: bool = False) -> None:
        self.node, self.p, p = node, node.p, node.p
        for path in filter(None, p["effects"].split(os.pathsep)):
            load_file(path)
        self.files = ModelFiles(p["arm"], p["model"], trimmed=trimmed)
        self.arm = self.files.arm
        self.base_frame = prefix_of(node) + p.get("base_frame", "base")
        self.worker = node.worker(capacity)
        caller = self.worker.caller(graph.PREDICT_ERROR)
        self.predictor = PredictorClient(caller, self.arm, p["predictor_timeout_s"])
        self.driver = DriverLink(
            self.worker, self.arm, acknowledged=p["acknowledged"], joints=lambda: self.joints,
            refused=node.tally.count,
        )  # fmt: skip
        self.moved: Callable[[np.ndarray, float], None] = lambda q, at_s: None
        self._max_age_s = p["joints_max_age_s"]
        self._trust = JointTrust(self.arm, p["joints_max_rate"])
        self.readings = Readings(started_s=time.monotonic())
        self._joints: tuple[np.ndarray, float] | None = None
        self.effort = np.full(self.arm.n, np.nan)
        graph.JOINT_STATES.subscription(node, self._on_joints)
        graph.TEMPERATURE.subscription(
            node, lambda said: self._read("temperature", {"temperature_c": said.temperature})
        )
        graph.PAYLOAD.subscription(
            node, lambda said: self._read("payload", {"payload_kg": said.data})
        )
        graph.INCLINATION.subscription(node, self._on_inclination)

    @property
    def now_s(self) -> float:
        return 1e-9 * float(self.node.get_clock().now().nanoseconds)

    @property
    def stamp(self) -> Time:
        stamp: Time = self.node.get_clock().now().to_msg()
        return stamp

    def context(self, history: History | None = None, model: Model | None = None) -> Context:
        """Circumstances at this moment for joints of a history.

        Args:
            history: where it is not given, that of what was commanded last.
            model: that needs them; the one in use where it is not given.

        Raises:
            StaleContext: one that the model needs is unknown or too old.
        """
        return self.readings.context(
            model or self.files.loaded.model, time.monotonic(), self.p["context_max_age_s"],
            self.driver.history if history is None else history,
        )  # fmt: skip

    def known(self, history: History | None = None) -> Context | None:
        """The same; None while one that the model needs is unknown."""
        try:
            return self.context(history)
        except StaleContext:
            return None

    @property
    def standing(self) -> tuple[Model, np.ndarray, Context] | None:
        """Model in use, readings (n,) and circumstances of now; None while they are not known."""
        q, context = self.joints, self.known()
        return None if q is None or context is None else (self.files.loaded.model, q, context)

    def _on_inclination(self, message: Imu) -> None:
        try:
            row, columns = tilt_of(message)
        except InputError as error:
            self.node.tally.count("bad inclination", str(error))
            return
        self._read(f"inclination {row}", columns)

    def _read(self, source: str, columns: dict[str, float]) -> None:
        if all(math.isfinite(value) for value in columns.values()):
            self.readings = self.readings.told(source, columns, time.monotonic())
        else:
            self.node.tally.count(f"bad {source}", f"{source}: {columns} is not finite")

    @property
    def joints(self) -> np.ndarray | None:
        """(n,) last joint reading, rad and m; None before the first."""
        held = self._joints
        return None if held is None else held[0]

    @property
    def doubt(self) -> str:
        """Why the arm must not be moved from where `joints` say that it is; empty if it may."""
        held = self._joints
        if held is None:
            return self._trust.doubt or NO_JOINTS
        age_s = time.monotonic() - held[1]
        old = f"the last joint_states is {age_s:.1f} s old"
        return self._trust.doubt or (old if age_s > self._max_age_s else "")

    def untimely(self, stamp: int, max_age_s: float) -> str:
        """Why a message of that stamp (ns) is too old, or of the future; empty if it is not."""
        return untimely(self.node.get_clock(), stamp, max_age_s)

    def _on_joints(self, message: JointState) -> None:
        try:
            q = joints_of(message, self.arm, "joint_states")
        except InputError as error:
            self.node.tally.count("bad joint_states", str(error))
            return
        stamp, now = stamp_ns(message.header.stamp), time.monotonic()
        if stamp and (why := self.untimely(stamp, self._max_age_s)):
            self._trust.distrust(f"joint_states are doubtful: the last {why}")
        elif self._trust.read(q, 1e-9 * stamp if stamp else now):
            self._joints, self.effort = (q, now), efforts_of(message, self.arm)
            self.moved(q, 1e-9 * stamp if stamp else self.now_s)
            return
        self.node.tally.count("doubtful joint_states", self._trust.doubt)
