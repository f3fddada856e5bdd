"""`kinematics`: computes compensated joints for targets, and publishes each computation."""

from functools import partial

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor

from longarm_comp.core.arm.context import Context
from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.data.rest import RestPose
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import (
    arm_state,
    compensator,
    drawing,
    learning,
    monitoring,
    payload,
    reach,
    sightings,
    targets,
)
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.frames import FrameListener
from longarm_comp.nodes.health import ERROR, OK, PERIOD, RING_SAID, TIP_SAID, WARN, Report, Twins
from longarm_comp.nodes.interfaces import BEST_EFFORT
from longarm_comp.nodes.messages import joints_of
from longarm_comp.nodes.node import ArmNode, program
from longarm_comp.nodes.params import Param
from longarm_interfaces.msg import Motion

PARAMS = (
    *arm_state.PARAMS,
    Param("base_frame", "base", "frame of targets and measurements"),
    *compensator.PARAMS,
    *targets.PARAMS,
    Param("acknowledged", True, "the driver reports what happens to a trajectory (docs/ros.md)"),
    Param("compiled", True, "compile the inverse kinematics at once (a second a model)"),
    Param("queue", 200, "largest number of targets that wait", 1, 10000),
    *reach.PARAMS,
    *monitoring.PARAMS,
    *learning.PARAMS,
    *drawing.PARAMS,
    *payload.PARAMS,
    Param("shaped", False, "the driver splits moves so that they leave little ring"),
    Param("trimmed", False, "the driver trims: errors that encoders see are not compensated"),
    PERIOD,
)


class Kinematics(ArmNode):
    """The node. It computes targets one by one on a worker thread, so the executor stays free."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "kinematics", PARAMS)
        p, twins = self.p, Twins(self)
        self._twins = twins
        self._arm = state = ArmState(self, p["queue"], trimmed=p["trimmed"])
        self._monitor = monitoring.TipMonitor(state)
        self._learning = learning.Learning(state)
        self._markers = drawing.Markers(state)
        weigher = payload.Weigher(state)
        frames = FrameListener(self, p["frames.wait_s"], self.tally.count)
        self._sightings = sightings.TipSightings(state, frames, drawing.ArmFrames(state))
        compute = compensator.Compensator(state, twins, frames)
        inlet = targets.TargetInlet(state, compute, self._monitor, self._markers)
        tips = monitoring.ReadingsTeller(state)
        ringing = monitoring.RingTeller(state, p["shaped"])
        server = reach.ReachServer(state, inlet, self._monitor, tips)
        state.joint_listeners += [self._monitor.on_joints, weigher.on_joints]
        state.driver.command_listeners += [weigher.on_command, self._monitor.on_command]
        for part in (server, ringing, self._monitor, weigher):
            state.driver.motion_listeners.append(part.on_motion)
        state.driver.motion_listeners.append(self._on_motion)
        graph.TIP_MEASURED.subscription(self, self._on_tip)
        self.on_request(graph.RELOAD, state.worker, lambda request: self._reload_model())
        self.on_request(graph.UNDO, state.worker, lambda request: self._undo())
        freeze = self._learning.freeze
        self.on_request(graph.FREEZE, state.worker, lambda request: freeze(request.data))
        self.on_change((p["model"],), state.worker, self._reload_model)
        ready = compensator.Readiness(state, compute)
        self.health.parts |= {
            "ready": ready.report,
            "targets": inlet.report,
            "driver": state.driver.report,
            "graph": self._graph_report,
            "model": state.files.report,
            "monitor": self._monitor.report,
            "at the target": self._monitor.target_report,
            "servos": self._monitor.servo_report,
            "payload": weigher.report,
            TIP_SAID: tips.report,
            RING_SAID: ringing.report,
        }
        if self._learning.learner is not None:
            self.health.parts[LEARNED_SAID] = self._learning.report
        state.worker.start(inlet.serve_topic)

    def _reload_model(self) -> tuple[bool, str]:
        done, said = self._arm.files.reload()
        self._monitor.reset()
        self._sightings.tell()
        try:
            self._learning.begin()
        except InputError as error:
            said = f"{said}; nothing is learned: {error}"
        return done, said

    def _undo(self) -> tuple[bool, str]:
        done = self._learning.undo()
        self._monitor.begin_anew()
        return done

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        told, of_model = self._sightings.take(message)
        self._monitor.unplaced = self._sightings.unplaced
        self._markers.on_tip(told)
        rest = None if of_model is None else self._monitor.on_tip(of_model)
        context = None if rest is None else self._arm.known_context(rest.history)
        if rest is not None and context is not None:
            self._arm.worker.submit(partial(self._judge_rest, rest, context))

    def _judge_rest(self, rest: RestPose, context: Context) -> None:
        learned = self._monitor.judge(rest, self._arm.files.loaded.model, context)
        if self._learning.learn_from(rest, context, learned):
            self._monitor.begin_anew()

    def _on_motion(self, motion: Motion) -> None:
        if motion.event != Motion.REACHED or (now := self._arm.standing) is None:
            return
        model, q, context = now
        if motion.joints.name:  # the last of `joint_states` may be from before the arrival
            try:
                q = joints_of(motion.joints, self._arm.arm, "motion: joints")
            except InputError as error:
                self.tally.count_dropped("motion", str(error))
                return
        self._arm.worker.submit(partial(self._monitor.judge_servos, model, q, context))

    def _graph_report(self) -> Report:
        """Report a second `kinematics`, or nodes whose targets cannot be received."""
        if self._twins.refusal:
            return Report(ERROR, self._twins.refusal)
        ends = self.get_publishers_info_by_topic(self.resolve_topic_name(graph.TARGET_POSE.name))
        deaf = [e.node_name for e in ends if e.qos_profile.reliability is BEST_EFFORT]
        if deaf:
            names = ", ".join(sorted(deaf))
            return Report(WARN, f"targets of {names} are not received: target_pose is reliable")
        return Report(OK, "one kinematics; the targets of all publishers are received")


main = program(Kinematics)

if __name__ == "__main__":
    main()
