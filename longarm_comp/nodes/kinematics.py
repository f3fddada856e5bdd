"""`kinematics`: a target in, compensated joints out; publishes how they were computed."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.compensate import Method, Settling, Status
from longarm_comp.core.compensation.online import CompensationOptions, StaleContext, compensate_now
from longarm_comp.core.effects.catalogue import load_file
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.learn.expansion import Nearby
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import markers, monitoring
from longarm_comp.nodes.arm_state import NO_JOINTS, ArmState
from longarm_comp.nodes.health import ERROR, OK, PERIOD, WARN, Health, Report
from longarm_comp.nodes.markers import Markers
from longarm_comp.nodes.messages import (
    Answer,
    FileHashes,
    Refusal,
    compensation_message,
    joints_of,
    response_of,
    target_of,
    trajectory_message,
)
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.monitoring import TipMonitor
from longarm_comp.nodes.params import Param, declare
from longarm_comp.nodes.predictor_client import NoAnswer, PredictorClient
from longarm_comp.nodes.runner import run
from longarm_comp.nodes.watch import FileWatch
from longarm_comp.nodes.worker import ManualCallbackGroup, Worker
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm"),
    Param("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    Param("effects", "", "Python files that define further effects, executed; : between paths"),
    Param("base_frame", "base", "frame that targets and measurements are given in"),
    Param(
        "method", "both", "what is compensated", choices=tuple(m.value for m in Method), live=True
    ),
    Param("single_pass", False, "correct once, as in the paper", live=True),
    Param("tolerance_m", 1e-5, "change of the expected error that ends the passes", 1e-9, 0.01),
    Param("max_passes", 10, "pseudo-target passes permitted", 1, 100),
    Param("max_correction_m", 0.05, "largest expected error that is corrected", 1e-6, 1.0),
    Param("position_only", False, "targets on target_pose leave the orientation free", live=True),
    Param("run_up", True, "joints run up to their target where the model needs a side", live=True),
    Param("realisable", True, "choose joints among the steps that the arm declares", live=True),
    Param("move_time_s", 0.5, "asked of the driver, which slows down to its limits", 0.0, 600.0),
    Param("predictor_timeout_s", 0.5, "no answer within it counts as no predictor", 0.01, 60.0),
    Param("context_max_age_s", 60.0, "older temperature, payload, tilt are stale", 0.1, 1e6),
    Param("joints_max_age_s", 5.0, "older joint_states are no seed", 0.1, 1e6),
    Param("compiled", True, "compile the search (needs llvmlite; about a second a model)"),
    Param("queue", 200, "targets that may wait", 1, 10000),
    Param("watch_period_s", 1.0, "how often the file is looked at for a new version", 0.1, 3600.0),
    *monitoring.PARAMS,
    *markers.PARAMS,
    PERIOD,
)


@dataclass
class _Request:
    """One target in work: the request, its answer, and whether the joints were sent to the arm."""

    message: Compensate.Request
    answer: Answer | None = None
    sent: bool = False


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
        self._max_age_s, self._joints_age_s = p["context_max_age_s"], p["joints_max_age_s"]
        self._move_time_s = p["move_time_s"]
        self._settling = Settling(
            tol_m=p["tolerance_m"], max_passes=p["max_passes"],
            max_correction_m=p["max_correction_m"],
        )  # fmt: skip
        self._counts: dict[str, int] = {}
        self._last = ""
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
        self._state = ArmState(
            self, self._arm, self._count, self._monitor.on_command, self._monitor.on_joints
        )
        graph.TIP_MEASURED.subscription(self, self._on_tip)
        graph.RELOAD.server(self, self._on_reload, ReentrantCallbackGroup())
        self._watch = FileWatch((p["model"],))
        self.create_timer(p["watch_period_s"], self._look)
        if p["markers.period_s"]:
            self.create_timer(p["markers.period_s"], self._draw)
        parts = {
            "targets": self._targets_report,
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
                *self._state.commands,
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

    def _on_target(self, message: PoseStamped) -> None:
        free = self.get_parameter("position_only").value
        request = _Request(Compensate.Request(target=message, position_only=free, execute=True))

        def serve() -> None:
            self._serve(request)
            self._publish_answer(request)

        if not self._worker.submit(serve):
            self._refuse_busy(request)

    def _on_compensate(
        self, message: Compensate.Request, reply: Callable[[Compensate.Response], None]
    ) -> None:
        request = _Request(message)

        def answer() -> None:
            try:
                reply(response_of(self._serve(request), self._arm, self._base_frame))
            finally:  # published even when the client is gone
                self._publish_answer(request)

        if not self._worker.submit(answer):
            reply(response_of(self._refuse_busy(request), self._arm, self._base_frame))

    def _refuse_busy(self, request: _Request) -> Answer:
        waiting = f"{self._worker.waiting} targets wait already"
        request.answer = self._refused(request.message, Status.NOT_READY, waiting)
        self._publish_answer(request)
        return request.answer

    def _serve(self, request: _Request) -> Answer:
        """Compute and send, on the worker's thread. The caller publishes the answer afterwards."""
        answer = request.answer = self._answer(request.message)
        if request.message.execute and answer.status.success and answer.arrival is not None:
            points = answer.arrival.move.points
            self._trajectory.publish(trajectory_message(self._arm, points, self._move_time_s))
            outcome = answer.arrival.outcome
            self._monitor.aimed(outcome.command, outcome.position)
            request.sent = True
        return answer

    def _answer(self, request: Compensate.Request) -> Answer:
        try:
            return self._compensate(request)
        except Refusal as refusal:
            return self._refused(request, refusal.status, refusal.reason)
        except StaleContext as error:
            return self._refused(request, Status.STALE_CONTEXT, str(error))
        except InputError as error:
            return self._refused(request, Status.BAD_TARGET, str(error))
        except Exception as error:
            self.survived(error)
            text = f"{type(error).__name__}: {error}"
            return self._refused(request, Status.INTERNAL_ERROR, text)

    def _compensate(self, request: Compensate.Request) -> Answer:
        target = target_of(request.target, self._base_frame, request.position_only)
        options = self._options()
        start = self._start(request)
        loaded = self._files.loaded
        known: dict[str, Any] = {
            "start": start,
            "history": self._state.history,
            "readings": self._state.readings,
            "now_s": time.monotonic(),
            "max_age_s": self._max_age_s,
            "position_only": request.position_only,
            "options": options,
        }
        client, why = self._predictor if options.method.learned else None, ""
        if client is not None and not client.present:
            client, why = None, ": no error_predictor is running"
        try:
            ask = None if client is None else partial(client.ask, deflection=options.method.physics)
            near = None if ask is None else Nearby(ask)  # mostly one call a target
            arrival = compensate_now(loaded.model, near, target, **known)
        except NoAnswer as absent:
            client, why = None, f": {absent.reason}"
            arrival = compensate_now(loaded.model, None, target, **known)
        outcome = arrival.outcome
        return Answer(
            request.target,
            request.position_only,
            outcome.status,
            outcome.reason + (why if outcome.status is Status.NO_PREDICTOR else ""),
            options.method.value,
            FileHashes(
                self._arm.hash, loaded.file_hash, "" if client is None else client.file_hash
            ),
            arrival,
        )

    def _options(self) -> CompensationOptions:
        once = bool(self.get_parameter("single_pass").value)
        return CompensationOptions(
            Method(self.get_parameter("method").value),
            replace(self._settling, single_pass=once) if once else self._settling,
            run_up=bool(self.get_parameter("run_up").value),
            realisable=bool(self.get_parameter("realisable").value),
        )

    def _start(self, request: Compensate.Request) -> np.ndarray:
        """Joints (n,) to start from: the request's seed, else the last joint_states.

        Raises:
            Refusal: there are none, or they are too old.
        """
        if request.seed.name:
            return joints_of(request.seed, self._arm, "seed")
        q, age = self._state.joints, self._state.age_s
        if q is None:
            raise Refusal(Status.NOT_READY, f"{NO_JOINTS}, and no seed was given")
        if age > self._joints_age_s:
            raise Refusal(Status.NOT_READY, f"the last joint_states is {age:.1f} s old")
        return q

    def _refused(self, request: Compensate.Request, status: Status, reason: str) -> Answer:
        return Answer(
            request.target,
            request.position_only,
            status,
            reason,
            str(self.get_parameter("method").value),
            FileHashes(self._arm.hash, self._files.loaded.file_hash),
        )

    def _publish_answer(self, request: _Request) -> None:
        answer = request.answer
        if answer is None:
            return
        self._compensation.publish(
            compensation_message(answer, self._arm, self._base_frame, executed=request.sent)
        )
        self._markers.on_answer(answer)
        self._count(answer.status.name, "" if answer.status is Status.SUCCESS else answer.message)

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
        q, context = self._state.joints, self._now_context(self._state.history)
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
