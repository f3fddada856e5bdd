"""Admission: checks whether a session fits the arm.  Errors in it are not repaired.

An invalid session (millimetres, degrees, rows out of order) is refused with an `InputError` that
names the likely mistake.  A limitation of a valid one (a joint that never moved) is a finding.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.measuring import CameraSensor
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.data.belonging import find_mistake, sample_rows, undo_mistakes
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import check_touches
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import robust_kabsch

FEW_POSES = 4
"""Smallest number of distinct poses: three points place a frame, and a fourth one checks it."""


class AdmissionFinding(NamedTuple):
    """A limitation of an admitted session: the column or input, and a text about it."""

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
    _check_names(session, arm)
    for name, values in session.columns.items():
        check_circumstance(arm, name, values, session.source)
    findings += _check_joints(session, arm)
    _check_loads(session, arm)
    _check_groups(session)
    findings += (AdmissionFinding(*found) for found in check_touches(session, arm))
    findings += _check_blanks(session)
    constant = {f"q{j + 1}": "moved" for j in np.flatnonzero(np.ptp(session.q, 0) < arm.telling)}
    for name, values in session.columns.items() if len(session) > 1 else ():
        if np.ptp(values) == 0:
            constant[name] = "changed"
    for name, done in constant.items():
        findings.append(AdmissionFinding(name, f"never {done}: its effects do not show"))
    findings += _check_copies(session)
    poses = len(np.unique(session.take(session.seen).pose_id))
    if poses < min_poses:
        field = "rows" if len(session) < 2 else "poses with a marker"
        raise session.error(field, poses, f"at least {min_poses} distinct poses")
    located = session.take(session.has_position)
    if len(located):
        model = model or Model(arm)
        predicted = model.measured(located.q, located.context())
        _check_spread(located, arm, predicted)
        findings += _check_belonging(session, model, judge)
        for group in np.unique(located.frames):
            rows = located.frames == group
            if len(np.unique(located.pose_id[rows])) >= 2 * FEW_POSES:
                findings += _check_frame(located.take(rows), arm, predicted[rows], str(group))
    return Admission(session, tuple(findings))


def _with_readings(session: Session, findings: list[AdmissionFinding]) -> Session:
    """Return the rows in which every inclinometer was read, and add findings about the others."""
    kept = dict(session.columns)
    for name, values in session.columns.items():
        share = np.isnan(values).mean()
        if share > 0.5:  # the inclinometer is left out instead of the rows
            del kept[name]
            findings.append(AdmissionFinding(name, f"left out, {share:.0%} blank"))
    if len(kept) < len(session.columns):
        session = dataclasses.replace(session, columns=kept)
    names = [name for name, values in kept.items() if np.isnan(values).any()]
    if not names:
        return session
    blank = np.any([np.isnan(kept[name]) for name in names], axis=0)
    text = f"{blank.sum()} rows left out in which it is blank"
    findings.append(AdmissionFinding(", ".join(names), text))
    return session.take(~blank)


# ------------------------------------------------------------------ before any prediction


def _check_names(session: Session, arm: Arm) -> None:
    """Refuse joints, labels and columns that the arm does not have, and missing ones it needs."""
    if session.n != arm.n:
        allowed = f"{arm.n} commanded joints of arm {arm.name}"
        raise session.error("joints", session.n, allowed)
    for label, declared in (("marker", arm.markers), ("anchor", {**arm.anchors, "": None})):
        for name in np.unique(session.labels.get(label, np.zeros(0, dtype=str))):
            if any(declared) and name not in declared:
                raise session.error(label, str(name), f"one of {', '.join(filter(None, declared))}")
    cameras = [name for name, each in arm.sensors.items() if isinstance(each, CameraSensor)]
    for sensor in session.names_of(KINDS["ray"]):
        if sensor not in cameras:
            known = ", ".join(cameras) or "none"
            allowed = f"a camera of arm.yaml's sensors (there are: {known})"
            raise session.error("sensor", sensor, allowed)
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
    if not arm.links:
        return
    declared = arm.payload.mass_kg if arm.payload else 0.0
    loads = session.columns.get("payload_kg", np.full(len(session), declared))
    some = session.take(np.union1d(sample_rows(session), [np.argmax(loads)]))
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
    name, values = "index", session.index
    if session.t_s is not None:
        name, values = "t_s", session.t_s  # the index only names a row
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        back = np.flatnonzero(np.diff(values[rows]) < 0)
        if len(back):
            at = rows[back[0] + 1]
            said = f"{values[at]:g} after {values[rows[back[0]]]:g}"
            allowed = "rows in the order of recording: what a joint did before is read from it"
            raise session.error(f"{name} of row {at + 1}", said, allowed)
        seen = set()
        for row in rows:
            key = session.index[row], markers[row]
            if key in seen:
                raise session.error(f"index of row {row + 1}", int(key[0]), "each index once")
            seen.add(key)
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
        low, high = arm.lower - 0.05 * reach, arm.upper + 0.05 * reach
        exchanged = (
            what
            for what, undone in undo_mistakes(arm, session)
            if what.endswith(("negated", "swapped"))
            and ((undone.q > low) & (undone.q < high)).all()
        )
        scaled = q[:, j] * factor
        within = (scaled > low[j]) & (scaled < high[j])
        # five times a joint's largest value, and more, are another unit
        many = abs(q[row, j]) > 5.0 * max(abs(arm.lower[j]), abs(arm.upper[j]))
        if other := next(exchanged, ""):
            limits = f"{limits} ({other})"
        elif many and within.mean() > 0.95:
            # joints that all stay within a turn may well be in radians
            small = factor == np.pi / 180 and np.abs(q[:, kind]).max() < (2 * np.pi)
            doubt = f"{limits}; degrees, or limits that are too narrow?"
            limits = doubt if small else f"{hint}: {limits}"
        raise session.error(f"row {row + 1}, q{j + 1}", float(q[row, j]), limits)
    for j in np.flatnonzero((beyond > 1e-6).any(0) & ~endless):
        count, worst = int((beyond[:, j] > 1e-6).sum()), beyond[:, j].max()
        yield AdmissionFinding(f"q{j + 1}", f"{count} rows up to {worst:.3g} beyond its limits")


def _check_blanks(session: Session) -> Iterator[AdmissionFinding]:
    lost = int((~session.seen).sum())
    field = ", ".join(c for kind in session.kinds for c in kind.cells or (kind.label,))
    if lost == len(session):
        raise session.error(field, f"blank in all {lost} rows", "measured tip positions (m)")
    blank = np.isnan(session.xyz).all(axis=0)
    for axis in np.array(["x", "y", "z"])[blank] if not blank.all() else ():
        yield AdmissionFinding(str(axis), "measured in no row")
    if not session.placed.any():
        text = "no row measures the tip: tip and base stay as declared"
        yield AdmissionFinding("x, y, z", text)
    if lost:
        why = Counter(session.lost.values())
        causes = ", ".join(f"{cause} in {count}" for cause, count in why.most_common())
        text = f"nothing measured in {lost} rows ({lost / len(session):.0%})"
        yield AdmissionFinding(field, f"{text}: {causes}" if causes else text)


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
        yield AdmissionFinding("rows", f"{copies} repeat pose and measurement to the last digit")
    if frozen:
        text = f"{frozen} rows repeat another pose's measurement exactly"
        yield AdmissionFinding("x, y, z", text)


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
    """Compare the positions of one frame with the predicted ones (N, 3), m; refuse mirrored axes.

    Yields findings about the axes and place of the frame, and about outliers.
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
        yield AdmissionFinding(field, text)
    elif away > 0.3 * median_spread(predicted):
        yield AdmissionFinding(field, f"{away:.3f} m away from where the declared arm is")
    distance = np.linalg.norm(residual, axis=1)
    far = distance > max(8.0 * 1.4826 * misfit, 1e-9)  # eight robust standard deviations
    if far.any():
        worst = 1e3 * distance.max()
        text = f"{far.sum()} gross outliers ({far.mean():.1%}), the worst {worst:.0f} mm"
        yield AdmissionFinding(field, text)


def _check_belonging(session: Session, model: Model, judge: bool) -> Iterator[AdmissionFinding]:
    """Refuse rows that do not belong to the arm at any placement, and name the likely mistake.

    With `judge` this is a finding instead.
    """
    belief = find_mistake(model, session)
    if belief is None:
        return
    for j, moved in belief.signs:
        text = f"its sign does not show: negated it moves the tip by {1e3 * moved:.2g} mm only"
        yield AdmissionFinding(f"q{j + 1}", text)
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
    yield AdmissionFinding(field, value)


def _nearest_axes(turn: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the signed permutation of axes (3, 3) nearest to a rotation or mirror, and its name.

    The name lists the axes with their signs, as ``y,-x,z``.
    """
    place = np.abs(turn).argmax(axis=1)
    signs = np.sign(turn[range(3), place])
    names = ("-" * bool(v < 0) + "xyz"[k] for k, v in zip(place, signs, strict=True))
    return signs[:, None] * np.eye(3)[place], ",".join(names)
