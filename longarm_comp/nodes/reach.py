"""Action `reach`: a target, feedback while the arm moves, and where the tip came to rest."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Any, Protocol

import numpy as np
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.compensation.stands import TipByReadings
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import Answer, joints_message, vector_message
from longarm_comp.nodes.monitoring import Sighted
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.targets import Request, TargetInlet
from longarm_comp.nodes.ticks import Ticks
from longarm_interfaces.action import Reach
from longarm_interfaces.msg import Motion
from longarm_interfaces.srv import Compensate

PARAMS = (
    Param("reach.feedback_s", 0.1, "between two feedbacks of the action reach", 0.01, 10.0),
    Param("reach.look_s", 5.0, "patience with sightings of the tip at rest; 0: none", 0.0, 600.0),
)


class _ReachSite(Protocol):
    """What the action needs of `kinematics`."""

    @property
    def targets(self) -> TargetInlet:
        """Where targets are asked for."""

    @property
    def joints(self) -> np.ndarray | None:
        """(n,) last reading."""

    @property
    def no_driver(self) -> str:
        """Why no driver will say that a move is done; empty where it does."""

    @property
    def sees(self) -> bool:
        """Whether anybody publishes `tip_measured`."""

    @property
    def sighted(self) -> Sighted | None:
        """The tip at the last target that the arm rested at."""

    @property
    def tip_by_readings(self) -> TipByReadings | None:
        """Where the tip stands now by the readings of the joints."""


class ReachServer:
    """Serves one goal after another, in the order of arrival, on the node's executor."""

    def __init__(
        self, node: Node, arm: Arm, site: _ReachSite, feedback_s: float, look_s: float
    ) -> None:
        self._arm, self._site, self._look_s = arm, site, look_s
        self._node, self._period_s = node, feedback_s
        self._turns: deque[object] = deque()
        self._ticks = Ticks(node, feedback_s)
        self._told: dict[str, Motion] = {}  # by trajectory, since the goal at hand was begun
        self._server = ActionServer(
            node, graph.REACH.type, graph.REACH.name, self._serve,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )  # fmt: skip

    def told(self, motion: Motion) -> None:
        """Take what the driver says of a trajectory; from any thread."""
        if self._turns and motion.event != Motion.ACCEPTED:
            self._told.setdefault(motion.id, motion)

    # ------------------------------------------------------------------ one goal

    async def _serve(self, goal: Any) -> Reach.Result:
        turn = object()
        request = self._site.targets.asked(
            Compensate.Request(
                target=goal.request.target, position_only=goal.request.position_only, execute=True
            )
        )
        fresh = not self._site.targets.stale(request)
        self._turns.append(turn)
        try:
            while self._turns[0] is not turn:
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Reach.Result(message="cancelled before it was begun", **_unseen())
                self._feedback(goal, Reach.Feedback.WAITING, None)
                await self._ticks.next()
            if fresh:  # waiting for its turn, of which the client is told, makes it no older
                request.since = time.monotonic()
            return await self._reach(goal, request)
        finally:
            self._turns.remove(turn)

    async def _reach(self, goal: Any, request: Request) -> Reach.Result:
        if self._site.no_driver:
            goal.abort()
            status = Compensate.Response.NO_DRIVER
            return Reach.Result(status=status, message=self._site.no_driver, **_unseen())
        before, self._told = self._site.sighted, {}
        asked = self._site.targets.execute(request)
        if asked is None:
            goal.abort()
            return Reach.Result(
                status=Compensate.Response.NOT_READY, message="too many targets wait", **_unseen()
            )
        answer: Answer = await asked
        result = Reach.Result(
            status=int(answer.status), message=answer.message, id=answer.name, **_unseen()
        )
        if not answer.status.success or answer.outcome is None:
            goal.abort()
            return result
        command = answer.outcome.command
        result.command = joints_message(self._arm, command, answer.target.header.stamp)
        if not await self._moves(goal, answer.name, command, result):
            return result
        await self._looks(goal, command, before, result)
        result.success = True
        self._at_rest(result)
        stands, target = self._site.tip_by_readings, answer.target.pose.position
        if stands is not None:
            said = stands.said(np.array([target.x, target.y, target.z]))
            result.message = f"{result.message}; {said}" if result.message else said
        goal.succeed()
        return result

    async def _moves(self, goal: Any, name: str, command: np.ndarray, result: Reach.Result) -> bool:
        """Wait until the driver says what became of the move; whether it was reached."""
        halted = False
        while (motion := self._told.get(name)) is None and not self._site.no_driver:
            if goal.is_cancel_requested and not halted:
                halted, name = True, self._site.targets.halt()
            self._feedback(goal, Reach.Feedback.MOVING, command)
            await self._ticks.next()
        if motion is not None and motion.event == Motion.REACHED and not halted:
            return True
        self._at_rest(result)
        if halted:
            result.message = "cancelled: the arm was stopped"
            goal.canceled()
            return False
        result.message = self._site.no_driver if motion is None else motion.message
        goal.abort()
        return False

    async def _looks(
        self, goal: Any, command: np.ndarray, before: Sighted | None, result: Reach.Result
    ) -> None:
        """Wait for the tip to be seen at rest, where anybody looks."""
        for _ in range(math.ceil(self._look_s / self._period_s) if self._site.sees else 0):
            sighted = self._site.sighted
            if sighted is not None and sighted is not before:
                if np.abs(sighted.q - command).max() > SAME_POSE:
                    return
                result.seen = True
                result.tip.x, result.tip.y, result.tip.z = sighted.tip.tolist()
                result.miss = vector_message(sighted.miss)
                return
            if goal.is_cancel_requested:
                return
            self._feedback(goal, Reach.Feedback.LOOKING, command)
            await self._ticks.next()

    def _at_rest(self, result: Reach.Result) -> None:
        q = self._site.joints
        if q is not None:
            result.reached = joints_message(self._arm, q, self._node.get_clock().now().to_msg())

    def _feedback(self, goal: Any, phase: int, command: np.ndarray | None) -> None:
        q, message = self._site.joints, Reach.Feedback(phase=phase)
        if q is not None:
            message.joints = joints_message(self._arm, q)
            if command is not None:
                message.remaining = (command - q).tolist()
        goal.publish_feedback(message)


def _unseen() -> dict[str, Any]:
    tip = Reach.Result().tip
    tip.x = tip.y = tip.z = math.nan
    return {"tip": tip, "miss": vector_message([math.nan] * 3)}
