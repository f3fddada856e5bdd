"""Records of the targets that `kinematics` gets and of its answers, and the messages of both."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
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
from longarm_comp.nodes.messages import FARTHEST, fill, joints_message, pose_message, vector_message
from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate


class Refusal(LongarmError):  # noqa: N818
    """A target that is refused before any computation: a status and a reason."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def target_of(message: PoseStamped, position_only: bool) -> np.ndarray:
    """Return the target as a pose (4, 4), m, or as a position (3,) if the orientation is free.

    Raises:
        Refusal: the position is not finite or too far away, or the quaternion has no unit length.
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
    """One target that waits for its answer."""

    name: str  # its id
    pose: PoseStamped  # in any known frame
    position_only: bool  # its orientation is ignored
    sent_s: float  # when it was sent, sleepless s
    turn_s: float = -math.inf  # when its turn came after others; until then it did not age
    execute: bool = True  # the computed joints are sent to the driver
    # where the search begins; without names: at the present joints
    seed: JointState = field(default_factory=JointState)
    method: str = ""  # what is compensated; empty: as the node's parameter says
    wanted: Callable[[], bool] = lambda: True  # False once its client has cancelled it


@dataclass(frozen=True)
class Answer:
    """Everything that is published about one target on `compensation`."""

    target: TargetRequest  # expressed in the base frame if its joints were computed
    status: Status
    message: str
    method: str
    model_hash: str  # SHA-256 of model.yaml; empty without a file
    predictor_hash: str = ""
    arrival: Arrival | None = None  # the result; None if the target was refused before
    order: str = ""  # id of the trajectory sent for the target; empty if none was sent
    accepted: bool = False  # by the driver: this trajectory

    @property
    def name(self) -> str:
        """The id under which the answer is published: the trajectory's, else the target's."""
        return self.order or self.target.name

    @property
    def stamp(self) -> Time:
        return self.target.pose.header.stamp

    @property
    def outcome(self) -> Outcome | None:
        return None if self.arrival is None else self.arrival.outcome


_RECORD, _RESPONSE, _POSE = Compensation(), Compensate.Response(), PoseStamped()


def compensation_message(answer: Answer, arm: Arm, base_frame: str) -> Compensation:
    """Make the message with the full record of one target."""
    context = Context() if answer.arrival is None else answer.arrival.context
    sides = {float(side) for side in context.approach}
    published = fill(
        _RECORD,
        header=Header(stamp=answer.stamp, frame_id=base_frame),
        accepted=answer.accepted,
        target=answer.target.pose,
        position_only=answer.target.position_only,
        method=answer.method,
        temperature_c=float(context.column("temperature_c", math.nan)),
        payload_kg=float(context.payload_kg(arm.payload.mass_kg if arm.payload else 0.0)),
        approach=int(sides.pop()) if len(sides) == 1 else 0,
        approach_joints=[int(side) for side in context.approach],
        travel=[float(leg) for leg in context.legs[::LEGS]],
        arm_hash=arm.hash,
        model_hash=answer.model_hash,
        predictor_hash=answer.predictor_hash,
        **_shared_fields(answer, arm, base_frame),
    )
    if answer.order and answer.outcome is not None:
        published.executed = joints_message(arm, answer.outcome.command, answer.stamp)
    return published


def response_of(answer: Answer, arm: Arm, base_frame: str) -> Compensate.Response:
    """Make the response to the request of one target."""
    success = answer.status.success
    response = fill(_RESPONSE, success=success, **_shared_fields(answer, arm, base_frame))
    if success and answer.arrival is not None:
        response.command = joints_message(arm, answer.arrival.outcome.command, answer.stamp)
        response.approach = [int(side) for side in answer.arrival.move.side]
    return response


def _shared_fields(answer: Answer, arm: Arm, base_frame: str) -> dict[str, Any]:
    """Return the fields that `Compensation` and the response share, by name; NaN if unknown."""
    fields = {"id": answer.name, "status": int(answer.status), "message": answer.message}
    if answer.arrival is None:
        return fields | {"sigma": math.nan, "predicted_error": vector_message([math.nan] * 3)}
    outcome, run_up, stamp = answer.arrival.outcome, answer.arrival.move.run_up, answer.stamp
    if run_up is not None:
        fields["run_up"] = joints_message(arm, run_up, stamp)
    header, pseudo = Header(stamp=stamp, frame_id=base_frame), pose_message(outcome.pseudo_target)
    return fields | {
        "ideal": joints_message(arm, outcome.ideal, stamp),
        "predicted_error": vector_message(outcome.predicted_error),
        "pseudo_target": fill(_POSE, header=header, pose=pseudo),
        "sigma": float(np.max(outcome.sigma)),
        "in_domain": bool(outcome.in_domain),
        "passes": int(outcome.passes),
    }
