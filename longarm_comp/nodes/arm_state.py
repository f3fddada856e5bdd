"""The state of a node's arm: the model, and what the graph and the driver publish about it."""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Imu, JointState
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import JointTrust, Readings, StaleContext
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import sleepless_s, stamp_ns, told_ns
from longarm_comp.nodes.frames import prefix_of
from longarm_comp.nodes.health import ERROR, OK, WARN, Report
from longarm_comp.nodes.messages import (
    driver_words,
    efforts_of,
    error_message,
    joints_of,
    motion_of,
    path_of,
    tilt_of,
    vector_message,
)
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.node import WATCH, ArmNode
from longarm_comp.nodes.orders import DRIVER_SILENT_S, TWO_DRIVERS, describe_untimely
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.predictor_client import PredictorClient
from longarm_interfaces.msg import DriverState, Motion

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm"),
    Param("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    Param("joints_max_age_s", 5.0, "joint_states older than this are not used", 0.1, 1e6),
    Param("joints_max_rate", 5.0, "faster motion is not believed; ranges a second", 0.1, 1e6),
    Param("context_max_age_s", 60.0, "older temperature, payload, tilt are not used", 0.1, 1e6),
    Param("predictor_timeout_s", 0.5, "longest wait for the predictor's answer", 0.01, 60.0),
    WATCH,
)
"""Parameters of every node that computes with the arm's state."""
MAX_CORRECTION = Param(
    "max_correction_m", 0.0, "largest correction by a command; 0: a tenth of the reach", 0.0, 100.0
)
"""Parameter of every node that corrects commands."""

UNACKNOWLEDGED = "no acknowledgement is expected: what is sent counts as accepted"
"""The report about a driver whose acknowledgements `kinematics` does not expect."""
NO_JOINTS = "no joint_states yet"
"""The report of `kinematics` about its targets on /diagnostics until it knows the joints."""


