"""Monitors of the tip: compares joint readings and sightings with predictions and targets."""

import contextlib
import shlex
import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.frame_tree import carry_place, turned_covariance
from longarm_comp.core.arm.history import SAME_POSE, History
from longarm_comp.core.compensation.drift import Monitor, Verdict
from longarm_comp.core.compensation.expansion import Expansion
from longarm_comp.core.compensation.expected import TipByReadings, tip_by_readings
from longarm_comp.core.compensation.repeating import RepeatingErrors
from longarm_comp.core.data.rest import JOINT_REST, RestPose, RestWatch
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.ring import MoveRing, ring_after
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.clock import told_ns
from longarm_comp.nodes.health import OK, WARN, Report
from longarm_comp.nodes.messages import check_sighting, motion_of, seconds, sighting_of, tip_message
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.predictor_client import NoAnswer
from longarm_interfaces.msg import Motion

PARAMS = (
    Param("readings.period_s", 1.0, "time between two tip_by_readings; 0: none", 0.0, 60.0),
    Param("monitor.settle_s", 0.5, "time at rest before the tip is measured", 0.0, 60.0),
    Param("monitor.sightings", 3, "sightings averaged at a rest pose", 1, 1000),
    Param(
        "monitor.sigma_m",
        0.0,
        "expected error per axis without a predictor; 0: as the model promises, 1 mm at least",
        0.0,
        1.0,
    ),
    Param("monitor.run_length", 10000.0, "at most one false alarm in so many rest poses", 2.0, 1e9),
)


class ReadingsTeller:
    """Publishes the tip, computed on the worker from the joints' readings, while the arm rests."""

    def __init__(self, state: ArmState) -> None:
        self._state = state
        self.last: TipByReadings | None = None
        self._before: np.ndarray | None = None
        self._tips = graph.TIP_BY_READINGS.publisher(state.node)
        state.node.every("readings.period_s", self._queue_tip)

    def _queue_tip(self) -> None:
        """Queue the computation if the arm rests; at most one waits, so targets are not delayed."""
        now = self._state.standing
        q, before = None if now is None else now[1], self._before
        self._before = q
        if q is not None and before is not None and np.abs(q - before).max() <= JOINT_REST:
            self._state.worker.submit_once(self.tell)

    def tell(self) -> TipByReadings | None:
        """Compute, publish and return the tip; None while joints or circumstances are not known."""
        now = self._state.standing
        if now is None:
            return None
        state, (model, q, context) = self._state, now
        stands = state.files.loaded.stands
        found = tip_by_readings(stands.promising(model), q, context)
        found = self.last = replace(found, tip=stands.carry_from_model(found.tip))
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.nan_to_num(found.doubt.covariance)
        covariance = turned_covariance(stands.carry_from_model(np.eye(4)), covariance)
        self._tips.publish(tip_message(found.tip, covariance, state.stamp, state.base_frame))
        return found

    def report(self) -> Report:
        return Report(OK, "not known yet" if self.last is None else self.last.describe())


_LEAST_M = 1e-3
"""Smallest expected error per axis, m, of the monitor if `monitor.sigma_m` is not set."""

EVIDENCE = "evidence (1 warns)"
"""Name of the fact on /diagnostics that says how close a test is to a warning."""


def _test_facts(counted: str, verdict: Verdict) -> dict[str, object]:
    """Return the facts of a sequential test; ``counted``: name of its samples."""
    return {counted: verdict.samples, EVIDENCE: round(verdict.evidence, 3)}


def _format_mm(vector: np.ndarray) -> str:
    return " ".join(f"{1e3 * value:+.2f}" for value in vector) + " mm"


@dataclass(frozen=True, eq=False)
class Sighted:
    """The tip seen at rest at a target."""

    q: np.ndarray  # (n,) joints of the command, rad and m
    tip: np.ndarray  # (3,) m, in the base frame
    miss: np.ndarray  # (3,) m, tip - target, without biases


