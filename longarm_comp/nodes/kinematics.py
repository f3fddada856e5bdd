"""`kinematics`: a target in, compensated joints out; publishes how they were computed."""

from __future__ import annotations

import os
import sys
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.compensate import Status
from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.effects.catalogue import load_file
from longarm_comp.core.ik import solver as ik
from longarm_comp.nodes import compensator, markers, monitoring, reach
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import NO_JOINTS, ArmState
from longarm_comp.nodes.compensator import Compensator
from longarm_comp.nodes.driver_link import DriverLink
from longarm_comp.nodes.health import ERROR, OK, PERIOD, WARN, Health, Report
from longarm_comp.nodes.markers import Markers
from longarm_comp.nodes.messages import (
    Answer,
    compensation_message,
    response_of,
    trajectory_message,
)
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.monitoring import Sighted, TipMonitor
from longarm_comp.nodes.params import Param, declare
from longarm_comp.nodes.predictor_client import PredictorClient
from longarm_comp.nodes.reach import ReachServer
from longarm_comp.nodes.runner import run
from longarm_comp.nodes.watch import FileWatch
from longarm_comp.nodes.worker import ManualCallbackGroup, Worker
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm"),
    Param("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    Param("effects", "", "Python files that define further effects, executed; : between paths"),
    Param("base_frame", "base", "frame that targets and measurements are given in"),
    *compensator.PARAMS,
    Param("position_only", False, "targets on target_pose leave the orientation free", live=True),
    Param("move_time_s", 0.5, "asked of the driver, which slows down to its limits", 0.0, 600.0),
    Param("acknowledged", True, "the driver says what becomes of a trajectory (docs/ros.md)"),
    Param("acknowledge_s", 2.0, "patience with the driver's acknowledgement", 0.01, 60.0),
    Param("predictor_timeout_s", 0.5, "no answer within it counts as no predictor", 0.01, 60.0),
    Param("compiled", True, "compile the search (needs llvmlite; about a second a model)"),
    Param("queue", 200, "targets that may wait", 1, 10000),
    Param("watch_period_s", 1.0, "how often the file is looked at for a new version", 0.1, 3600.0),
    *reach.PARAMS,
    *monitoring.PARAMS,
    *markers.PARAMS,
    PERIOD,
)


@dataclass
class _Request:
    """One target in work: its id, the request, its answer, and whether the joints were sent."""

    name: str
    message: Compensate.Request
    answer: Answer | None = None
    sent: bool = False
    accepted: bool = False


