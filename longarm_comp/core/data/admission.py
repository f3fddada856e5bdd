"""Admission: checks whether a session fits the arm.  Errors in it are not repaired.

An invalid session (millimetres, degrees, rows out of order) is refused with an `InputError` that
names the likely mistake.  A limitation of a valid one (a joint that never moved) is a finding.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.data.belonging import find_mistake, undo_mistakes
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import check_touches
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import robust_kabsch

FEW_POSES = 4
"""Smallest number of distinct poses: three points place a frame, and a fourth one checks it."""


@dataclass(frozen=True)
class AdmissionFinding:
    """A limitation of an admitted session.

    Attributes:
        check: name of the check.
        field: the column or input that it concerns.
        message: its text for people.
    """

    check: str
    field: str
    message: str

    def __str__(self) -> str:
        return f"{self.field}: {self.message}"


@dataclass(frozen=True)
class Admission:
    """An admitted session and the findings about it."""

    session: Session
    findings: tuple[AdmissionFinding, ...]


def admit(
    session: Session,
    arm: Arm,
    model: Model | None = None,
    min_poses: int = FEW_POSES,
    *,
    judge: bool = False,
) -> Admission:
    """Check a session against an arm, and return it with the findings.

    Rows without a reading of an inclinometer are left out.

    Args:
        model: predicts the tip; the rigid declared arm by default.
        min_poses: smallest number of distinct poses with a measurement.
        judge: the rows are used to judge the model, so rows that do not fit it are a finding
            instead of an error.

    Raises:
        InputError: the session is invalid, is too small, or does not belong to the arm.
    """
    findings: list[AdmissionFinding] = []
    session = _with_readings(session, findings)
    model = model or Model(arm)
    _check_names(session, arm)
    for name, values in session.columns.items():
        check_circumstance(arm, name, values, session.source)
    findings += _check_joints(session, arm)
    _check_loads(session, arm)
    _check_groups(session)
    findings += (AdmissionFinding("touch", *found) for found in check_touches(session, arm))
    findings += _check_blanks(session)
    for j in np.flatnonzero(np.ptp(session.q, axis=0) < arm.telling):
        text = "never moved: its effects do not show"
        findings.append(AdmissionFinding("constant", f"q{j + 1}", text))
    for name, values in session.columns.items():
        if len(session) > 1 and np.ptp(values) == 0:
            text = "never changed: its effects do not show"
            findings.append(AdmissionFinding("constant", name, text))
    findings += _check_copies(session)
    poses = len(np.unique(session.take(session.seen).pose_id))
    if poses < min_poses:
        field = "rows" if len(session) < 2 else "poses with a marker"
        allowed = f"at least {min_poses} distinct poses"
        raise session.error(field, poses, allowed)
    located = session.take(session.has_position)
    if len(located):
        predicted = model.measured(located.q, located.context())
        _check_spread(located, arm, predicted)
        findings += _check_belonging(session, model, judge)
        for group in np.unique(located.frames):
            rows = located.frames == group
            if len(np.unique(located.pose_id[rows])) >= 2 * FEW_POSES:
                findings += _check_frame(located.take(rows), arm, predicted[rows], str(group))
    return Admission(session, tuple(findings))


def _with_readings(session: Session, findings: list[AdmissionFinding]) -> Session:
    """Return the rows in which every inclinometer was read, and add findings about the others.

    An inclinometer that was not read in most of the rows is left out instead of these rows.
    """
    for name, values in session.columns.items():
        blank = np.isnan(values)
        if blank.mean() > 0.5:  # the inclinometer is left out instead of the rows
            rest = {k: v for k, v in session.columns.items() if k != name}
            session = dataclasses.replace(session, columns=rest)
            findings.append(AdmissionFinding("blanks", name, f"left out, {blank.mean():.0%} blank"))
    names = [name for name, values in session.columns.items() if np.isnan(values).any()]
    if not names:
        return session
    blank = np.any([np.isnan(session.columns[name]) for name in names], axis=0)
    text = f"{blank.sum()} rows left out in which it is blank"
    findings.append(AdmissionFinding("blanks", ", ".join(names), text))
    return session.take(~blank)


# ------------------------------------------------------------------ before any prediction


def _check_names(session: Session, arm: Arm) -> None:
    """Refuse joints, labels and columns that the arm does not have, and missing ones it needs."""
    if session.n != arm.n:
        allowed = f"{arm.n} commanded joints of arm {arm.name}"
        raise session.error("joints", session.n, allowed)
    markers, anchors = list(arm.markers), [*arm.anchors, ""]
    for label, declared in (("marker", markers), ("anchor", anchors)):
        for name in np.unique(session.labels.get(label, np.zeros(0, dtype=str))):
            if any(declared) and name not in declared:
                raise session.error(label, str(name), f"one of {', '.join(filter(None, declared))}")
    if "ray" in session.readings:
        seen = np.isfinite(session.readings["ray"]).all(axis=1)
        for sensor in np.unique(session.labels["sensor"][seen]):
            if sensor not in arm.sensors:
                known = ", ".join(arm.sensors) or "none"
                allowed = f"a camera of arm.yaml's sensors (there are: {known})"
                raise session.error("sensor", str(sensor), allowed)
    for mass in arm.point_masses:
        for column in mass.position_columns or ():
            if column not in session.columns:
                raise session.error(f"column {column}", "missing", f"where {mass.name} is, m")
    for name in session.columns:
        match = INCLINATION.match(name)
        if match and match[1] not in arm.inclinometers:
            allowed = f"incl_<frame>_x, _y with frame one of {', '.join(arm.inclinometers)}"
            raise session.error(f"column {name}", f"frame {match[1]}", f"{allowed} (0 is the base)")


def _check_loads(session: Session, arm: Arm) -> None:
    """Refuse loads under which the declared beams would bend by more than the arm's own reach."""
    rows = np.unique(np.linspace(0, len(session) - 1, 100).astype(int))
    if not arm.links:
        return
    declared = arm.payload.mass_kg if arm.payload else 0.0
    loads = session.columns.get("payload_kg", np.full(len(session), declared))
    some = session.take(np.union1d(rows, [np.argmax(loads)]))
    rigid = Model(arm).tip(some.q, some.context())
    with np.errstate(all="ignore"):
        sag = np.linalg.norm(declared_model(arm).tip(some.q, some.context()) - rigid, axis=1)
    if not (sag <= reach(arm)).all():
        allowed = "a load that the beams of arm.yaml carry: look at E_pa, sections and masses"
        raise session.error("payload_kg", float(loads.max()), allowed)