class ArmState:
    """The state of the arm, kept up to date by subscriptions to its topics.

    Each value is replaced as a whole, never changed in place, so other threads may read it.

    Attributes:
        base_frame: full name of the arm's base frame.
        readings: last readings of the circumstances.
        effort: (n,) efforts of the joints, N m and N; NaN where none is published.
        worker: the thread that computes with this state.
        joint_listeners: called with every plausible joint reading (n,), rad and m, and its time
            (ROS clock, s).
    """

    def __init__(self, node: ArmNode, capacity: int, *, trimmed: bool = False) -> None:
        self.node, self.p, p = node, node.p, node.p
        self.files = ModelFiles(p["arm"], p["model"], trimmed=trimmed)
        self.arm = self.files.arm
        self.base_frame = prefix_of(node) + p.get("base_frame", "base")
        self.worker = node.worker(capacity)
        caller = self.worker.caller(graph.PREDICT_ERROR)
        self._errors = graph.PREDICTED_ERROR.publisher(node)
        timeout_s = p["predictor_timeout_s"]
        self.predictor = PredictorClient(caller, self.arm, timeout_s, self._publish_error)
        self.worker.hear(graph.SERVED, self.predictor.on_served)
        self.driver = DriverLink(self)
        node.health.parts["messages"] = node.tally.report
        self.joint_listeners: list[Callable[[np.ndarray, float], object]] = [self.driver.on_joints]
        self._max_age_s = p["joints_max_age_s"]
        self._trust = JointTrust(self.arm, p["joints_max_rate"])
        self.readings = Readings()
        self._joints: tuple[np.ndarray, float] | None = None
        self.effort = np.full(self.arm.n, np.nan)
        graph.JOINT_STATES.subscription(node, self._on_joints)
        take = self.take_in
        graph.TEMPERATURE.subscription(
            node, lambda said: take("temperature", {"temperature_c": said.temperature})
        )
        graph.PAYLOAD.subscription(node, lambda said: take("payload", {"payload_kg": said.data}))
        graph.INCLINATION.subscription(node, self._on_inclination)

    @property
    def now_s(self) -> float:
        return 1e-9 * float(self.node.get_clock().now().nanoseconds)

    @property
    def stamp(self) -> Time:
        stamp: Time = self.node.get_clock().now().to_msg()
        return stamp

    def context(self, history: History | None = None, model: Model | None = None) -> Context:
        """Return the present circumstances that a model needs, by default the one in use.

        Args:
            history: history of the joints; by default the history after the last command.

        Raises:
            StaleContext: a circumstance that the model needs is unknown or too old.
        """
        told = self.circumstances(model or self.files.loaded.model)
        return told(self.driver.history if history is None else history)

    def circumstances(self, model: Model) -> Callable[[History | None], Context]:
        """Return the `context` of a model by history, from the readings and the time of this call.

        Whatever is published later does not change it, so one move is computed for one state.
        """
        age_s = self.p["context_max_age_s"]
        return partial(self.readings.context, model, time.monotonic(), age_s)

    def known_context(self, history: History | None = None) -> Context | None:
        """Return the present circumstances as `context` does; None while one is unknown or old."""
        try:
            return self.context(history)
        except StaleContext:
            return None

    @property
    def standing(self) -> tuple[Model, np.ndarray, Context] | None:
        """The model, the joints' readings (n,) and the circumstances; None while one is unknown."""
        q, context = self.joints, self.known_context()
        return None if q is None or context is None else (self.files.loaded.model, q, context)

    def _publish_error(self, error: np.ndarray) -> None:
        if self._errors.get_subscription_count():
            told = error_message(vector_message(error), self.stamp, self.base_frame)
            self._errors.publish(told)

    def _on_inclination(self, message: Imu) -> None:
        try:
            row, columns = tilt_of(message)
        except InputError as error:
            self.node.tally.count_dropped("inclination", str(error))
            return
        self.take_in(f"inclination {row}", columns)

    def take_in(self, source: str, columns: dict[str, float], at_s: float | None = None) -> None:
        """Keep circumstances of a source that were received, or estimated at ``at_s`` (monotonic).

        Values that are not finite are dropped. An impossible value is kept with the reason why it
        is impossible. It replaces the earlier reading, because that is out of date by now.

        Args:
            source: where the values come from, such as ``temperature``.
            columns: values by name of a session's column.
            at_s: time of the reading, s, monotonic clock; None: now.
        """
        if not all(math.isfinite(value) for value in columns.values()):
            self.node.tally.count_dropped(source, f"{source}: {columns} is not finite")
            return
        wrong = ""
        try:
            for name, value in columns.items():
                check_circumstance(self.arm, name, value, source)
        except InputError as error:
            wrong = str(error)
            self.node.tally.count_dropped(source, wrong)
        at_s = time.monotonic() if at_s is None else at_s
        self.readings = self.readings.with_reading(source, columns, at_s, wrong=wrong)

    @property
    def joints(self) -> np.ndarray | None:
        """(n,) last joint reading, rad and m; None before the first."""
        held = self._joints
        return None if held is None else held[0]

    @property
    def doubt(self) -> str:
        """The reason why `joints` must not be used to move the arm; empty if they may be used."""
        held = self._joints
        if held is None:
            return self._trust.doubt or NO_JOINTS
        age_s = time.monotonic() - held[1]
        old = f"the last joint_states is {age_s:.1f} s old"
        return self._trust.doubt or (old if age_s > self._max_age_s else "")

    def _on_joints(self, message: JointState, info: Mapping[str, int | None]) -> None:
        try:
            q = joints_of(message, self.arm, "joint_states")
        except InputError as error:
            self.node.tally.count_dropped("joint_states", str(error))
            return
        stamp, now = stamp_ns(message.header.stamp), time.monotonic()
        self._trust.heard(info["publication_sequence_number"], now)
        if stamp and (why := describe_untimely(self.node.get_clock(), stamp, self._max_age_s)):
            self._trust.distrust(f"joint_states are doubtful: the last {why}")
        elif self._trust.read(q, 1e-9 * stamp if stamp else now):
            self._joints, self.effort = (q, now), efforts_of(message, self.arm)
            at_s = 1e-9 * told_ns(message.header.stamp, round(1e9 * self.now_s))
            for listen in self.joint_listeners:
                listen(q, at_s)
            return
        self.node.tally.count("doubtful joint_states", self._trust.doubt)


_TAKING = (DriverState.READY, DriverState.MOVING)
_MOVED = 2e-2
"""A joint that is this far (rad, m) from its last end was moved: encoder noise is smaller."""