class Kinematics(Node):
    """Computes one target after another on a worker thread, so that the executor stays free."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__("kinematics", automatically_declare_parameters_from_overrides=True)
        p = declare(self, PARAMS)
        for path in filter(None, p["effects"].split(os.pathsep)):
            load_file(path)
        self._files = ModelFiles(p["arm"], p["model"])
        self._arm = self._files.arm
        self._base_frame = p["base_frame"]
        self._max_age_s = p["context_max_age_s"]
        self._move_time_s, self._acknowledge_s = p["move_time_s"], p["acknowledge_s"]
        self._counts: dict[str, int] = {}
        self._last = ""
        self._run, self._number = uuid.uuid4().hex[:8], 0
        self._worker = Worker(self, executor, p["queue"], self.survived)
        self._predictor = PredictorClient(self, self._arm, p["predictor_timeout_s"])
        self._trajectory = graph.JOINT_TRAJECTORY.publisher(self)
        self._compensation = graph.COMPENSATION.publisher(self)
        self._monitor = TipMonitor(
            self._predictor, p["monitor.settle_s"], p["monitor.sightings"], p["monitor.sigma_m"],
            p["monitor.run_length"],
            lambda: monitoring.advice(
                p["arm"], p["model"] if self._files.loaded.file_hash else "", self.get_namespace()
            ),
        )  # fmt: skip
        self._markers = Markers(self, self._base_frame)
        self._state = ArmState(self, self._arm, self._count, self._monitor.on_joints)
        self._reach = ReachServer(self, self._arm, self, p["reach.feedback_s"], p["reach.look_s"])
        self._driver = DriverLink(
            self, self._arm, acknowledged=p["acknowledged"], joints=lambda: self._state.joints,
            commanded=self._monitor.on_command, told=self._reach.told, refused=self._count,
        )  # fmt: skip
        self._compensator = Compensator(
            self, p, self._files, self._state, self._predictor, self._driver, self.survived
        )
        self._tips = graph.TIP_MEASURED.subscription(self, self._on_tip)
        graph.RELOAD.server(self, self._on_reload, ReentrantCallbackGroup())
        self._watch = FileWatch((p["model"],))
        self.create_timer(p["watch_period_s"], self._look)
        if p["markers.period_s"]:
            self.create_timer(p["markers.period_s"], self._draw)
        parts = {
            "targets": self._targets_report,
            "driver": self._driver.report,
            "model": self._files.report,
            "monitor": self._monitor.report,
            "at the target": self._monitor.target_report,
        }
        self._health = Health(self, parts, p[PERIOD.name])
        if p["compiled"]:  # in the background: targets are solved more slowly until it is done
            threading.Thread(target=ik.warm_up, name="compiler", daemon=True).start()
        on_worker = ManualCallbackGroup()
        self._worker.start(
            [
                *self._driver.inlets,
                graph.TARGET_POSE.subscription(self, self._on_target, on_worker),
            ],
            [graph.COMPENSATE.server(self, self._on_compensate, on_worker)],
        )

    def close(self) -> None:
        """Stop the worker."""
        self._worker.close()
        self._predictor.close()

    def survived(self, error: Exception) -> None:
        """Count an exception that a callback raised."""
        self._health.fault(error)

    # ------------------------------------------------------------------ requests

    def _request(self, message: Compensate.Request) -> _Request:
        self._number += 1
        return _Request(f"{self._run}-{self._number}", message)

    def _on_target(self, message: PoseStamped) -> None:
        free = self.get_parameter("position_only").value
        request = self._request(
            Compensate.Request(target=message, position_only=free, execute=True)
        )

        def serve() -> None:
            self._serve(request)
            self._publish_answer(request)

        if not self._worker.submit(serve):
            self._refuse_busy(request)

    def _on_compensate(
        self, message: Compensate.Request, reply: Callable[[Compensate.Response], None]
    ) -> None:
        request = self._request(message)

        def answer() -> None:
            try:
                reply(response_of(self._serve(request), self._arm, self._base_frame))
            finally:  # published even when the client is gone
                self._publish_answer(request)

        if not self._worker.submit(answer):
            reply(response_of(self._refuse_busy(request), self._arm, self._base_frame))

    def execute(self, message: Compensate.Request) -> Future | None:
        """Compute and send a target in its turn, for the action: its `Answer`."""

        def serve() -> Answer:
            request = self._request(message)
            self._reach.follow(request.name)
            try:
                return self._serve(request)
            finally:
                self._publish_answer(request)

        return self._worker.ask(serve)

    def _refuse_busy(self, request: _Request) -> Answer:
        waiting = f"{self._worker.waiting} targets wait already"
        request.answer = self._compensator.refused(
            request.name, request.message, Status.NOT_READY, waiting
        )
        self._publish_answer(request)
        return request.answer

    def _serve(self, request: _Request) -> Answer:
        """Compute and send, on the worker's thread. The caller publishes the answer afterwards."""
        request.answer = self._compensator.answer(request.name, request.message)
        if request.message.execute and request.answer.status.success:
            request.answer = self._send(request, request.answer)
        return request.answer

    def _send(self, request: _Request, answer: Answer) -> Answer:
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
        self._monitor.aimed(outcome.command, outcome.position)
        return answer

    def _publish_answer(self, request: _Request) -> None:
        answer = request.answer
        if answer is None:
            return
        self._compensation.publish(
            compensation_message(
                answer, self._arm, self._base_frame,
                executed=request.sent, accepted=request.accepted,
            )
        )  # fmt: skip
        self._markers.on_answer(answer)
        self._count(answer.status.name, "" if answer.status is Status.SUCCESS else answer.message)

    # ------------------------------------------------------------------ for the action

    def halt(self, name: str) -> None:
        """Stop the arm smoothly: a trajectory without points."""
        self._trajectory.publish(trajectory_message(self._arm, np.empty((0, 0)), 0.0, name))

    @property
    def joints(self) -> np.ndarray | None:
        """(n,) last reading."""
        return self._state.joints

    @property
    def no_driver(self) -> str:
        """Why no driver will say that a move is done; empty where it does."""
        if not self._driver.acknowledged:
            return "the driver does not say what is reached: acknowledged is false"
        return self._driver.refusal

    @property
    def sees(self) -> bool:
        """Whether anybody publishes `tip_measured`."""
        return self._tips.get_publisher_count() > 0

    @property
    def sighted(self) -> Sighted | None:
        """The tip at the last target that the arm rested at."""
        return self._monitor.sighted

    # ------------------------------------------------------------------ files and monitoring

    def _reload(self) -> tuple[bool, str]:
        done = self._files.reload()
        self._monitor.reset()
        return done

    def _look(self) -> None:
        if self._watch.changed():
            self._worker.submit(self._reload)

    async def _on_reload(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        future = self._worker.ask(self._reload)
        if future is None:
            response.message = "too many targets wait"
            return response
        response.success, response.message = await future
        return response

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        self._markers.on_tip(message)
        rest = self._monitor.on_tip(message)
        context = None if rest is None else self._now_context(rest.history)
        if rest is not None and context is not None:
            model = self._files.loaded.model
            self._worker.submit(partial(self._monitor.judge, rest, model, context))

    def _now_context(self, history: History) -> Context | None:
        """Circumstances at this moment; None while one that the model needs is unknown."""
        model, now = self._files.loaded.model, time.monotonic()
        try:
            return self._state.readings.context(model, now, self._max_age_s, history)
        except StaleContext:
            return None

    def _draw(self) -> None:
        q, context = self._state.joints, self._now_context(self._driver.history)
        if q is None or context is None:
            return
        sag = self.get_parameter("markers.sag_factor").value
        error = self.get_parameter("markers.error_factor").value
        self._markers.publish(self._files.rigid, self._files.loaded.model, q, context, sag, error)

    def _count(self, what: str, why: str) -> None:
        self._counts[what] = self._counts.get(what, 0) + 1
        if why:
            self._last = why
            self.get_logger().warning(why, throttle_duration_sec=1.0)

    def _targets_report(self) -> Report:
        facts = {**self._counts, "waiting": self._worker.waiting, "last refusal": self._last}
        if self._state.joints is None:
            return Report(WARN, NO_JOINTS, facts)
        if self._counts.get(Status.INTERNAL_ERROR.name):
            return Report(ERROR, self._last, facts)
        if not self._predictor.present:
            return Report(WARN, "no error_predictor: compensating with physics only", facts)
        return Report(OK, "compensating", facts)


def main() -> None:
    """Run the node."""
    sys.exit(run(Kinematics))


if __name__ == "__main__":
    main()
