"""Lists where a fit puts bases and sensors, and which parts of this the rows do not determine.

If the tip only touched unknown points, an arm of twice the size would fit as well.  The size is
then that of the drawing.  A known distance between two points, or a slide's travel, determines it.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.spatial import ZERO, Frame, exp_large, roll_pitch_yaw, scale, tangent
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.effects.placements import BasePose, RigidMotion
from longarm_comp.core.model.model import Model

UNTOLD = 0.1
"""Ratio of posterior to prior standard deviation above which an unknown is not determined."""
STEP = 1e-4
"""Relative enlargement of the arm for the derivative by its size."""


def list_undetermined(fit: ModelFit) -> tuple[str, ...]:
    """List the placements that the rows do not determine, as ``base: x, y, turn about z``.

    If the size of the arm is not determined, it is listed too and stays as declared.  The
    directions of a base are those of the frame of the measurements.
    """
    found = []
    for k, term in enumerate(fit.model.terms):
        mine = [i for i, slot in enumerate(fit.slots) if slot.term == k and slot.parameter.unknown]
        if not mine or term.passing:
            continue
        names = [fit.slots[i].parameter.name for i in mine]
        covariance = fit.covariance[np.ix_(mine, mine)]
        if isinstance(term, BasePose) and len(mine) == 6:
            motion = _pose_derivative(term, term.base(fit.model.arm))
            covariance = motion @ covariance @ motion.T
            names = ["x", "y", "z", "turn about x", "turn about y", "turn about z"]
        widths = np.array([fit.slots[i].parameter.width for i in mine])
        wide = np.sqrt(np.diag(covariance)) > UNTOLD * widths
        if wide.any():
            which = ", ".join(name for name, left in zip(names, wide, strict=True) if left)
            found.append(f"{term.where}: {which}")
    return (*found, *(() if is_size_determined(fit) else ("the size of the arm",)))


@dataclass(frozen=True)
class Place:
    """The place of a base or a sensor in the frame of the measurements, and its uncertainty.

    Attributes:
        where: name of the base or sensor.
        xyz_m, rpy_deg: (3,) position (m) and roll, pitch, yaw (deg).
        sd_mm, sd_deg: (3,) standard deviations along and about the axes of that frame.
    """

    where: str
    xyz_m: tuple[float, ...]
    rpy_deg: tuple[float, ...]
    sd_mm: tuple[float, ...]
    sd_deg: tuple[float, ...]


def list_places(fit: ModelFit) -> tuple[Place, ...]:
    """Return the poses of bases, further sensors and a fitted camera in a fit."""
    made = []
    for k, term in enumerate(fit.model.terms):
        if not isinstance(term, RigidMotion):
            continue
        mine = [i for i, slot in enumerate(fit.slots) if slot.term == k]
        at = term.base(fit.model.arm) if isinstance(term, BasePose) else exp_large(term.twist)
        motion, pose = _pose_derivative(term, at), at.matrix()
        sd = np.sqrt(np.diag(motion @ fit.covariance[np.ix_(mine, mine)] @ motion.T))
        turn = np.degrees(roll_pitch_yaw(pose[:3, :3]))
        figures = (pose[:3, 3], turn, 1e3 * sd[:3], np.degrees(sd[3:]))
        made.append(Place(term.where, *(tuple(each.tolist()) for each in figures)))
    return tuple(made)


def _pose_derivative(term: RigidMotion, at: Frame) -> np.ndarray:
    """Return the derivative (6, 6) of a pose by the six values of its term.

    Rows are displacement (m) and rotation (rad) in the frame in which the pose `at` is given.
    """
    turns, shifts = (np.array(each).T for each in tangent(term.twist, ZERO, large=True))
    axes = at.matrix()[:3, :3]
    return np.block([[axes @ turns, axes @ shifts], [np.zeros((3, 3)), axes @ turns]])


def is_size_determined(fit: ModelFit) -> bool:
    """Tell whether the rows determine the arm's size better than the tolerances of its drawing.

    The inverse variances of the relative size are compared: that by the rows, with touched points
    free, and that by the drawing, which is the sum of (length / tolerance)^2.
    """
    larger = _enlarge_arm(fit.model, 1.0 + STEP)
    seen = make_equations(larger, fit.session, ()).residual
    change = fit.whiten_columns((seen - fit.residual)[..., None] / STEP)[:, 0]
    passing = fit.design[:, [slot.owner.passing for slot in fit.slots]]
    gram = np.eye(passing.shape[1]) + passing.T @ passing
    along = passing.T @ change
    by_rows = float(change @ change - along @ np.linalg.solve(gram, along))
    by_drawing = 0.0
    for slot in fit.slots:
        if slot.owner.geometry and slot.parameter.unit == "m" and "row" in slot.owner.places:
            joint = fit.model.arm.joints[slot.owner.places["row"] - 1]
            length = getattr(joint, f"{slot.parameter.name}_m", 0.0)
            by_drawing += (length / slot.parameter.width) ** 2
    return by_rows > by_drawing


def _enlarge_arm(model: Model, times: float) -> Model:
    """Return the model with all lengths of its geometry, except known distances, times a factor."""
    values = model.values.copy()
    for k, slot in enumerate(model.slots):
        if slot.owner.geometry and slot.parameter.unit == "m" and slot.parameter.name != "stretch":
            values[k] *= times
    joints, arm = [], model.arm
    for joint in arm.joints:
        pose = joint.pose
        if pose is not None:
            pose = pose.model_copy(update={"xyz_m": scale(times, pose.xyz_m)})
        sizes = {"a_m": times * joint.a_m, "d_m": times * joint.d_m, "pose": pose}
        joints.append(joint.model_copy(update=sizes))
    tip = arm.tip.model_copy(update={"position_m": scale(times, arm.tip.position_m)})
    markers = {
        name: marker.model_copy(update={"position_m": scale(times, marker.position_m)})
        for name, marker in arm.markers.items()
    }
    arm = arm.model_copy(update={"joints": tuple(joints), "tip": tip, "markers": markers})
    return dataclasses.replace(model.with_values(values), arm=arm)
