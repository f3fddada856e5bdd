"""The targets of `kinematics`, however they come: in their order, each with exactly one story."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.task import Future

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.compensate import Status
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.compensator import Compensator
from longarm_comp.nodes.driver_link import DriverLink
from longarm_comp.nodes.health import ERROR, OK, WARN, Report, Tally
from longarm_comp.nodes.messages import (
    Answer,
    compensation_message,
    response_of,
    trajectory_message,
)
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.stamps import stamp_ns
from longarm_comp.nodes.worker import Worker
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("position_only", False, "targets on target_pose leave the orientation free", live=True),
    Param("target_max_age_s", 5.0, "targets with an older stamp are refused", 0.01, 1e6),
    Param("move_time_s", 0.5, "asked of the driver, which slows down to its limits", 0.0, 600.0),
    Param("acknowledge_s", 2.0, "patience with the driver's acknowledgement", 0.01, 60.0),
)


@dataclass
class Request:
    """One target in work: its id, the request, why it is stale (empty if not), and its answer."""

    name: str
    message: Compensate.Request
    stale: str
    answer: Answer | None = None
    sent: bool = False
    accepted: bool = False


class TargetInlet:
    """Takes targets of the topic, the service and the action, and answers them on a worker.

    The latest target on the topic wins: one that waits is answered with SUPERSEDED when another
    one comes. The service and the action keep their order.

    Args:
        node, arm, p: the node, its arm and the values of its parameters.
        base_frame: full name of the frame that answers are given in.
        worker: computes the answers, one after another.
        compensator, driver, state: what answers, who moves the arm, what is known of it.
        tally: of targets by their status.
        answered: called with every answer.
        aimed: called with joints (n,) that were accepted and their target (3,), m.
        succeeded: called after every target that was computed.
    """

    def __init__(
        self, node: Node, arm: Arm, p: dict[str, Any], base_frame: str, worker: Worker,
        compensator: Compensator, driver: DriverLink, state: ArmState, tally: Tally,
        answered: Callable[[Answer], None], aimed: Callable[[np.ndarray, np.ndarray], None],
        succeeded: Callable[[], None],
    ) -> None:  # fmt: skip
        self._node, self._arm, self._base_frame = node, arm, base_frame
        self._worker, self._compensator, self._driver = worker, compensator, driver
        self._state, self._tally = state, tally
        self._answered, self._aimed, self._succeeded = answered, aimed, succeeded
        self._move_time_s, self._acknowledge_s = p["move_time_s"], p["acknowledge_s"]
        self._max_age_s = p["target_max_age_s"]
        self._run, self._numbers = uuid.uuid4().hex[:8], itertools.count(1)
        self._latest: Request | None = None
        self._broken = ""  # the last fault of this software, until a target succeeds
        self._trajectory = graph.JOINT_TRAJECTORY.publisher(node)
        self._compensation = graph.COMPENSATION.publisher(node)
        worker.inlets.hear(graph.TARGET_POSE, self._on_target)
        worker.inlets.serve(graph.COMPENSATE, self._on_compensate)

    def asked(self, message: Compensate.Request) -> Request:
        """A target that comes in now."""
        stamp = stamp_ns(message.target.header.stamp)
        why = self._state.untimely(stamp, self._max_age_s) if stamp else ""
        return Request(f"{self._run}-{next(self._numbers)}", message, why)

    def _on_target(self, message: PoseStamped) -> None:
        free = self._node.get_parameter("position_only").value
        request = self.asked(Compensate.Request(target=message, position_only=free, execute=True))
        earlier, self._latest = self._latest, request
        if earlier is not None:  # its turn is taken over
            self._refuse(earlier, Status.SUPERSEDED, "a later target came before it was begun")
            self._publish_answer(earlier)
        elif not self._worker.submit(self._serve_latest):
            self._latest = None
            self._refuse_busy(request)

    def _serve_latest(self) -> None:
        request, self._latest = self._latest, None
        if request is not None:
            self._serve(request)
            self._publish_answer(request)

    def _on_compensate(
        self, message: Compensate.Request, reply: Callable[[Compensate.Response], None]
    ) -> None:
        request = self.asked(message)

        def answer() -> None:
            try:
                reply(response_of(self._serve(request), self._arm, self._base_frame))
            finally:  # published even when the client is gone
                self._publish_answer(request)

        if not self._worker.submit(answer):
            reply(response_of(self._refuse_busy(request), self._arm, self._base_frame))

    def execute(self, request: Request) -> Future | None:
        """Compute and send a target in its turn: its `Answer`; None where too many wait."""

        def serve() -> Answer:
            try:
                return self._serve(request)
            finally:
                self._publish_answer(request)

        return self._worker.ask(serve)

    def _refuse_busy(self, request: Request) -> Answer:
        waiting = f"{self._worker.waiting} targets wait already"
        answer = self._refuse(request, Status.NOT_READY, waiting)
        self._publish_answer(request)
        return answer

    def _refuse(self, request: Request, status: Status, why: str) -> Answer:
        request.answer = self._compensator.refused(request.name, request.message, status, why)
        return request.answer

    def _serve(self, request: Request) -> Answer:
        """Compute and send, on the worker's thread. The caller publishes the answer afterwards."""
        if request.stale:
            why = f"the target's stamp {request.stale}, allowed {self._max_age_s:g} s"
            return self._refuse(request, Status.STALE_TARGET, why)
        request.answer = self._compensator.answer(request.name, request.message)
        if request.message.execute and request.answer.status.success:
            request.answer = self._send(request, request.answer)
        return request.answer

    def _send(self, request: Request, answer: Answer) -> Answer:
        """Send the joints and wait for the driver to say whether it takes them."""
        assert answer.arrival is not None
        self._driver.expect(request.name)
        self._trajectory.publish(
            trajectory_message(
                self._arm, answer.arrival.move.points, self._move_time_s, request.name
            )
        )
        request.sent = True
        self._worker.take(lambda: self._driver.answered, self._acknowledge_s)
        why = self._driver.not_accepted
        if why:
            return replace(answer, status=Status.NOT_ACCEPTED, message=why)
        request.accepted = True
        outcome = answer.arrival.outcome
        self._aimed(outcome.command, outcome.position)
        return answer

    def _publish_answer(self, request: Request) -> None:
        answer = request.answer
        if answer is None:
            return
        self._compensation.publish(
            compensation_message(
                answer, self._arm, self._base_frame,
                executed=request.sent, accepted=request.accepted,
            )
        )  # fmt: skip
        self._answered(answer)
        if answer.status is Status.INTERNAL_ERROR:
            self._broken = answer.message
        elif answer.status.success:
            self._broken = ""
            self._succeeded()
        self._tally.count(
            answer.status.name, "" if answer.status is Status.SUCCESS else answer.message
        )

    def halt(self, name: str) -> None:
        """Stop the arm smoothly: a trajectory without points."""
        self._trajectory.publish(trajectory_message(self._arm, np.empty((0, 0)), 0.0, name))

    # ------------------------------------------------------------------ diagnostics

    def report(self) -> Report:
        """What became of the targets, for diagnostics."""
        facts: dict[str, object] = {
            **self._tally.counts,
            "waiting": self._worker.waiting,
            "last refusal": self._tally.last,
            "lost on the way": self._worker.inlets.lost,
            "publishers of another QoS": self._worker.inlets.unfit,
        }
        if self._state.doubt:
            return Report(WARN, self._state.doubt, facts)
        if self._broken:
            return Report(ERROR, self._broken, facts)
        if not self._compensator.learned:
            return Report(WARN, "no error_predictor answers: physics only", facts)
        return Report(OK, "compensating", facts)