class DriverLink:
    """The link to the driver: subscribes to the driver's topics, and keeps the joints' history.

    A trajectory counts as a command once the driver has accepted it. If the driver sends no
    acknowledgements, every trajectory on `joint_trajectory` counts.

    Attributes:
        history: history of the joints as it will be at the end of the last command.
        command_listeners: called on the worker with the joints (n,) of every command and their
            history on arrival.
        motion_listeners: called on the worker with every message on `motion`.
    """

    def __init__(self, state: ArmState) -> None:
        self._arm, self._arm_state = state.arm, state
        self._count_dropped = state.node.tally.count_dropped
        self.acknowledged = state.p["acknowledged"]
        self.command_listeners: list[Callable[[np.ndarray, History], object]] = []
        self.motion_listeners: list[Callable[[Motion], object]] = []
        self.history = History.unknown(state.arm.n)
        self._end: np.ndarray | None = None
        self._arrived = self._left = False
        self._state: DriverState | None = None
        self._heard_s = self._rival_s = -DRIVER_SILENT_S
        self._stopped_s = -math.inf  # when the arm was last known to be stopped, sleepless s
        self._known: set[str] = set()
        self._asked, self._answer = "", None
        hear = state.worker.hear  # so that messages are processed before the next target
        if self.acknowledged:
            hear(graph.MOTION, self._on_motion)
            hear(graph.DRIVER_STATE, self._on_state, depth=100)  # also a stop that ended meanwhile
        else:
            hear(graph.JOINT_TRAJECTORY, self._on_trajectory)

    @property
    def refusal(self) -> str:
        """The reason why nothing can be sent now; always empty without acknowledgements."""
        if not self.acknowledged:
            return ""
        now, state = time.monotonic(), self._state
        if state is None:
            return "no servo_driver is on the graph"
        if now - self._rival_s < DRIVER_SILENT_S:
            return TWO_DRIVERS
        if now - self._heard_s > DRIVER_SILENT_S:
            return f"servo_driver has been silent for {now - self._heard_s:.0f} s"
        if state.state not in _TAKING:
            why = f": {state.message}" if state.message else ""
            return f"servo_driver is {driver_words(state.state).partition(':')[0]}{why}"
        return ""

    def overtaken(self, sent_s: float) -> str:
        """Say that a stop came after what was asked at ``sent_s`` (sleepless s); empty if none did.

        It must not move the arm once that goes on: who asked did not know of the stop.
        """
        if sent_s > self._stopped_s:
            return ""
        return self.refusal or "the arm was stopped after this was asked: ask again"

    def expect(self, name: str) -> None:
        """Expect from now on the acknowledgement of the trajectory with this id."""
        self._asked, self._answer = name, None

    @property
    def rests_at(self) -> np.ndarray | None:
        """(n,) where the arm was sent and rests, rad and m (it may yield below it); or None."""
        return self._end if self._arrived and not self._left else None

    @property
    def has_answered(self) -> bool:
        """True once the trajectory that `expect` names is answered, or if answers do not come."""
        return self._answer is not None or not self.acknowledged

    @property
    def not_accepted(self) -> str:
        """The reason why the driver has not accepted the expected trajectory; empty if it has."""
        if not self.acknowledged:
            return ""
        if self._answer is None:
            return "sent, but not acknowledged by the driver in time, so it was withdrawn"
        refused = self._answer.event == Motion.REFUSED
        return f"the driver refused it: {self._answer.message}" if refused else ""

    def _on_motion(self, message: Motion, sent: float | None) -> None:
        if message.event == Motion.ACCEPTED:
            try:
                start, path = motion_of(message, self._arm)
            except InputError as error:
                self._count_dropped("motion", str(error))
                self.forget_history()
            else:
                self.note_motion(path, start)
        elif message.event == Motion.REACHED:
            self._arrived = True
        elif message.event in (Motion.REPLACED, Motion.BROKEN_OFF):
            self.forget_history()
        if message.id == self._asked and message.event in (Motion.ACCEPTED, Motion.REFUSED):
            self._answer = message
        for listen in self.motion_listeners:
            listen(message)

    def _on_trajectory(self, message: JointTrajectory, sent: float | None) -> None:
        try:
            path = path_of(message, self._arm)
        except InputError as error:
            self._count_dropped("joint_trajectory", str(error))
            return
        self.note_motion(path, self._end if self._end is not None else self._arm_state.joints)

    def note_motion(self, path: np.ndarray, start: np.ndarray | None) -> None:
        """Note that the joints (rad, m) move from a start (n,), if known, along a path (k, n)."""
        self.history = self.history.after(path, start)
        self._end, self._arrived, self._left = path[-1], False, False
        for listen in self.command_listeners:
            listen(path[-1], self.history)

    def forget_history(self) -> None:
        """Mark the history of the joints as unknown."""
        self.history, self._end = History.unknown(self._arm.n), None
        self._arrived = self._left = False

    def on_joints(self, q: np.ndarray, at_s: float) -> None:
        """Forget the history if the joints (n,) leave the end of the last command.

        Only without acknowledgements: that driver does not report that another program moves them.
        """
        end = self._end
        if self.acknowledged or end is None:
            return
        there = bool(np.abs(q - end).max() <= _MOVED)
        self._left = self._left or (self._arrived and not there)
        self._arrived = self._arrived or there
        if self._left:  # not if a command, received meanwhile on the worker, moves them
            self._arm_state.worker.submit_once(self._forget_if_moved)

    def _forget_if_moved(self) -> None:
        if self._left:
            self.forget_history()

    def _on_state(self, message: DriverState, sent: float | None) -> None:
        now, last, instance = time.monotonic(), self._state, message.instance
        known = last is not None and last.instance == instance
        if not known and instance in self._known:  # it reports again after another driver did
            if message.state == DriverState.UNCONFIGURED:
                return  # its last report, as it ends
            self._rival_s = now
        if not known:
            self._known.add(instance)
            self.forget_history()
        went_on = last is not None and known and last.stops == message.stops
        if not went_on or message.state not in _TAKING:
            self._stopped_s = sleepless_s()  # the driver's clock may be behind
        self._state, self._heard_s = message, now

    def report(self) -> Report:
        if not self.acknowledged:
            return Report(OK, UNACKNOWLEDGED)
        if why := self.refusal:
            return Report(ERROR if self._rival_s > self._heard_s - DRIVER_SILENT_S else WARN, why)
        return Report(OK, "the driver takes trajectories")
