"""Answers the targets that `kinematics` receives: in order of arrival, each exactly once."""

import itertools
import math
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.task import Future
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.compensation.result import Method, Status
from longarm_comp.core.model.reduced_speed import REDUCED_SPEED, times_at_reduced_speed
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.answers import Answer, TargetRequest, compensation_message, response_of
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.clock import sleepless_s, stamp_ns
from longarm_comp.nodes.compensator import Compensator
from longarm_comp.nodes.drawing import Markers
from longarm_comp.nodes.health import ERROR, OK, WARN, Report
from longarm_comp.nodes.messages import trajectory_message
from longarm_comp.nodes.monitoring import TipMonitor
from longarm_comp.nodes.orders import Freshness, Stamps, describe_untimely, order_id
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.worker import Reply
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("position_only", False, "targets on target_pose leave the orientation free", live=True),
    Param("target_max_age_s", 5.0, "targets with an older stamp are refused", 0.01, 1e6),
    Param("move_time_s", 0.5, "time asked for a move; the driver may need longer", 0.0, 600.0),
    Param(
        "arm_speed",
        REDUCED_SPEED,
        "highest speed of any part of the arm where another program drives it, m/s",
        1e-3,
        100.0,
    ),
    Param("acknowledge_s", 2.0, "longest wait for the driver's acknowledgement", 0.01, 60.0),
)


