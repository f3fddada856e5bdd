"""Action `follow_joint_trajectory` of the driver, as joint trajectory controllers offer it.

A goal goes the way of a message on `joint_trajectory`: the same checks, and what the driver tells
on `motion` of its id is the result.
"""

from __future__ import annotations

import itertools
import math
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import duration, seconds
from longarm_comp.nodes.orders import Driver
from longarm_comp.nodes.ticks import Ticks
from longarm_interfaces.msg import Motion


class FollowServer:
    """Serves goals. A new one replaces the one before, as a new message does."""

    def __init__(self, node: Node, site: Driver) -> None:
        self._node, self._site = node, site
        self._run, self._numbers = uuid.uuid4().hex[:8], itertools.count(1)
        self._told: dict[str, tuple[int, str] | None] = {}
        self._ticks = Ticks(node, 0.05)
        self._server = graph.FOLLOW.server(node, self._serve)

    def told(self, event: int, name: str, why: str) -> None:
        """Take what the driver tells of a trajectory: an event of `Motion`."""
        if name in self._told and event != Motion.ACCEPTED:
            self._told[name] = self._told[name] or (event, why)

    async def _serve(self, goal: Any) -> Any:
        name = f"follow-{self._run}-{next(self._numbers)}"
        try:
            return await self._follow(goal, name)
        finally:
            self._told.pop(name, None)
            self._told.pop(f"{name} halt", None)

    async def _follow(self, goal: Any, name: str) -> Any:
        result, asked = graph.FOLLOW.type.Result, goal.request.trajectory
        problem = _not_offered(goal.request)
        if problem:
            return self._aborted(goal, result.INVALID_GOAL, problem)
        began, deadline = self._node.get_clock().now(), _deadline(goal.request)
        self._told[name] = None
        self._site.take(asked, name)
        while (end := self._told[name]) is None:
            self._feedback(goal, asked.joint_names, began)
            broken = self._beyond(goal.request.path_tolerance, "on the way")
            late = time.monotonic() > deadline
            if broken or late or goal.is_cancel_requested:
                await self._halt(name)
                if broken:
                    return self._aborted(goal, result.PATH_TOLERANCE_VIOLATED, broken)
                if late:
                    why = "not at the end within goal_time_tolerance"
                    return self._aborted(goal, result.GOAL_TOLERANCE_VIOLATED, why)
                goal.canceled()
                return result(error_string="cancelled: the arm was stopped")
            await self._ticks.next()
        event, why = end
        if event == Motion.REFUSED:
            strange = not set(asked.joint_names) <= set(self._site.names)
            code = result.INVALID_JOINTS if strange else result.INVALID_GOAL
            return self._aborted(goal, code, why)
        if event != Motion.REACHED:
            return self._aborted(goal, result.PATH_TOLERANCE_VIOLATED, why)
        missed = self._beyond(goal.request.goal_tolerance, "at the end")
        if missed:
            return self._aborted(goal, result.GOAL_TOLERANCE_VIOLATED, missed)
        goal.succeed()
        return result(error_code=result.SUCCESSFUL)

    async def _halt(self, name: str) -> None:
        """Stop smoothly, and wait until the arm is at rest or does not obey."""
        if self._told[name] is None:
            self._told[f"{name} halt"] = None
            self._site.take(JointTrajectory(), f"{name} halt")
            while self._told[f"{name} halt"] is None:
                await self._ticks.next()

    def _aborted(self, goal: Any, code: int, why: str) -> Any:
        goal.abort()
        return graph.FOLLOW.type.Result(error_code=code, error_string=why)

    def _beyond(self, limits: Any, where: str) -> str:
        """Which joint is farther from its set-point than is allowed; empty if none is."""
        wanted, readings = self._site.set_points, self._site.readings
        for limit in limits:
            if limit.name in wanted and limit.name in readings:
                off = abs(wanted[limit.name] - readings[limit.name].position)
                if 0.0 < limit.position < off:
                    return f"{limit.name} is {off:.4g} off {where}, {limit.position:g} allowed"
        return ""

    def _feedback(self, goal: Any, names: Sequence[str], began: Any) -> None:
        wanted, readings = self._site.set_points, self._site.readings
        if not all(name in wanted and name in readings for name in names):
            return
        now = self._node.get_clock().now()
        since = duration(max(0.0, 1e-9 * (now - began).nanoseconds))

        def point(of: Callable[[str], float]) -> JointTrajectoryPoint:
            return JointTrajectoryPoint(positions=[of(n) for n in names], time_from_start=since)

        message = graph.FOLLOW.type.Feedback(joint_names=names)
        message.header.stamp = now.to_msg()
        message.desired = point(lambda name: wanted[name])
        message.actual = point(lambda name: readings[name].position)
        message.actual.velocities = [readings[name].velocity for name in names]
        message.error = point(lambda name: wanted[name] - readings[name].position)
        goal.publish_feedback(message)


def _deadline(asked: Any) -> float:
    """Monotonic seconds at which the goal is late; never where no tolerance is given (0, -1 s)."""
    tolerance, points = seconds(asked.goal_time_tolerance), asked.trajectory.points
    if tolerance <= 0.0 or not points:
        return math.inf
    return time.monotonic() + seconds(points[-1].time_from_start) + tolerance


def _not_offered(asked: Any) -> str:
    """What of a goal this driver cannot do; empty if nothing."""
    if asked.multi_dof_trajectory.points:
        return "multi_dof_trajectory: joints of several degrees of freedom; allowed: none"
    for kind in ("path_tolerance", "goal_tolerance"):
        for limit in getattr(asked, kind):
            if limit.velocity > 0.0 or limit.acceleration > 0.0:
                return f"{kind}: {limit.name}: velocity or acceleration; allowed: position"
    for kind in ("component_path_tolerance", "component_goal_tolerance"):
        if getattr(asked, kind):
            return f"{kind}: of joints of several degrees of freedom; allowed: none"
    return ""