class TipMonitor:
    """Collects rest poses and tests their residuals.

    The ``on_...`` methods may be called from any thread; `judge` only on the worker's.

    Attributes:
        sighted: the last tip seen at rest at a target.
        unplaced: why sightings cannot be expressed in the frame of the model; empty if they can.
    """

    def __init__(self, state: ArmState) -> None:
        self._state, p = state, state.p
        self._watch = RestWatch(p["monitor.settle_s"], p["monitor.sightings"])
        self._feeding = threading.Lock()
        self._sigma_m, self._run_length = p["monitor.sigma_m"], p["monitor.run_length"]
        self.reset()
        self._sent: np.ndarray | None = None
        self._under_way = ""
        self._aim: tuple[np.ndarray, np.ndarray] | None = None
        self.sighted: Sighted | None = None
        self.unplaced = ""
        self._last = "no rest pose measured yet"
        self._last_miss = "no target measured yet"
        self._outside = 0

    def reset(self) -> None:
        """Begin all tests anew."""
        self._servos = Monitor(self._run_length)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Begin the tests of the tip anew: the model is another one."""
        self._monitor = self._at_target = Monitor(self._run_length)
        self._repeating: RepeatingErrors | None = None

    def aim_at(self, q: np.ndarray, target: np.ndarray) -> None:
        """Note a command: joints (n,), rad and m, that bring the tip to ``target`` (3,), m."""
        self._aim = q, target

    def on_command(self, q: np.ndarray, history: History) -> None:
        """Note a command: joints (n,) and their history on arrival."""
        self._sent = q
        with self._feeding:
            self._watch.on_command(q, history)

    def on_motion(self, motion: Motion) -> None:
        """Note a message of the driver about the present command."""
        if motion.event == Motion.ACCEPTED:
            self._under_way = motion.id
        if motion.id != self._under_way:
            return
        with self._feeding:
            if motion.event == Motion.REACHED:
                self._watch.on_arrival(self._state.now_s)  # not its stamp: clocks may differ
            elif motion.event in (Motion.REPLACED, Motion.BROKEN_OFF):
                self._watch.forget()

    def on_joints(self, q: np.ndarray, at_s: float) -> None:
        """Add a joint reading (n,), rad and m, of the time ``at_s`` (ROS clock, s)."""
        with self._feeding:
            self._watch.joints(q, at_s)

    def on_tip(self, message: PoseWithCovarianceStamped) -> RestPose | None:
        """Add a sighting, in the model's frame; return the rest pose that it completes, if any.

        It belongs to the time of its stamp, because images of a moving arm may come late.
        """
        tip, variance = sighting_of(message)
        try:
            check_sighting(tip, variance)
        except InputError as error:
            self._state.node.tally.count_dropped("tip_measured", str(error))
            return None
        taken_s = 1e-9 * told_ns(message.header.stamp, round(1e9 * self._state.now_s))
        with self._feeding:
            return self._watch.on_sighting(tip, variance, taken_s)

    def judge(self, rest: RestPose, model: Model, context: Context) -> Expansion | None:
        """Add a rest pose to the sequential tests.

        Returns:
            The answer of the predictor; None if no predictor answers, or if the rest pose is not
            used (outside the domain, or a residual that is not finite).
        """
        missed, learned = self._miss_at_target(rest, model, context), None
        with contextlib.suppress(NoAnswer):
            learned = self._state.predictor.ask(rest.q, context)
            if not learned.in_domain:
                self._outside += 1
                return None
        seen = rest.tip if learned is None else rest.tip - learned.error
        residual = seen - model.measured(rest.q, context)
        if not np.isfinite(residual).all():
            why = f"the residual at a rest is {residual.tolist()}"
            self._state.node.tally.count_dropped("rest", why)
            return None
        self._last = f"residual {_format_mm(residual)}"
        if missed is not None:
            self._last_miss = f"tip - target {_format_mm(missed)}"
        if self._sigma_m and learned is None:
            given = np.full(3, self._sigma_m)
            self._monitor = self._monitor.seen(residual, given)
            if missed is not None:
                self._at_target = self._at_target.seen(missed, given)
            return None
        if self._repeating is None:
            self._repeating = RepeatingErrors.of(model)
        sigma = None if learned is None else learned.sigma
        least_m = _LEAST_M if learned is None else 0.0
        found = self._repeating.compare(rest.q, context, seen, rest.variance, sigma)
        self._monitor = self._monitor.seen(found.off, found.spread(least_m))
        if missed is not None:
            stands = self._state.files.loaded.stands
            missed = missed - stands.turn_from_model(residual - found.off)  # what was expected
            spread = found.spread(least_m, stands.motion[:3, :3].T)
            self._at_target = self._at_target.seen(missed, spread)
        if not self._monitor.verdict().drifted:  # what a changed arm does is no error of the model
            self._repeating = found.after
        return learned

    def _miss_at_target(self, rest: RestPose, model: Model, context: Context) -> np.ndarray | None:
        """Return tip - target (3,), m, without biases; None if the arm rests at no target."""
        if self._aim is None or np.abs(rest.q - self._aim[0]).max() >= SAME_POSE:
            return None
        seen_beside = model.measured(rest.q, context) - model.tip(rest.q, context)
        stands = self._state.files.loaded.stands
        missed = stands.carry_from_model(rest.tip - seen_beside) - self._aim[1]
        self.sighted = Sighted(rest.q, carry_place(stands.measurements, rest.tip), missed)
        return missed

    def judge_servos(self, model: Model, read: np.ndarray, context: Context) -> None:
        """Compare the tip by the readings (n,) at a move's end with the tip by the command."""
        if self._sent is None:
            return
        promised = model.tip(self._sent, context)
        off = tip_by_readings(model, read, context).tip - promised
        self._servos = self._servos.seen(off, np.full(3, self._sigma_m or _LEAST_M))

    def servo_report(self) -> Report:
        """Report whether the joints' readings agree with the commands."""
        verdict = self._servos.verdict()
        facts = _test_facts("moves", verdict)
        if verdict.drifted:
            differ = "the joints' readings differ from the commands"
            return Report(WARN, f"{differ}: {verdict.finding}", facts)
        return Report(OK, "joints stand where they were sent", facts)

    def target_report(self) -> Report:
        """Report whether tips come to rest at their targets."""
        verdict = self._at_target.verdict()
        facts = _test_facts("targets", verdict) | {"last": self._last_miss}
        if not verdict.drifted:
            return Report(OK, "tips come to rest at their targets", facts)
        if self._monitor.verdict().drifted:
            alike = "the tip misses target and prediction alike"
            return Report(WARN, f"{alike}: {verdict.finding}", facts)
        cause = "the predictions are right, so the commands were computed for other circumstances"
        return Report(WARN, f"beside the target: {verdict.finding}; {cause}", facts)

    @property
    def _advised_commands(self) -> str:
        """The shell commands that find the cause of a drift: plan poses, collect, diagnose."""
        state = self._state
        arm, model = (shlex.quote(state.p[name]) for name in ("arm", "model"))
        where = state.node.get_namespace().strip("/")
        inside = f" --namespace {where}" if where else ""
        known = f" --model {model}" if state.files.loaded.file_hash else ""
        return (
            f"longarm plan {arm} --kind sobol -n 60 -o poses.csv && "
            f"longarm collect {arm} poses.csv -o session{inside} && "
            f"longarm diagnose {arm} session{known} -o diagnosis"
        )

    def report(self) -> Report:
        verdict = self._monitor.verdict()
        outside = {"last": self._last, "outside the training data": self._outside}
        facts = _test_facts("rest poses", verdict) | outside
        if verdict.drifted:
            return Report(WARN, f"{verdict.finding}; run: {self._advised_commands}", facts)
        if self.unplaced:
            return Report(OK, self.unplaced, facts)
        return Report(OK, "residuals are as expected", facts)