def _check_groups(session: Session) -> None:
    """Refuse groups with rows out of order, a repeated index, or fewer than three positions.

    A group holds the rows from one place of the base. Three points determine this place.
    """
    groups, markers = session.texts("group"), session.texts("marker")
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        name, values = "index", session.index
        if session.t_s is not None:
            name, values = "t_s", session.t_s  # the index only names a row
        back = np.flatnonzero(np.diff(values[rows]) < 0)
        if len(back):
            at = rows[back[0] + 1]
            said = f"{values[at]:g} after {values[rows[back[0]]]:g}"
            allowed = "rows in the order of recording: what a joint did before is read from it"
            raise session.error(f"{name} of row {at + 1}", said, allowed)
        keys = list(zip(session.index[rows], markers[rows], strict=True))
        if len(set(keys)) < len(keys):
            twice = next(k for k, key in enumerate(keys) if key in keys[:k])
            field = f"index of row {rows[twice] + 1}"
            raise session.error(field, int(keys[twice][0]), "each index once")
    if "group" in session.labels:
        for group, count in Counter(groups[session.has_position].tolist()).items():
            if count < 3:
                allowed = "at least 3 rows from a place of the base, or they cannot say where it is"
                raise session.error(f"group {group!r}", f"{count} rows", allowed)


