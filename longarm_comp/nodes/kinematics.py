"""`kinematics`: a target in, compensated joints out; publishes how they were computed."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.compensation.stands import TipByReadings
from longarm_comp.core.data.rest import RestPose
from longarm_comp.core.effects.catalogue import load_file
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import (
    arm_frames,
    by_readings,
    compensator,
    learning,
    markers,
    monitoring,
    payload,
    reach,
    targets,
)
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_frames import ArmFrames
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.by_readings import ReadingsTeller
from longarm_comp.nodes.compensator import Compensator
from longarm_comp.nodes.driver_link import DriverLink
from longarm_comp.nodes.frames import FrameListener, prefix_of
from longarm_comp.nodes.health import (
    ERROR,
    LEARNED_SAID,
    OK,
    PERIOD,
    TIP_SAID,
    WARN,
    Health,
    Report,
    Tally,
    Twins,
)
from longarm_comp.nodes.interfaces import BEST_EFFORT
from longarm_comp.nodes.learning import Learning
from longarm_comp.nodes.markers import Markers
from longarm_comp.nodes.model_files import FileWatch, ModelFiles
from longarm_comp.nodes.monitoring import Sighted, TipMonitor
from longarm_comp.nodes.params import Param, declare
from longarm_comp.nodes.payload import Weigher
from longarm_comp.nodes.predictor_client import Caller, PredictorClient
from longarm_comp.nodes.reach import ReachServer
from longarm_comp.nodes.readiness import Readiness
from longarm_comp.nodes.runner import run
from longarm_comp.nodes.targets import TargetInlet
from longarm_comp.nodes.ticks import steady_timer
from longarm_comp.nodes.worker import Worker
from longarm_interfaces.msg import Motion

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm"),
    Param("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    Param("effects", "", "Python files that define further effects, executed; : between paths"),
    Param("base_frame", "base", "frame that targets and measurements are given in"),
    *compensator.PARAMS,
    Param("joints_max_age_s", 5.0, "older joint_states are not believed", 0.1, 1e6),
    Param("joints_max_rate", 5.0, "faster ones neither; ranges of a joint a second", 0.1, 1e6),
    *targets.PARAMS,
    Param("acknowledged", True, "the driver says what becomes of a trajectory (docs/ros.md)"),
    Param("predictor_timeout_s", 0.5, "no answer within it counts as no predictor", 0.01, 60.0),
    Param("compiled", True, "compile the search (needs llvmlite; about a second a model)"),
    Param("queue", 200, "targets that may wait", 1, 10000),
    Param("watch_period_s", 1.0, "how often the file is looked at for a new version", 0.1, 3600.0),
    *reach.PARAMS,
    *monitoring.PARAMS,
    *learning.PARAMS,
    *markers.PARAMS,
    *arm_frames.PARAMS,
    *by_readings.PARAMS,
    *payload.PARAMS,
    Param("trimmed", False, "the driver trims: what encoders see is not compensated again"),
    PERIOD,
)


Asked = Callable[[Worker], Caller]
Response = TypeVar("Response", Trigger.Response, SetBool.Response)


class Kinematics(Node):
    """Computes one target after another on a worker thread, so that the executor stays free.

    Args:
        executor: that the node will be in.
        predictor: makes what the worker asks for the learned error; the service on the graph
            where it is not given.
    """

    def __init__(self, executor: SingleThreadedExecutor, predictor: Asked | None = None) -> None:
        super().__init__("kinematics", automatically_declare_parameters_from_overrides=True)
        p = declare(self, PARAMS)
        for path in filter(None, p["effects"].split(os.pathsep)):
            load_file(path)
        self._files = ModelFiles(p["arm"], p["model"], trimmed=p["trimmed"])
        self._arm = self._files.arm
        self._base_frame = prefix_of(self) + p["base_frame"]
        self._max_age_s = p["context_max_age_s"]
        tally = Tally(self)
        self._worker = Worker(self, executor, p["queue"], self.survived)
        inlets = self._worker.inlets
        caller = predictor(self._worker) if predictor else inlets.caller(graph.PREDICT_ERROR)
        self._predictor = PredictorClient(caller, self._arm, p["predictor_timeout_s"])
        self._monitor = TipMonitor(
            self._predictor, p["monitor.settle_s"], p["monitor.sightings"], p["monitor.sigma_m"],
            p["monitor.run_length"],
            lambda: monitoring.advice(
                p["arm"], p["model"] if self._files.loaded.file_hash else "", self.get_namespace()
            ),
        )  # fmt: skip
        self._learning = Learning(self._files, p["learning"], p["learning_step_m"])
        self._markers = Markers(self, self._base_frame)
        self._state = ArmState(
            self, self._arm, tally.count, self._on_joints,
            p["joints_max_age_s"], p["joints_max_rate"],
        )  # fmt: skip
        self._weigher = Weigher(
            self, self._arm, p, self._state, self._worker, tally.count, self._standing
        )
        self._driver = DriverLink(
            inlets, self._arm, acknowledged=p["acknowledged"], joints=lambda: self._state.joints,
            commanded=self._on_command, told=self._on_told,
            refused=tally.count,
        )  # fmt: skip
        self._twins = Twins(self)
        compute = Compensator(
            self, p, self._base_frame, self._files, self._state, self._predictor, self._driver,
            self._twins, FrameListener(self, p["frames.wait_s"], tally.count), self.survived,
        )  # fmt: skip
        ArmFrames(
            self, self._files, self._base_frame, p["frames.period_s"],
            lambda: self._state.joints, lambda: self._now_context(self._driver.history),
        )  # fmt: skip
        self._targets = TargetInlet(
            self, self._arm, p, self._base_frame, self._worker, compute, self._driver, self._state,
            tally, self._markers.on_answer, self._monitor.aimed, lambda: self._health.mended(),
        )  # fmt: skip
        self._tip_by_readings = ReadingsTeller(
            self, self._base_frame, p["readings.period_s"], self._worker, self._standing
        )
        self._reach = ReachServer(self, self._arm, self, p["reach.feedback_s"], p["reach.look_s"])
        self._tips = graph.TIP_MEASURED.subscription(self, self._on_tip)
        graph.RELOAD.server(self, self._on_reload, ReentrantCallbackGroup())
        graph.FREEZE.server(self, self._on_freeze, ReentrantCallbackGroup())
        graph.UNDO.server(self, self._on_undo, ReentrantCallbackGroup())
        self._watch = FileWatch((p["model"],))
        steady_timer(self, p["watch_period_s"], self._look)
        if p["markers.period_s"]:
            steady_timer(self, p["markers.period_s"], self._draw)
        ready = Readiness(self, self._worker, compute, self._predictor, compiled=p["compiled"])
        parts = {
            "ready": ready.report,
            "targets": self._targets.report,
            "driver": self._driver.report,
            "graph": self._graph_report,
            "model": self._files.report,
            "monitor": self._monitor.report,
            "at the target": self._monitor.target_report,
            "servos": self._monitor.servo_report,
            "payload": self._weigher.report,
            TIP_SAID: self._tip_by_readings.report,
        }
        if self._learning.learner is not None:
            parts[LEARNED_SAID] = self._learning.report
        self._health = Health(self, parts, p[PERIOD.name])
        self._worker.start()

    def close(self) -> None:
        """Stop the worker."""
        self._worker.close()

    def survived(self, error: Exception) -> None:
        """Count an exception that a callback raised."""
        self._health.fault(error)

    # ------------------------------------------------------------------ for the action

    @property
    def targets(self) -> TargetInlet:
        """Where targets are asked for."""
        return self._targets

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

    @property
    def tip_by_readings(self) -> TipByReadings | None:
        """Where the tip stands now by the readings of the joints."""
        return self._tip_by_readings.tell()

    # ------------------------------------------------------------------ files and monitoring

    def _reload(self) -> tuple[bool, str]:
        done = self._files.reload()
        self._learning.begin()
        self._monitor.reset()
        return done

    def _look(self) -> None:
        if self._watch.changed():
            self._worker.submit(self._reload)

    async def _on_reload(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        return await self._done(self._reload, response)

    async def _on_undo(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        return await self._done(self._learning.undo, response)

    async def _on_freeze(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        return await self._done(partial(self._learning.freeze, request.data), response)

    async def _done(self, job: Callable[[], tuple[bool, str]], response: Response) -> Response:
        """What a job on the worker says."""
        future = self._worker.ask(job)
        if future is None:
            response.message = "too many targets wait"
            return response
        response.success, response.message = await future
        return response

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        self._markers.on_tip(message)
        rest = self._monitor.on_tip(message, 1e-9 * self.get_clock().now().nanoseconds)
        context = None if rest is None else self._now_context(rest.history)
        if rest is not None and context is not None:
            self._worker.submit(partial(self._judge, rest, context))

    def _judge(self, rest: RestPose, context: Context) -> None:
        learned = self._monitor.judge(rest, self._files.loaded.model, context)
        now_s = 1e-9 * self.get_clock().now().nanoseconds
        self._learning.seen(rest, context, learned, now_s)

    def _now_context(self, history: History) -> Context | None:
        """Circumstances at this moment; None while one that the model needs is unknown."""
        model, now = self._files.loaded.model, time.monotonic()
        try:
            return self._state.readings.context(model, now, self._max_age_s, history)
        except StaleContext:
            return None

    def _standing(self) -> tuple[Model, np.ndarray, Context] | None:
        """Model, readings and circumstances of now."""
        q, context = self._state.joints, self._now_context(self._driver.history)
        return None if q is None or context is None else (self._files.loaded.model, q, context)

    def _on_joints(self, q: np.ndarray, at_s: float) -> None:
        self._monitor.on_joints(q, at_s)
        self._weigher.read()

    def _on_command(self, q: np.ndarray, history: History) -> None:
        self._weigher.moving()
        self._monitor.on_command(q, history)

    def _on_told(self, motion: Motion) -> None:
        self._reach.told(motion)
        if motion.event != Motion.REACHED:
            return
        self._monitor.on_reached()
        self._weigher.reached()
        now = self._standing()
        if now is not None:
            self._worker.submit(partial(self._monitor.judge_servos, *now))

    def _draw(self) -> None:
        q, context = self._state.joints, self._now_context(self._driver.history)
        if q is None or context is None:
            return
        sag = self.get_parameter("markers.sag_factor").value
        error = self.get_parameter("markers.error_factor").value
        self._markers.publish(self._files.rigid, self._files.loaded.model, q, context, sag, error)

    def _graph_report(self) -> Report:
        """Whether others are on the graph that must not be, or cannot be heard."""
        if self._twins.refusal:
            return Report(ERROR, self._twins.refusal)
        ends = self.get_publishers_info_by_topic(self.resolve_topic_name(graph.TARGET_POSE.name))
        deaf = [e.node_name for e in ends if e.qos_profile.reliability is BEST_EFFORT]
        if deaf:
            names = ", ".join(sorted(deaf))
            return Report(WARN, f"targets of {names} are not heard: target_pose is reliable")
        return Report(OK, "one kinematics, every publisher of targets is heard")


def main() -> None:
    """Run the node."""
    sys.exit(run(Kinematics))


if __name__ == "__main__":
    main()