class RingTeller:
    """Computes how the arm rings after a move, on the worker when no other job waits."""

    def __init__(self, state: ArmState, shaped: bool) -> None:
        self._state, self._shaped = state, shaped
        self._move: Any = None
        self._due: Any = None  # the move whose ring is still to be computed
        self._last: MoveRing | None = None
        self._said = "not known, because no move has ended"
        if not state.driver.acknowledged:
            self._said = "not known, because the driver does not say when it ends"

    def on_motion(self, motion: Motion) -> None:
        if motion.event == Motion.ACCEPTED:
            self._move, self._due = motion, None
        elif motion.event == Motion.REACHED and self._move is not None:
            if self._move.id == motion.id:
                self._due = self._move
                self._begin_ring()
        elif motion.event in (Motion.REPLACED, Motion.BROKEN_OFF):
            self._move, self._due, self._last = None, None, None
            self._said = "not known, because it did not end at rest"

    def _begin_ring(self) -> None:
        if self._due is not None and not self._state.worker.waiting:
            self._state.worker.submit_once(self._compute_ring)

    def _compute_ring(self) -> None:
        state, context, move = self._state, self._state.known_context(), self._due
        if move is None or context is None:
            return
        self._due = None
        try:
            start, points = motion_of(move, state.arm)
        except InputError:
            return  # `DriverLink` has reported it
        times = np.array([seconds(point.time_from_start) for point in move.points])
        self._last = ring_after(state.files.loaded.model, context, start, points, times)
        if self._last is None:
            self._said = "by this model nothing bends"
        elif self._shaped:
            self._said = f"{self._last.hz:.2g} Hz; moves are shaped, little of the ring is left"
        else:
            self._said = self._last.describe()

    def report(self) -> Report:
        """Return a report on the last ring; first queue the computation of a ring that is due."""
        self._begin_ring()
        facts: dict[str, object] = {}
        if (ring := self._last) is not None and not self._shaped:
            facts = {"frequency [Hz]": ring.hz, "size [m]": ring.size_m}
            facts |= {"settles in [s]": ring.settle_s, "damping": ring.damping}
        return Report(OK, self._said, facts)
