"""The action `reach`: moves the tip to a target, gives feedback, and reports where it rests."""

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.answers import Answer, TargetRequest
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.clock import Ticks, sleepless_s
from longarm_comp.nodes.messages import joints_message, vector_message
from longarm_comp.nodes.monitoring import ReadingsTeller, Sighted, TipMonitor
from longarm_comp.nodes.orders import describe_halt
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.targets import TargetInlet
from longarm_interfaces.action import Reach
from longarm_interfaces.msg import Motion
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("reach.feedback_s", 0.1, "time between two feedbacks of the action reach", 0.01, 10.0),
    Param("reach.look_s", 5.0, "longest wait for sightings at rest; 0: none", 0.0, 600.0),
)


class ReachServer:
    """Serves one goal after another, in the order of arrival, on the node's executor."""

    def __init__(
        self, state: ArmState, targets: TargetInlet, monitor: TipMonitor, tips: ReadingsTeller
    ) -> None:
        self._state, self._targets, self._monitor, self._tips = state, targets, monitor, tips
        self._arm, node = state.arm, state.node
        self._look_s, self._period_s = state.p["reach.look_s"], state.p["reach.feedback_s"]
        self._turns: deque[object] = deque()
        self._ticks = Ticks(node, self._period_s)
        self._told: dict[str, Motion] = {}  # by trajectory id, since the present goal began
        self._server = graph.REACH.server(node, self._serve_goal)

    def on_motion(self, motion: Motion) -> None:
        """Note a message of the driver about a trajectory; may be called from any thread."""
        if self._turns and motion.event != Motion.ACCEPTED:
            self._told.setdefault(motion.id, motion)

    @property
    def _no_driver(self) -> str:
        """The reason why no driver will report the end of a move; empty if one will."""
        if not self._state.driver.acknowledged:
            return "the driver does not report what is reached: acknowledged is false"
        return self._state.driver.refusal

    async def _serve_goal(self, goal: Any) -> Reach.Result:
        turn = object()
        asked = goal.request
        target = self._targets.new_target(
            asked.target, asked.position_only, wanted=lambda: not goal.is_cancel_requested
        )
        fresh = not self._targets.stale(target)
        self._turns.append(turn)
        try:
            while self._turns[0] is not turn:
                if goal.is_cancel_requested:
                    goal.canceled()
                    return _make_unseen("cancelled before it began")
                self._give_feedback(goal, Reach.Feedback.WAITING, None)
                await self._ticks.next()
            if fresh:  # waiting for other goals, which the feedback reports, makes it no older
                target = replace(target, turn_s=sleepless_s())
            return await self._reach_target(goal, target)
        finally:
            self._turns.remove(turn)

    async def _reach_target(self, goal: Any, target: TargetRequest) -> Reach.Result:
        if self._no_driver:
            goal.abort()
            return _make_unseen(self._no_driver, Compensate.Response.NO_DRIVER)
        before, self._told = self._monitor.sighted, {}
        asked = self._targets.execute(target)
        if asked is None:
            goal.abort()
            return _make_unseen("too many targets wait", Compensate.Response.NOT_READY)
        answer: Answer = await asked
        result = _make_unseen(answer.message, int(answer.status))
        result.id = answer.name
        if not answer.status.success or answer.outcome is None:
            (goal.canceled if goal.is_cancel_requested else goal.abort)()
            return result
        command = answer.outcome.command
        result.command = joints_message(self._arm, command, answer.stamp)
        if not await self._follow_move(goal, answer.name, command, result):
            return result
        await self._look_for_tip(goal, command, before, result)
        result.success = True
        stands, at = self._tips.tell(), answer.target.pose.pose.position
        if stands is not None:
            said = stands.describe(np.array([at.x, at.y, at.z]))
            result.message = f"{result.message}; {said}" if result.message else said
        goal.succeed()
        return result

    async def _follow_move(
        self, goal: Any, name: str, command: np.ndarray, result: Reach.Result
    ) -> bool:
        """Wait for the end of the move; return whether it was reached, else end the goal."""
        halted = False
        while (motion := self._told.get(name)) is None and not self._no_driver:
            if goal.is_cancel_requested and not halted:
                halted, name = True, self._targets.halt()
            self._give_feedback(goal, Reach.Feedback.MOVING, command)
            await self._ticks.next()
        # The joints as the driver reports them with the end, else their last readings
        if motion is not None and motion.joints.name:
            result.reached = motion.joints
        elif (q := self._state.joints) is not None:
            result.reached = joints_message(self._arm, q, self._state.stamp)
        if motion is not None and motion.event == Motion.REACHED and not halted:
            return True
        event, why = (None, self._no_driver) if motion is None else (motion.event, motion.message)
        if halted:
            result.message = f"cancelled: {describe_halt(event, why)}"
            goal.canceled()
            return False
        result.message = why
        goal.abort()
        return False

    async def _look_for_tip(
        self, goal: Any, command: np.ndarray, before: Sighted | None, result: Reach.Result
    ) -> None:
        """Wait for the tip at rest, if somebody measures it; enter tip and miss in the result."""
        node = self._state.node
        seen_by = node.count_publishers(node.resolve_topic_name(graph.TIP_MEASURED.name))
        if seen_by and self._monitor.unplaced:
            result.message = self._monitor.unplaced
            return
        for _ in range(math.ceil(self._look_s / self._period_s) if seen_by else 0):
            sighted = self._monitor.sighted
            if sighted is not None and sighted is not before:
                if np.abs(sighted.q - command).max() > SAME_POSE:
                    return
                result.seen = True
                result.tip.x, result.tip.y, result.tip.z = sighted.tip.tolist()
                result.miss = vector_message(sighted.miss)
                return
            if goal.is_cancel_requested:
                return
            self._give_feedback(goal, Reach.Feedback.LOOKING, command)
            await self._ticks.next()

    def _give_feedback(self, goal: Any, phase: int, command: np.ndarray | None) -> None:
        q, message = self._state.joints, Reach.Feedback(phase=phase)
        if q is not None:
            message.joints = joints_message(self._arm, q)
            if command is not None:
                message.remaining = (command - q).tolist()
        goal.publish_feedback(message)


def _make_unseen(message: str, status: int = 0) -> Reach.Result:
    """Make the result of a goal without a sighting: tip and miss are NaN."""
    result = Reach.Result(message=message, status=status, miss=vector_message([math.nan] * 3))
    result.tip.x = result.tip.y = result.tip.z = math.nan
    return result
