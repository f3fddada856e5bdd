"""Places an arm before anything is fitted, and tells what its rows cannot tell about its place.

A tip that only ever touched unknown points looks the same on an arm twice as large.  The size is
then that of the drawing. To know it takes a known distance between two points, or a slide's travel.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.spatial import ZERO, Frame, exp_large, roll_pitch_yaw, scale, tangent
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import number_sightings
from longarm_comp.core.calibration.placement import (
    choose_reference_rows,
    place_bases,
    place_sensors,
    sensor_terms,
)
from longarm_comp.core.data.measurement import (
    compute_posture,
    compute_tip_errors,
    compute_turn_errors,
    make_equations,
)
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import ELSEWHERE
from longarm_comp.core.effects.placements import BasePose, RigidMotion, TipOffset, TipOrientation
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.tip_motion import stack

TWICE = 2
"""Numbers that rows hold, in those that place an arm, from which the rest says what it errs by."""
UNTOLD = 0.1
"""Posterior standard deviation, in that of a prior that knows nothing, of what rows do not tell."""
STEP = 1e-4
"""Share by which the arm is made larger, to see what changes."""


def placement_terms(arm: Arm, session: Session) -> tuple[Effect | Bias, ...]:
    """Return the placement terms of any measurement: bases, markers and what sensors leave open."""
    groups = sorted(set(session.labels["group"])) if "group" in session.labels else []
    bases = tuple(BasePose(group=str(g)) for g in groups) if len(groups) > 1 else (BasePose(),)
    placed = bases if session.has_own_frame(arm) else ()
    return (*placed, *TipOffset.for_arm(arm), *sensor_terms(arm, session))


def place_frames(model: Model, session: Session) -> Model:
    """Return the model with bases, markers and sensors placed by the rows, in closed form."""
    whole = model.with_missing(placement_terms(model.arm, session))
    return place_sensors(place_bases(whole, choose_reference_rows(session)), session)


class SeenModel(NamedTuple):
    """A model whose errors can be shown.

    `elsewhere`: whether the rows show the arm at another place. `placed`: whether they placed it,
    because they tell more than a place.
    """

    model: Model
    elsewhere: bool
    placed: bool


def place_as_seen(model: Model, session: Session) -> SeenModel:
    """Place a model by the rows if they show it at another place, and tell more than a place.

    The axes of a tracked body are never declared, so how they sit on the tip is always solved. Rows
    tell more if they hold `TWICE` the numbers that place the model, each sighting counted once:
    with hardly more numbers the placement would fit them whatever the arm does.  The numbers that
    solve touched points are subtracted from both.
    """
    bodies = [t for t in placement_terms(model.arm, session) if isinstance(t, TipOrientation)]
    whole = model.with_missing(bodies)
    axes = model if whole.terms == model.terms else place_sensors(whole, session)
    groups = (session.take(session.frames == name) for name in np.unique(session.frames))
    if not any(is_misplaced(axes, rows) for rows in groups):
        return SeenModel(axes, elsewhere=False, placed=False)
    moved, seen = place_frames(model, session), session.take(session.seen)
    rows = seen.take(np.unique(number_sightings(seen), axis=0, return_index=True)[1])
    slots = [slot for slot in moved.slots if slot.parameter.unknown]
    found = make_equations(moved, rows, slots)
    columns = (found.columns * [slot.parameter.width for slot in slots]).reshape(-1, len(slots))
    passing = columns[:, [slot.owner.passing for slot in slots]]
    placing, points = (int(np.linalg.matrix_rank(each, rtol=1e-6)) for each in (columns, passing))
    more = int(rows.measured.sum()) - points >= TWICE * (placing - points)
    return SeenModel(moved if more else axes, elsewhere=True, placed=more)


def is_misplaced(model: Model, session: Session) -> bool:
    """Tell whether the rows show the arm at another place than a model puts it.

    Then the median error exceeds `ELSEWHERE` of the way that its frames travel (or in rad).  A tip
    that touches a point does not travel; the arm behind it does.
    """
    if not session.placed.any():
        return (
            bool(session.turned.any())
            and median_distance(compute_turn_errors(model, session)) > ELSEWHERE
        )
    rows = session.take(session.placed)
    at = compute_posture(model, rows)
    frames = [stack(frame.p) for frame in (*at.frames, model.tip_frame(at))]
    travel = max(median_spread(p) for p in frames if p.ndim == 2)
    return median_distance(compute_tip_errors(model, rows)) > ELSEWHERE * travel


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
