"""`trajectory_compensator`: compensates a planned trajectory and sends it to the controller.

It offers the action `follow_joint_trajectory`. It forwards each goal, compensated, to the action of
the same type of `servo_driver` or of any joint trajectory controller. It sends nothing for a goal
that it refuses.
"""

import contextlib
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.compensate import physics_of
from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.compensation.path import CompensatedPath, PathRefused, compensate_path
from longarm_comp.core.compensation.planned_path import (
    MotionLimits,
    PathLimits,
    PlannedPath,
    as_planned,
)
from longarm_comp.core.compensation.result import CompensationOptions, Method
from longarm_comp.core.data.rest import JOINT_REST
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.nodes import arm_state
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.clock import Ticks
from longarm_comp.nodes.health import OK, PERIOD, WARN, Report
from longarm_comp.nodes.messages import joints_message, seconds, trajectory_message
from longarm_comp.nodes.node import ArmNode, program
from longarm_comp.nodes.orders import Freshness, Stamps, abort_goal
from longarm_comp.nodes.params import Param, where

PARAMS = (
    *arm_state.PARAMS,
    Param("method", "both", "what is compensated", choices=tuple(m.value for m in Method)),
    Param("controller", graph.FOLLOW.name, "action to which trajectories are sent"),
    Param("acknowledged", True, "the controller is servo_driver, which reports what it does"),
    Param("max_velocity", [0.0], "limit of each joint or of all, rad/s or m/s; 0: none", 0.0, 1e6),
    Param(
        "max_acceleration",
        [0.0],
        "limit of each joint or of all, rad/s^2, m/s^2; 0: none",
        0.0,
        1e6,
    ),
    arm_state.MAX_CORRECTION,
    Param("max_start", 0.2, "a joint may stand so far from where a plan begins, rad, m", 0.0, 10.0),
    Param("position_only", False, "plans leave the orientation free"),
    Param(
        "max_turn_rad",
        PathLimits.max_turn_rad,
        "the orientation may be off by so much, where joints cannot hold it",
        0.0,
        4.0,
    ),
    Param(
        "turn_m",
        PathLimits.turn_m,
        "largest error of the tip where a joint with play turns",
        0.0,
        0.1,
    ),
    Param(
        "max_longer",
        PathLimits.max_longer,
        "share of time that play may add to a path; 0: none",
        0.0,
        9.0,
    ),
    Param("order_max_age_s", 2.0, "goals older than this are refused", 0.01, 60.0),
    Param("planned_period_s", 0.1, "time between two joint states for the planner", 0.01, 60.0),
    PERIOD,
)

_TRIES = 3
"""How often a path is computed before its goal is refused, because the arm moved meanwhile."""
_GONE_TICKS = 20
"""Ticks (0.05 s each) without the controller after which it is gone: one second, because discovery
may miss a node that is there for shorter."""


