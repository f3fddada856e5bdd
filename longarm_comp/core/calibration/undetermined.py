"""Tells where a fit puts bases and sensors, and what the rows do not tell about it.

A tip that only ever touched unknown points looks the same on an arm twice as large.  The size is
then that of the drawing. To know it takes a known distance between two points, or a slide's travel.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.spatial import ZERO, Frame, exp_large, roll_pitch_yaw, scale, tangent
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.effects.placements import BasePose, RigidMotion
from longarm_comp.core.model.model import Model

UNTOLD = 0.1
"""Posterior standard deviation, in that of a prior that knows nothing, of what rows do not tell."""
STEP = 1e-4
"""Share by which the arm is made larger, to see what changes."""


def list_undetermined(fit: ModelFit) -> tuple[str, ...]:
    """Name what the rows do not tell of bases, markers and sensors: ``base: x, y, turn about z``.

    The size of the arm may be among it; it stays as declared.  A base's directions are those of the
    measurements' frame.
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
        where: its name.
        xyz_m, rpy_deg: (3,) its pose.
        sd_mm, sd_deg: (3,) standard deviations along and about the axes of that frame.
    """

    where: str
    xyz_m: tuple[float, ...]
    rpy_deg: tuple[float, ...]
    sd_mm: tuple[float, ...]
    sd_deg: tuple[float, ...]


def list_places(fit: ModelFit) -> tuple[Place, ...]:
    """Return where a fit puts bases, further sensors and a fitted camera."""
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
    """Return the derivative (6, 6) of a pose's shift (m) and turn (rad) in its outer frame by its
    term's values."""
    turns, shifts = (np.array(each).T for each in tangent(term.twist, ZERO, large=True))
    axes = at.matrix()[:3, :3]
    return np.block([[axes @ turns, axes @ shifts], [np.zeros((3, 3)), axes @ turns]])


def is_size_determined(fit: ModelFit) -> bool:
    """Tell whether the rows tell more of the arm's size than the tolerances of its drawing do.

    Both are informations (inverse variances) about the size: that of the rows, with touched points
    solved anew, and that of the drawing, the sum of (length / tolerance)^2.
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
    """Return the model with every length of its geometry multiplied, except known distances."""
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
