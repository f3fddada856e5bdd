"""Targets of `kinematics` and their answers: the records, and their messages."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.compensation.arrive import Arrival
from longarm_comp.core.compensation.compensate import Compensation as Outcome
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.errors import LongarmError
from longarm_comp.nodes.messages import FARTHEST, joints_message, pose_message, vector_message
from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate


class Refusal(LongarmError):  # noqa: N818
    """A target that is refused before any computation: a status and a reason."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def target_of(message: PoseStamped, position_only: bool) -> np.ndarray:
    """Return the target as (4, 4), or (3,) where the orientation is free (m, its own frame).

    Raises:
        Refusal: numbers that are not finite, no unit quaternion.
    """
    p, o = message.pose.position, message.pose.orientation
    xyz = np.array([p.x, p.y, p.z])
    if not (np.abs(xyz) <= FARTHEST).all():
        allowed = f"allowed: finite, up to {FARTHEST:g} m"
        raise Refusal(Status.BAD_TARGET, f"position {xyz.tolist()}; {allowed}")
    if position_only:
        return xyz
    turn = np.array([o.x, o.y, o.z, o.w])
    if not quaternion.is_unit(turn):
        wrong = f"orientation {turn.tolist()} is not a unit quaternion"
        raise Refusal(Status.BAD_TARGET, wrong)
    return quaternion.compute_pose(xyz, turn)


@dataclass(frozen=True)
class TargetRequest:
    """One target in work.

    Attributes:
        name: its id.
        pose: the target as it came, in whichever frame.
        execute: whether its joints are sent to the driver.
        sent_s: when it was sent (monotonic s).
        seed: joints at which the search begins; without names, where the arm is.
    """

    name: str
    pose: PoseStamped
    position_only: bool
    execute: bool
    sent_s: float
    seed: JointState = field(default_factory=JointState)


@dataclass(frozen=True)
class Answer:
    """Everything that is published about one target on `compensation`.

    Attributes:
        name: id of the target.
        model_hash, predictor_hash: SHA-256 of the files in use; empty without one.
        arrival: the computation; None for a target that was refused before it.
        sent, accepted: whether its joints were sent, and taken up by the driver.
    """

    name: str
    target: PoseStamped
    position_only: bool
    status: Status
    message: str
    method: str
    model_hash: str
    predictor_hash: str = ""
    arrival: Arrival | None = None
    sent: bool = False
    accepted: bool = False

    @property
    def outcome(self) -> Outcome | None:
        return None if self.arrival is None else self.arrival.outcome


def compensation_message(answer: Answer, arm: Arm, base_frame: str) -> Compensation:
    """Make the message with the full record of one target."""
    context = Context() if answer.arrival is None else answer.arrival.context
    sides = {float(side) for side in context.approach}
    published = Compensation(
        header=Header(stamp=answer.target.header.stamp, frame_id=base_frame),
        id=answer.name,
        accepted=answer.accepted,
        target=answer.target,
        position_only=answer.position_only,
        status=int(answer.status),
        message=answer.message,
        method=answer.method,
        temperature_c=float(context.column("temperature_c", math.nan)),
        payload_kg=float(context.payload_kg(arm.payload.mass_kg if arm.payload else 0.0)),
        approach=int(sides.pop()) if len(sides) == 1 else 0,
        approach_joints=[int(side) for side in context.approach],
        travel=[float(leg) for leg in context.legs[::LEGS]],
        arm_hash=arm.hash,
        model_hash=answer.model_hash,
        predictor_hash=answer.predictor_hash,
    )
    _fill(published, answer, arm, base_frame)
    if answer.sent and answer.outcome is not None:
        published.executed = joints_message(arm, answer.outcome.command, answer.target.header.stamp)
    return published


def response_of(answer: Answer, arm: Arm, base_frame: str) -> Compensate.Response:
    response = Compensate.Response(
        success=answer.status.success,
        status=int(answer.status),
        message=answer.message,
        id=answer.name,
    )
    _fill(response, answer, arm, base_frame)
    if answer.status.success and answer.arrival is not None:
        command, stamp = answer.arrival.outcome.command, answer.target.header.stamp
        response.command = joints_message(arm, command, stamp)
        response.approach = [int(side) for side in answer.arrival.move.side]
    return response


def _fill(
    message: Compensation | Compensate.Response, answer: Answer, arm: Arm, base_frame: str
) -> None:
    """Set the fields that both messages share. An unknown number is NaN."""
    message.sigma = math.nan
    if answer.arrival is None:
        message.predicted_error = vector_message([math.nan] * 3)
        return
    outcome, run_up = answer.arrival.outcome, answer.arrival.move.run_up
    stamp = answer.target.header.stamp
    if run_up is not None:
        message.run_up = joints_message(arm, run_up, stamp)
    message.ideal = joints_message(arm, outcome.ideal, stamp)
    message.predicted_error = vector_message(outcome.predicted_error)
    message.pseudo_target = PoseStamped(
        header=Header(stamp=stamp, frame_id=base_frame), pose=pose_message(outcome.pseudo_target)
    )
    message.sigma = float(np.max(outcome.sigma))
    message.in_domain = bool(outcome.in_domain)
    message.passes = int(outcome.passes)