class _TrajectoryCompensator(ArmNode):
    """The node. It computes on a worker thread, so that the executor stays free."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "trajectory_compensator", PARAMS)
        p = self.p
        if not graph.HAS_FOLLOW:
            raise InputError(where(self), "control_msgs", "missing", "install ROS's control_msgs")
        self._state = ArmState(self, capacity=5)
        self._files, self._method = self._state.files, Method(p["method"])
        self._arm, self._controller = self._state.arm, p["controller"]
        self._limits = self._limits_of(p)
        self._worker, self._driver = self._state.worker, self._state.driver
        self._worker.hear(graph.LEARNED, lambda said, sent: self._files.follow_learned(said.data))
        self._fresh, self._stamps = Freshness(self, p["order_max_age_s"]), Stamps(self.get_clock())
        self._ticks, self._following = Ticks(self, 0.05), 0
        self._out = ActionClient(
            self, graph.FOLLOW.type, self._controller, callback_group=ReentrantCallbackGroup()
        )
        self._server = graph.FOLLOW_PLANNED.server(self, self._serve_goal)
        self._planned = graph.PLANNED_JOINTS.publisher(self)
        self._ready = False
        self.every("planned_period_s", lambda: self._worker.submit_once(self._tell_planned))
        self.on_change((p["model"],), self._worker, self._files.reload)
        self.health.parts |= {"paths": self._report_paths, "model": self._files.report}
        self._worker.start()

    def _limits_of(self, p: Mapping[str, Any]) -> PathLimits:
        """Return the limits: one or all; other controllers than `servo_driver` need every one."""
        found = []
        for name in ("max_velocity", "max_acceleration"):
            given = p[name] * self._arm.n if len(p[name]) == 1 else p[name]
            allowed = f"one number, or {self._arm.n}: one a joint"
            if len(given) != self._arm.n:
                raise InputError(where(self), name, p[name], allowed)
            if not p["acknowledged"] and not all(given):
                raise InputError(where(self), name, p[name], f"{allowed}, above 0")
            found.append(np.array([value or np.inf for value in given]))
        motion = MotionLimits(*found)
        return PathLimits(motion, **{f.name: p[f.name] for f in fields(PathLimits)[1:]})

    async def _serve_goal(self, goal: Any) -> Any:
        result, asked = graph.FOLLOW.type.Result, goal.request.trajectory
        strange = set(asked.joint_names) - set(self._arm.joint_names)
        allowed = ", ".join(self._arm.joint_names)
        sent_s = self._fresh.sent_s(asked.header.stamp)
        why = f"joints {sorted(strange)}; allowed: {allowed}" if strange else ""
        why = why or self._not_now(asked, sent_s)
        made, why = (None, why) if why else await self._compute_path(goal.request, sent_s)
        if goal.is_cancel_requested:
            goal.canceled()
            return result(error_string="cancelled before anything was sent")
        if why or made is None:
            self.tally.count("refused", why)
            return abort_goal(goal, result.INVALID_JOINTS if strange else result.INVALID_GOAL, why)
        self._following += 1
        try:
            return await self._forward_path(goal, made)
        finally:
            self._following -= 1

    def _not_now(self, asked: JointTrajectory, sent_s: float) -> str:
        """Say why a trajectory that was sent at ``sent_s`` (sleepless s) cannot be followed now."""
        if not asked.points:
            return "a trajectory without points"
        if not self._out.server_is_ready():
            return f"no controller offers {self._controller}"
        why = self._files.refusal or self._driver.refusal or self._driver.overtaken(sent_s)
        why = why or self._state.doubt or self._worker.failing
        return self._fresh.too_old(asked.header.stamp) or why

    async def _compute_path(
        self, request: Any, sent_s: float
    ) -> tuple[CompensatedPath | None, str]:
        """Compute the path from where the arm stands, or say why not; again if it moved."""
        moved = ""
        for _ in range(_TRIES):
            stood = self._state.joints
            assert stood is not None
            future = self._worker.ask(partial(self._compensate_request, request, stood))
            made, why = (None, "too many goals wait") if future is None else await future
            if why := why or self._not_now(request.trajectory, sent_s):
                return None, why
            if not (moved := self._describe_motion(stood)):
                return made, ""
        return None, moved

    def _describe_motion(self, stood: np.ndarray) -> str:
        """Say which joint has moved from joints (n,), rad and m; empty if they rest there."""
        stands = self._state.joints
        assert stands is not None
        off = np.abs(stands - stood)
        k = int(off.argmax())
        if off[k] <= JOINT_REST:
            return ""
        moved = f"{self._arm.joint_names[k]} moved by {off[k]:.3g} while the path was computed"
        return f"{moved}, allowed {JOINT_REST:g}: plan from where the arm rests"

    async def _forward_path(self, goal: Any, made: CompensatedPath) -> Any:
        """Send a path to the controller, and return the result of the controller's action.

        The way-point where the arm stands is left out: a controller begins at its own set-point,
        and servos that yield stand below it.
        """
        path = made.timed.joints[1:]
        if not len(path):
            goal.succeed()
            return graph.FOLLOW.type.Result(error_string="the arm stands there: nothing was sent")
        out = copy(goal.request)  # its other fields are left to the controller
        out.trajectory = trajectory_message(
            self._arm, path, made.timed.times[1:], self._stamps.next(), made.timed.velocities[1:]
        )
        there = self._controllers()
        sending = self._out.send_goal_async(out, lambda said: goal.publish_feedback(said.feedback))
        if not await self._hear(sending, there):
            sending.add_done_callback(_cancel_accepted)
            return self._give_up(goal)
        sent = sending.result()
        if not sent.accepted:
            why = f"{self._controller} does not accept the goal"
            self.tally.count("refused", why)
            return abort_goal(goal, graph.FOLLOW.type.Result.INVALID_GOAL, why)
        if not self._driver.acknowledged:
            self._driver.note_motion(path, made.timed.joints[0])
        ended, asked = sent.get_result_async(), False

        def pass_cancel_on() -> None:
            nonlocal asked
            if goal.is_cancel_requested and not asked:
                asked = True
                sent.cancel_goal_async()

        if not await self._hear(ended, there, pass_cancel_on):
            sent.cancel_goal_async()
            return self._give_up(goal)
        answer = ended.result()
        if answer.status == GoalStatus.STATUS_SUCCEEDED:
            self.tally.count("followed", "")
            said = "; ".join(filter(None, (answer.result.error_string, *made.notes)))
            answer.result.error_string = said
            goal.succeed()
        else:
            self._driver.forget_history()
            self.tally.count("not followed", answer.result.error_string)
            cancelled = answer.status == GoalStatus.STATUS_CANCELED and goal.is_cancel_requested
            (goal.canceled if cancelled else goal.abort)()
        return answer.result

    async def _hear(
        self, answer: Future, there: set[bytes], look: Callable[[], None] = lambda: None
    ) -> bool:
        """Wait for an answer of the controller; return False if it is gone before.

        ``there``: `_controllers` when it was asked. Another one that is there now, such as a
        restarted one, does not answer. ``look`` is called from time to time.
        """
        missed = 0
        while not answer.done():
            look()
            missed = 0 if there & self._controllers() else missed + 1
            if missed > _GONE_TICKS:
                return False
            await self._ticks.next()
        return True

    def _controllers(self) -> set[bytes]:
        """Return an id of each controller that offers the action now."""
        status = f"{self.resolve_topic_name(self._controller)}/_action/status"
        return {bytes(end.endpoint_gid) for end in self.get_publishers_info_by_topic(status)}

    def _give_up(self, goal: Any) -> Any:
        why = f"{self._controller} is gone, and did not say what became of the path"
        self._driver.forget_history()
        self.tally.count("not followed", why)
        return abort_goal(goal, graph.FOLLOW.type.Result.PATH_TOLERANCE_VIOLATED, why)

    def _compensate_request(
        self, request: Any, stood: np.ndarray
    ) -> tuple[CompensatedPath | None, str]:
        """Compute a path from joints ``stood`` (n,), rad and m; or say why there is none."""
        rests = self._driver.rests_at
        start = stood if rests is None else rests
        loaded = self._files.loaded
        physics = physics_of(loaded.model, self._method)
        history = History.unknown(self._arm.n) if self._following else self._driver.history
        try:
            compensate = partial(
                compensate_path,
                loaded.stands.promising(loaded.model),
                plan=self._plan_of(request.trajectory, start).seen_from(loaded.stands.motion),
                start=start,
                history=history,
                limits=replace(self._limits, max_longer=self._longest_share(request)),
                context_at=self._state.circumstances(physics),
                options=CompensationOptions(
                    self._method, max_correction_m=self.p["max_correction_m"] or None
                ),
            )
            with ik.compile_at_once():
                found, *_ = self._state.predictor.compensate_with(self._method, compensate)
        except (PathRefused, StaleContext, InputError) as error:
            return None, str(error)
        for note in found.notes:
            self.get_logger().warning(note, throttle_duration_sec=1.0)
        return found, ""

    def _longest_share(self, request: Any) -> float:
        """Return by what share of its duration a path may take longer, parameter and goal allow."""
        late = seconds(request.goal_time_tolerance)
        lasts = seconds(request.trajectory.points[-1].time_from_start)
        most = self._limits.max_longer
        return min(most, late / lasts) if late > 0.0 < lasts else most

    def _plan_of(self, asked: JointTrajectory, start: np.ndarray) -> PlannedPath:
        """Make a planned path of all joints from a trajectory.

        Joints that it does not name stay at ``start`` (n,), rad and m. If its first time is above
        0 s, the path begins at ``start``.
        """
        names = self._arm.joint_names
        at = [names.index(name) for name in asked.joint_names]
        fast = all(len(point.velocities) == len(at) for point in asked.points)
        times = [seconds(point.time_from_start) for point in asked.points]
        for k, point in enumerate(asked.points):
            if len(point.positions) != len(at) or len(set(at)) != len(at):
                found = f"{len(at)} names, {len(point.positions)} positions"
                raise InputError("trajectory", f"points[{k}]", found, "one position a joint")
        joints = np.tile(start, (len(times), 1))
        joints[:, at] = [point.positions for point in asked.points]
        speeds = np.zeros_like(joints)
        if fast:
            speeds[:, at] = [point.velocities for point in asked.points]
        if times[0] > 0.0:  # it begins where the arm stands
            times, joints = [0.0, *times], np.vstack([start, joints])
            speeds = np.vstack([np.zeros(len(start)), speeds])
        return PlannedPath.of_joints(self._arm, np.array(times), joints, speeds if fast else None)

    def _tell_planned(self) -> None:
        """Publish the joints at which the declared arm's tip is where the real tip is expected."""
        rests, loaded = self._driver.rests_at, self._files.loaded
        q = self._state.joints if rests is None else rests
        model = physics_of(loaded.model, self._method)
        if q is None or self._state.doubt:
            return
        stamp = self.get_clock().now().to_msg()
        with contextlib.suppress(StaleContext):
            context = self._state.context(model=model)
            ik.warm_up(model, context)  # compiles the programs that the next path needs
            free = self.p["position_only"]
            real = loaded.stands.carry_from_model(model.pose(q, context))
            planned = as_planned(self._files.rigid, real, q, free)
            self._planned.publish(joints_message(self._arm, planned, stamp))
            self._ready = True

    def _report_paths(self) -> Report:
        facts = self.tally.facts
        if not self._out.server_is_ready():
            return Report(WARN, f"no controller offers {self._controller}", facts)
        if self._state.doubt or not self._ready:
            return Report(WARN, self._state.doubt or "getting ready", facts)
        return Report(OK, "following" if self._following else "ready", facts)


def _cancel_accepted(sending: Future) -> None:
    """Cancel a goal that was accepted after it was given up."""
    if sending.result().accepted:
        sending.result().cancel_goal_async()


main = program(_TrajectoryCompensator)

if __name__ == "__main__":
    main()