def _check_joints(session: Session, arm: Arm) -> Iterator[AdmissionFinding]:
    q = session.q
    reach = arm.upper - arm.lower
    beyond = np.maximum(np.maximum(arm.lower - q, q - arm.upper), 0.0)
    endless = np.isinf(arm.bounds[1])
    # half a range; an endless joint may stand turns away, and so far it is another unit
    most = np.where(endless, 5.0 * np.pi, 0.5 * reach)
    for kind, factor, hint in (
        (~arm.slides, np.pi / 180, "radians (this looks like degrees)"),
        (arm.slides, 1e-3, "metres (this looks like millimetres)"),
    ):
        far = (beyond > most) & kind
        if not far.any():
            continue
        row, j = np.unravel_index(np.argmax(np.where(far, beyond / reach, 0)), q.shape)
        limits = f"{arm.lower[j]:.6g} to {arm.upper[j]:.6g} of {arm.joint_names[j]}"
        scaled, slack = q[:, j] * factor, 0.05 * reach[j]
        within = (scaled > arm.lower[j] - slack) & (scaled < arm.upper[j] + slack)
        # five times a joint's largest value, and more, are another unit
        many = abs(q[row, j]) > 5.0 * max(abs(arm.lower[j]), abs(arm.upper[j]))
        if other := _find_exchange(arm, session):
            limits = f"{limits} ({other})"
        elif many and within.mean() > 0.95:
            # joints that all stay within a turn may well be in radians
            small = factor == np.pi / 180 and np.abs(q[:, kind]).max() < (2 * np.pi)
            doubt = f"{limits}; degrees, or limits that are too narrow?"
            limits = doubt if small else f"{hint}: {limits}"
        raise session.error(f"row {row + 1}, q{j + 1}", float(q[row, j]), limits)
    for j in np.flatnonzero((beyond > 1e-6).any(0) & ~endless):
        count, worst = int((beyond[:, j] > 1e-6).sum()), beyond[:, j].max()
        text = f"{count} rows up to {worst:.3g} beyond its limits"
        yield AdmissionFinding("limits", f"q{j + 1}", text)


def _find_exchange(arm: Arm, session: Session) -> str:
    """Return the mistake of sign or order of joints that explains values outside the limits.

    Without it all joints lie within their limits. Empty if there is no such mistake.
    """
    slack = 0.05 * (arm.upper - arm.lower)
    for what, undone in undo_mistakes(arm, session):
        inside = (undone.q > arm.lower - slack) & (undone.q < arm.upper + slack)
        if what.endswith(("negated", "swapped")) and inside.all():
            return what
    return ""


def _check_blanks(session: Session) -> Iterator[AdmissionFinding]:
    lost = int((~session.seen).sum())
    field = ", ".join(c for kind in session.kinds for c in kind.cells or (kind.label,))
    if lost == len(session):
        raise session.error(field, f"blank in all {lost} rows", "measured tip positions (m)")
    blank = np.isnan(session.xyz).all(axis=0)
    for axis in np.array(["x", "y", "z"])[blank] if not blank.all() else ():
        yield AdmissionFinding("blanks", str(axis), "measured in no row")
    if not session.placed.any():
        text = "no row measures the tip: tip and base stay as declared"
        yield AdmissionFinding("blanks", "x, y, z", text)
    if lost:
        share = lost / len(session)
        why = Counter(session.lost.values())
        causes = ", ".join(f"{cause} in {count}" for cause, count in why.most_common())
        text = f"nothing measured in {lost} rows ({share:.0%})"
        yield AdmissionFinding("blanks", field, f"{text}: {causes}" if causes else text)


def _check_copies(session: Session) -> Iterator[AdmissionFinding]:
    seen = session.take(session.has_position)
    _, first, which = np.unique(seen.xyz, axis=0, return_index=True, return_inverse=True)
    before = first[which.reshape(-1)]
    marker = seen.texts("marker")
    again = (before < np.arange(len(seen))) & (marker[before] == marker)
    same_pose = seen.pose_id[before] == seen.pose_id
    copies, frozen = int((again & same_pose).sum()), int((again & ~same_pose).sum())
    hidden = (seen.xyz == 0.0).all(axis=1)
    if len(np.unique(seen.pose_id[hidden])) > 1:
        value = f"0, 0, 0 in {hidden.sum()} rows at several poses"
        raise session.error("x, y, z", value, "blank where the marker was hidden")
    if copies and 2 * copies >= len(seen):
        value = f"{copies} of {len(seen)} are copies"
        raise session.error("rows", value, "measured rows, once each")
    if copies:
        text = f"{copies} repeat pose and measurement to the last digit"
        yield AdmissionFinding("duplicates", "rows", text)
    if frozen:
        text = f"{frozen} rows repeat another pose's measurement exactly"
        yield AdmissionFinding("duplicates", "x, y, z", text)


# ------------------------------------------------------------------ against the prediction