class TargetInlet:
    """Receives targets from the topic, the service and the action, and answers them on a worker.

    Targets of the service and the action come first, in the order of arrival. On the topic the
    latest target wins: a waiting one is superseded by a later one. The answer to a superseded
    target is published when nothing else waits.
    """

    def __init__(
        self, state: ArmState, compensator: Compensator, monitor: TipMonitor, markers: Markers
    ) -> None:
        self._node, self._arm, self._base_frame = state.node, state.arm, state.base_frame
        self._worker, self._compensator, self._driver = state.worker, compensator, state.driver
        self._state, self._monitor, self._markers = state, monitor, markers
        self._max_age_s, node, worker = state.p["target_max_age_s"], state.node, state.worker
        self._run, self._numbers = uuid.uuid4().hex[:8], itertools.count(1)
        self._latest: tuple[PoseStamped, float] | None = None  # and when it was sent
        self._superseded: deque[tuple[PoseStamped, float]] = deque()
        self._unrecorded = 0
        self._fresh, self._stamps = Freshness(node, self._max_age_s), Stamps(node.get_clock())
        self._broken = ""  # the last fault of this software, until a target succeeds
        self._trajectory = graph.JOINT_TRAJECTORY.publisher(node)
        self._compensation = graph.COMPENSATION.publisher(node)
        self._withdrawals = graph.WITHDRAWN.publisher(node)
        self._withdrawn_s = -math.inf  # when all targets were withdrawn, sleepless s
        worker.hear(graph.TARGET_POSE, self._on_target)
        worker.hear(graph.WITHDRAWN, self._on_withdrawn)
        worker.serve(graph.COMPENSATE, self._on_compensate)
        for method in Method:
            answer = partial(self._on_compensate, method=method.value)
            worker.serve(graph.compensate_by(method.value), answer)

    def new_target(
        self, pose: PoseStamped, position_only: bool, sent_s: float | None = None, **others: Any
    ) -> TargetRequest:
        """Make the request of a target, with an id, and with ``others`` of its attributes.

        ``sent_s``: when it was sent (sleepless s), where that is known.
        """
        since = self._fresh.sent_s(pose.header.stamp, sent_s)
        name = f"{self._run}-{next(self._numbers)}"
        return TargetRequest(name, pose, position_only, since, **others)

    def stale(self, target: TargetRequest) -> str:
        """Say why a target is too old (or its stamp in the future); empty if it is not.

        The time since it was sent counts only for a target that is executed.
        """
        stamp = stamp_ns(target.pose.header.stamp)
        why = describe_untimely(self._node.get_clock(), stamp, self._max_age_s) if stamp else ""
        age_s = sleepless_s() - max(target.sent_s, target.turn_s)
        if target.execute and target.sent_s <= self._fresh.deaf_until_s:
            return "the target was sent before this node was away, and may be withdrawn: ask again"
        if not why and target.execute and age_s > self._max_age_s:
            return f"the target was sent {age_s:.1f} s ago, allowed {self._max_age_s:g} s"
        return why and f"the target's stamp {why}, allowed {self._max_age_s:g} s"

    def _on_target(self, message: PoseStamped, sent: float | None) -> None:
        if self._latest is not None:
            self._superseded.append(self._latest)
        if len(self._superseded) > graph.TARGET_POSE.depth:
            self._superseded.popleft()
            self._unrecorded += 1
        self._latest = message, self._fresh.sent_s(message.header.stamp, sent)

    def serve_topic(self) -> bool:
        """Answer the topic's latest target, else a superseded one; return whether there was one."""
        latest = self._latest is not None
        if not latest and not self._superseded:
            return False
        pose, sent = self._latest or self._superseded.popleft()
        self._latest = None
        free = self._node.get_parameter("position_only").value
        target = self.new_target(pose, free, sent)
        if latest:
            self._serve_target(target)
        else:
            why = "a later target came before work on it began"
            self._publish_answer(self._compensator.refuse(target, Status.SUPERSEDED, why))
        return True

    def _on_withdrawn(self, message: String, sent: float | None) -> None:
        if not message.data:
            self._withdrawn_s = sleepless_s()  # the clock of who withdrew them may be behind

    def _on_compensate(
        self, message: Compensate.Request, reply: Reply, sent: float | None, method: str = ""
    ) -> None:
        asked = {"execute": message.execute, "seed": message.seed, "method": method}
        target = self.new_target(message.target, message.position_only, sent, **asked)

        def respond(answer: Answer) -> None:
            reply(response_of(answer, self._arm, self._base_frame))

        if not self._worker.submit(partial(self._serve_target, target, respond)):
            waiting = f"{self._worker.waiting} targets wait already"
            refused = self._compensator.refuse(target, Status.NOT_READY, waiting)
            self._publish_answer(refused)
            respond(refused)

    def execute(self, target: TargetRequest) -> Future | None:
        """Queue a target; return the future of its `Answer`, or None if too many targets wait."""
        return self._worker.ask(partial(self._serve_target, target))

    def _serve_target(
        self, target: TargetRequest, respond: Callable[[Answer], None] = lambda answer: None
    ) -> Answer:
        """Compute a target, send its joints if it is executed, respond, then publish the answer."""
        answer: Answer | None = None
        try:
            answer = self._refuse_overtaken(target) or self._compensator.answer(target)
            arrival = answer.arrival if target.execute and answer.status.success else None
            if arrival is not None:
                stamp = self._stamps.next()  # before the checks: from here the driver counts
                self._worker.wait_until(lambda: True, 0.0)  # hear what came meanwhile
                if refused := self._refuse_overtaken(target):
                    answer = refused
                elif why := self._state.doubt:  # it arose while the joints were computed
                    answer = self._compensator.refuse(target, Status.NOT_READY, why)
                else:
                    message = self._make_order(arrival.move.points, stamp)
                    answer = replace(answer, order=order_id(message))
                    self._driver.expect(answer.name)
                    self._trajectory.publish(message)
                    patience_s = self._state.p["acknowledge_s"]
                    if (
                        not self._worker.wait_until(lambda: self._driver.has_answered, patience_s)
                        or target.sent_s <= self._withdrawn_s
                    ):
                        self._withdrawals.publish(String(data=answer.name))
                    if why := self._driver.not_accepted:
                        answer = replace(answer, status=Status.NOT_ACCEPTED, message=why)
                    else:
                        self._monitor.aim_at(arrival.outcome.command, arrival.outcome.position)
                        answer = replace(answer, accepted=True)
            respond(answer)
            return answer
        finally:  # published even when the client is gone
            if answer is not None:
                self._publish_answer(answer)

    def _refuse_overtaken(self, target: TargetRequest) -> Answer | None:
        """Refuse a target that is too old, or withdrawn, or asked before a stop; else None."""
        refuse = partial(self._compensator.refuse, target)
        if target.execute and (not target.wanted() or target.sent_s <= self._withdrawn_s):
            return refuse(Status.NOT_READY, "cancelled before anything was sent")
        if target.execute and (why := self._driver.overtaken(target.sent_s)):
            return refuse(Status.NO_DRIVER, f"not sent: {why}")
        why = self.stale(target)
        return refuse(Status.STALE_TARGET, why) if why else None

    def _make_order(self, points: np.ndarray, stamp: Time) -> JointTrajectory:
        """Make the trajectory through points (k, n), rad and m.

        Another driver than `servo_driver` may know no velocity limits, so it gets times at which no
        part of the arm exceeds the parameter `arm_speed`.
        """
        move_s, now = self._state.p["move_time_s"], self._state.joints
        if self._driver.acknowledged or now is None:
            return trajectory_message(self._arm, points, move_s, stamp)
        model, speed = self._state.files.loaded.model, self._state.p["arm_speed"]
        due = times_at_reduced_speed(model, now, points, move_s, speed)
        return trajectory_message(self._arm, points, due, stamp, np.zeros_like(points))

    def _publish_answer(self, answer: Answer) -> None:
        """Count the answer, then publish it, so that it is counted when a receiver sees it."""
        if answer.status is Status.INTERNAL_ERROR:
            self._broken = answer.message
        elif answer.status.success:
            self._broken = ""
            self._node.health.clear_fault()
        why = "" if answer.status is Status.SUCCESS else answer.message
        self._node.tally.count(answer.status.name, why)
        self._compensation.publish(compensation_message(answer, self._arm, self._base_frame))
        self._markers.on_answer(answer)

    def halt(self) -> str:
        """Stop the arm smoothly by a trajectory without points; return its id."""
        message = trajectory_message(self._arm, np.empty((0, 0)), 0.0, self._stamps.next())
        self._trajectory.publish(message)
        return order_id(message)

    def report(self) -> Report:
        facts: dict[str, object] = {
            **self._node.tally.facts,
            "waiting": self._worker.waiting + (self._latest is not None),
            "superseded, not told yet": len(self._superseded),
            "superseded; its fate was not recorded": self._unrecorded,
            "lost on the way": self._worker.lost_messages,
        }
        if self._state.doubt:
            return Report(WARN, self._state.doubt, facts)
        if self._broken:
            return Report(ERROR, self._broken, facts)
        if not self._state.predictor.answers:
            return Report(WARN, "no error_predictor answers: physics only", facts)
        return Report(OK, "compensating", facts)