def _check_spread(session: Session, arm: Arm, predicted: np.ndarray) -> None:
    expected, found = median_spread(predicted), median_spread(session.xyz)
    if expected < 1e-6:
        return
    ratio, value = found / expected, f"spread {found:.4g}"
    for unit, size in (("millimetres", 1e3), ("centimetres", 1e2), ("inches", 39.37)):
        if size / 2 < ratio < size * 2:
            raise session.error("x, y, z", value, f"metres (this looks like {unit})")
    if not 0.4 < ratio < 2.5:
        allowed = f"positions in m that spread as arm {arm.name} does, {expected:.4g} m"
        raise session.error("x, y, z", value, allowed)
    stated = np.zeros(0) if session.sigma is None else session.sigma[np.isfinite(session.sigma)]
    sigma = float(np.median(stated)) if len(stated) else 0.0
    if sigma > 0.2 * expected:
        allowed = "metres, well below the arm's reach"
        raise session.error("sigma_x, sigma_y, sigma_z", sigma, allowed)


def _check_frame(
    session: Session, arm: Arm, predicted: np.ndarray, group: str
) -> Iterator[AdmissionFinding]:
    """Compare the positions of one frame with the predicted ones (N, 3), m.

    Yields findings about the axes and place of the frame, and about outliers.

    Raises:
        InputError: the axes are mirrored.
    """
    measured = session.xyz
    field = "x, y, z" + (f" of group {group}" if group else "")

    def spread_after(turn: np.ndarray) -> float:
        return median_spread(measured - predicted @ turn.T)

    clear = 0.3 * spread_after(np.eye(3))
    turn, offset = robust_kabsch(predicted, measured)
    residual = measured - predicted @ turn.T - offset
    misfit, (axes, name) = median_distance(residual), _nearest_axes(turn)
    flip = np.diag([1.0, 1.0, -1.0])
    mirror, mirrored = _nearest_axes(flip @ robust_kabsch(predicted, measured @ flip)[0])
    if spread_after(mirror) < min(clear, 0.5 * misfit):
        allowed = "a right-handed x,y,z in the base frame"
        raise session.error(field, f"axes like {mirrored}", allowed)
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    away = np.linalg.norm(np.median(measured - predicted, axis=0))
    if misfit < clear and angle > np.radians(20.0):
        like = f", axes like {name}" if spread_after(axes) < clear else ""
        base = arm.base.frame().matrix()
        xyz = ", ".join(f"{v:.3f}" for v in turn @ base[:3, 3] + offset)
        rpy = ", ".join(f"{v:.1f}" for v in np.degrees(roll_pitch_yaw(turn @ base[:3, :3])))
        text = f"turned by {np.degrees(angle):.0f} deg against the declared arm{like}"
        text = f"{text}; as base: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}"
        yield AdmissionFinding("frame", field, text)
    elif away > 0.3 * median_spread(predicted):
        yield AdmissionFinding("frame", field, f"{away:.3f} m away from where the declared arm is")
    distance = np.linalg.norm(residual, axis=1)
    far = distance > max(8.0 * 1.4826 * misfit, 1e-9)  # eight robust standard deviations
    if far.any():
        worst = 1e3 * distance.max()
        text = f"{far.sum()} gross outliers ({far.mean():.1%}), the worst {worst:.0f} mm"
        yield AdmissionFinding("outliers", field, text)


def _check_belonging(session: Session, model: Model, judge: bool) -> Iterator[AdmissionFinding]:
    """Refuse rows that do not belong to the arm at any placement, and name the likely mistake.

    Raises:
        InputError: the rows do not belong to the arm; with `judge` this is a finding instead.
    """
    belief = find_mistake(model, session)
    if belief is None:
        return
    for j, moved in belief.signs:
        text = f"its sign does not show: negated it moves the tip by {1e3 * moved:.2g} mm only"
        yield AdmissionFinding("sign", f"q{j + 1}", text)
    if belief.belong:
        return
    field, value = "rows", f"{1e3 * belief.misfit:.3g} mm off the arm, wherever it stands"
    if belief.mistake:
        value = f"{belief.mistake}: {belief.fall}"
    elif belief.is_scattered:
        field, value = "x, y, z", f"{belief.strays.share:.0%} of the rows are far off the others"
    else:
        value += ", as if shuffled"
    if not judge:
        raise session.error(field, value, f"rows of arm {model.arm.name}; nothing was changed")
    yield AdmissionFinding("belonging", field, value)


def _nearest_axes(turn: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the signed permutation of axes (3, 3) nearest to a rotation or mirror, and its name.

    The name lists the axes with their signs, as ``y,-x,z``.
    """
    place = np.abs(turn).argmax(axis=1)
    signs = np.sign(turn[range(3), place])
    names = ("-" * bool(v < 0) + "xyz"[k] for k, v in zip(place, signs, strict=True))
    return signs[:, None] * np.eye(3)[place], ",".join(names)
