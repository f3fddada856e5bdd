"""Admission: checks a session against the arm that it claims to show.  Nothing is repaired.

An invalid session (millimetres, degrees, rows out of order) is refused with an `InputError` that
names the likely mistake.  A limitation of a valid one (a joint that never moved) is a finding.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.data.belonging import MOST_STRAYS, believe, mistakes
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import check_touches
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import robust_kabsch

FEW_POSES = 4
"""Distinct poses, at least: three points place a frame, one more contradicts."""


@dataclass(frozen=True)
class AdmissionFinding:
    """A limitation of a session that is admitted."""

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


@dataclass(frozen=True, eq=False)
class _Case:
    session: Session
    arm: Arm
    seen: Session
    predicted: np.ndarray  # (M, 3) of the rows with a whole position
    model: Model

    def refuse(self, field: str, value: object, allowed: str) -> InputError:
        return InputError(self.session.source, field, value, allowed)


def admit(
    session: Session, arm: Arm, model: Model | None = None, min_poses: int = FEW_POSES,
    *, judge: bool = False,
) -> Admission:  # fmt: skip
    """Check a session against an arm. It needs `min_poses` distinct poses with a marker.

    Args:
        model: predicts the tip; the rigid declared arm by default.
        judge: the rows judge the model: what does not fit it is a finding.
    """
    findings: list[AdmissionFinding] = []
    session = _with_readings(session, findings)
    physics = model or Model(arm)
    case = _Case(session, arm, session, np.empty((0, 3)), physics)
    for check in _BEFORE:
        findings += check(case) or ()
    seen = session.take(session.seen)
    poses = len(np.unique(seen.pose_id))
    if poses < min_poses:
        field = "rows" if len(session) < 2 else "poses with a marker"
        raise case.refuse(field, poses, f"at least {min_poses} distinct poses")
    located = session.take(session.located)
    if len(located):
        predicted = physics.measured(located.q, located.context())
        case = _Case(session, arm, located, predicted, physics)
        _lengths(case)
        findings += (*_belongs(case, judge), *_frame(case))
    return Admission(session, tuple(findings))


def _with_readings(session: Session, findings: list[AdmissionFinding]) -> Session:
    """The rows in which every inclinometer was read; one that mostly was not is left out."""
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


def _same_arm(case: _Case) -> None:
    if case.session.n != case.arm.n:
        allowed = f"{case.arm.n} commanded joints of arm {case.arm.name}"
        raise case.refuse("joints", case.session.n, allowed)
    markers, anchors = list(case.arm.markers), [*case.arm.anchors, ""]
    for label, declared in (("marker", markers), ("anchor", anchors)):
        for name in np.unique(case.session.labels.get(label, np.zeros(0, dtype=str))):
            if any(declared) and name not in declared:
                raise case.refuse(label, str(name), f"one of {', '.join(filter(None, declared))}")
    if "ray" in case.session.readings:
        seen = np.isfinite(case.session.readings["ray"]).all(axis=1)
        for sensor in np.unique(case.session.labels["sensor"][seen]):
            if sensor not in case.arm.sensors:
                known = ", ".join(case.arm.sensors) or "none"
                allowed = f"a camera of arm.yaml's sensors (there are: {known})"
                raise case.refuse("sensor", str(sensor), allowed)
    for mass in case.arm.point_masses:
        for column in mass.position_columns or ():
            if column not in case.session.columns:
                raise case.refuse(f"column {column}", "missing", f"where {mass.name} is, m")


def _inclinometers(case: _Case) -> None:
    known = case.arm.inclinometers
    for name in case.session.columns:
        match = INCLINATION.match(name)
        if match and match[1] not in known:
            allowed = f"incl_<frame>_x, _y with frame one of {', '.join(known)}"
            raise case.refuse(f"column {name}", f"frame {match[1]}", f"{allowed} (0 is the base)")


def _plausible_context(case: _Case) -> None:
    for name, values in case.session.columns.items():
        check_circumstance(case.arm, name, values, case.session.source)


def _bearable(case: _Case) -> None:
    """Refuse loads under which the declared beams would bend by more than the arm's own reach."""
    rows = np.unique(np.linspace(0, len(case.session) - 1, 100).astype(int))
    if not case.arm.links:
        return
    declared = case.arm.payload.mass_kg if case.arm.payload else 0.0
    loads = case.session.columns.get("payload_kg", np.full(len(case.session), declared))
    some = case.session.take(np.union1d(rows, [np.argmax(loads)]))
    rigid = Model(case.arm).tip(some.q, some.context())
    with np.errstate(all="ignore"):
        sag = np.linalg.norm(declared_model(case.arm).tip(some.q, some.context()) - rigid, axis=1)
    if not (sag <= reach(case.arm)).all():
        allowed = "a load that the beams of arm.yaml carry: look at E_pa, sections and masses"
        raise case.refuse("payload_kg", float(loads.max()), allowed)


def _order(case: _Case) -> None:
    session = case.session
    groups = session.labels.get("group", np.full(len(session), ""))
    markers = session.labels.get("marker", np.full(len(session), ""))
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
            raise case.refuse(f"{name} of row {at + 1}", said, allowed)
        keys = list(zip(session.index[rows], markers[rows], strict=True))
        if len(set(keys)) < len(keys):
            twice = next(k for k, key in enumerate(keys) if key in keys[:k])
            field = f"index of row {rows[twice] + 1}"
            raise case.refuse(field, int(keys[twice][0]), "each index once")


def _joint_units(case: _Case) -> Iterator[AdmissionFinding]:
    q, arm = case.session.q, case.arm
    reach = arm.upper - arm.lower
    beyond = np.maximum(np.maximum(arm.lower - q, q - arm.upper), 0.0)
    endless = np.isinf(arm.bounds[1])
    # half a range; an endless joint may stand turns away, and so far it is another unit
    most = np.where(endless, 5.0 * np.pi, 0.5 * reach)
    turning = np.array([arm.joints[row - 1].type == "revolute" for row in arm.commanded])
    for kind, factor, hint in (
        (turning, np.pi / 180, "radians (this looks like degrees)"),
        (~turning, 1e-3, "metres (this looks like millimetres)"),
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
        if other := _exchanged(arm, case.session):
            limits = f"{limits} ({other})"
        elif many and within.mean() > 0.95:
            # joints that all stay within a turn may well be in radians
            small = factor == np.pi / 180 and np.abs(q[:, kind]).max() < (2 * np.pi)
            limits = f"{limits}; degrees, or limits that are too narrow?" if small else (
                f"{hint}: {limits}"
            )  # fmt: skip
        raise case.refuse(f"row {row + 1}, q{j + 1}", float(q[row, j]), limits)
    for j in np.flatnonzero((beyond > 1e-6).any(0) & ~endless):
        count, worst = int((beyond[:, j] > 1e-6).sum()), beyond[:, j].max()
        text = f"{count} rows up to {worst:.3g} beyond its limits"
        yield AdmissionFinding("limits", f"q{j + 1}", text)


def _exchanged(arm: Arm, session: Session) -> str:
    """The sign or order of joints that brings all of them within their limits; else empty."""
    slack = 0.05 * (arm.upper - arm.lower)
    for what, undone in mistakes(arm, session):
        inside = (undone.q > arm.lower - slack) & (undone.q < arm.upper + slack)
        if what.endswith(("negated", "swapped")) and inside.all():
            return what
    return ""


def _measured_at_all(case: _Case) -> Iterator[AdmissionFinding]:
    lost = int((~case.session.seen).sum())
    field = ", ".join(c for kind in case.session.kinds for c in kind.cells or (kind.label,))
    if lost == len(case.session):
        raise case.refuse(field, f"blank in all {lost} rows", "measured tip positions (m)")
    blank = np.isnan(case.session.xyz).all(axis=0)
    for axis in np.array(["x", "y", "z"])[blank] if not blank.all() else ():
        yield AdmissionFinding("blanks", str(axis), "measured in no row")
    if not case.session.placed.any():
        text = "no row measures the tip: tip and base stay as declared"
        yield AdmissionFinding("blanks", "x, y, z", text)
    if lost:
        share = lost / len(case.session)
        why = Counter(case.session.lost.values())
        causes = ", ".join(f"{cause} in {count}" for cause, count in why.most_common())
        text = f"nothing measured in {lost} rows ({share:.0%})"
        yield AdmissionFinding("blanks", field, f"{text}: {causes}" if causes else text)


def _constant(case: _Case) -> Iterator[AdmissionFinding]:
    for j in np.flatnonzero(np.ptp(case.session.q, axis=0) < case.arm.telling):
        yield AdmissionFinding("constant", f"q{j + 1}", "never moved: its effects do not show")
    for name, values in case.session.columns.items():
        if len(case.session) > 1 and np.ptp(values) == 0:
            yield AdmissionFinding("constant", name, "never changed: its effects do not show")


def _touches(case: _Case) -> Iterator[AdmissionFinding]:
    found = check_touches(case.session, case.arm)
    return (AdmissionFinding("touch", field, message) for field, message in found)


def _copies(case: _Case) -> Iterator[AdmissionFinding]:
    seen = case.session.take(case.session.located)
    first: dict[bytes, int] = {}
    copies = frozen = 0
    marker = seen.labels.get("marker", np.full(len(seen), ""))
    for i, xyz in enumerate(seen.xyz):
        before = first.setdefault(xyz.tobytes(), i)
        if before == i or marker[before] != marker[i]:
            continue
        if seen.pose_id[before] == seen.pose_id[i]:
            copies += 1
        else:
            frozen += 1
    hidden = (seen.xyz == 0.0).all(axis=1)
    if len(np.unique(seen.pose_id[hidden])) > 1:
        value = f"0, 0, 0 in {hidden.sum()} rows at several poses"
        raise case.refuse("x, y, z", value, "blank where the marker was hidden")
    if 2 * copies > len(seen):
        raise case.refuse("rows", f"{copies} of {len(seen)} are copies", "measured rows, once each")
    if copies:
        text = f"{copies} repeat pose and measurement to the last digit"
        yield AdmissionFinding("duplicates", "rows", text)
    if frozen:
        text = f"{frozen} rows repeat another pose's measurement exactly"
        yield AdmissionFinding("duplicates", "x, y, z", text)


# ------------------------------------------------------------------ against the prediction


def _lengths(case: _Case) -> None:
    expected, found = median_spread(case.predicted), median_spread(case.seen.xyz)
    if expected < 1e-6:
        return
    ratio = found / expected
    for unit, size in (("millimetres", 1e3), ("centimetres", 1e2), ("inches", 39.37)):
        if size / 2 < ratio < size * 2:
            raise case.refuse("x, y, z", f"spread {found:.4g}", f"metres (this looks like {unit})")
    if not 0.4 < ratio < 2.5:
        allowed = f"positions in m that spread as arm {case.arm.name} does, {expected:.4g} m"
        raise case.refuse("x, y, z", f"spread {found:.4g}", allowed)
    stated = np.zeros(0) if case.seen.sigma is None else case.seen.sigma
    value = float(np.median(stated[np.isfinite(stated)])) if np.isfinite(stated).any() else 0.0
    if value > 0.2 * expected:
        raise case.refuse("sigma_x, sigma_y, sigma_z", value, "metres, well below the arm's reach")


def _frame(case: _Case) -> Iterator[AdmissionFinding]:
    groups = case.seen.frames
    for group in np.unique(groups):
        rows = groups == group
        if len(np.unique(case.seen.pose_id[rows])) < 2 * FEW_POSES:
            continue
        yield from _frame_of(case, case.predicted[rows], case.seen.xyz[rows], str(group))


def _frame_of(
    case: _Case, predicted: np.ndarray, measured: np.ndarray, group: str
) -> Iterator[AdmissionFinding]:
    field = "x, y, z" + (f" of group {group}" if group else "")

    def left(turn: np.ndarray) -> float:
        return median_spread(measured - predicted @ turn.T)

    clear = 0.3 * left(np.eye(3))
    turn, offset = robust_kabsch(predicted, measured)
    residual = measured - predicted @ turn.T - offset
    misfit, (axes, name) = median_distance(residual), _axes(turn)
    flip = np.diag([1.0, 1.0, -1.0])
    mirror, mirrored = _axes(flip @ robust_kabsch(predicted, measured @ flip)[0])
    if left(mirror) < min(clear, 0.5 * misfit):
        allowed = "a right-handed x,y,z in the base frame"
        raise case.refuse(field, f"axes like {mirrored}", allowed)
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    away = np.linalg.norm(np.median(measured - predicted, axis=0))
    if misfit < clear and angle > np.radians(20.0):
        like = f", axes like {name}" if left(axes) < clear else ""
        text = f"turned by {np.degrees(angle):.0f} deg against the declared arm{like}"
        yield AdmissionFinding("frame", field, f"{text}; as {_base(case.arm, turn, offset)}")
    elif away > 0.3 * median_spread(predicted):
        yield AdmissionFinding("frame", field, f"{away:.3f} m away from where the declared arm is")
    distance = np.linalg.norm(residual, axis=1)
    far = distance > max(8.0 * 1.4826 * misfit, 1e-9)  # eight robust standard deviations
    if far.any():
        worst = 1e3 * distance.max()
        text = f"{far.sum()} gross outliers ({far.mean():.1%}), the worst {worst:.0f} mm"
        yield AdmissionFinding("outliers", field, text)


def _belongs(case: _Case, judge: bool) -> Iterator[AdmissionFinding]:
    """Whether the arm makes these rows, wherever it stands; with the likely mistake if not."""
    belief = believe(case.model, case.session)
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
    elif belief.stray >= MOST_STRAYS:
        field, value = "x, y, z", f"{belief.stray:.0%} of the rows are far off the others"
    else:
        value += ", as if shuffled"
    if not judge:
        raise case.refuse(field, value, f"rows of arm {case.arm.name}; nothing was changed")
    yield AdmissionFinding("belonging", field, value)


def _axes(turn: np.ndarray) -> tuple[np.ndarray, str]:
    """The exchange of axes, with signs, nearest to a rotation or mirror (3, 3); its name."""
    place = np.abs(turn).argmax(axis=1)
    signs = np.sign(turn[range(3), place])
    names = ("-" * bool(v < 0) + "xyz"[k] for k, v in zip(place, signs, strict=True))
    return signs[:, None] * np.eye(3)[place], ",".join(names)


def _base(arm: Arm, turn: np.ndarray, offset: np.ndarray) -> str:
    """The `base` entry of arm.yaml that would explain a turned frame."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, offset
    frame = matrix @ arm.base.frame().matrix()
    rpy = np.degrees(roll_pitch_yaw(frame[:3, :3]))
    xyz = ", ".join(f"{v:.3f}" for v in frame[:3, 3])
    return f"base: {{xyz_m: [{xyz}], rpy_deg: [{', '.join(f'{v:.1f}' for v in rpy)}]}}"


_BEFORE: tuple[Callable[[_Case], Iterable[AdmissionFinding] | None], ...] = (
    *(_same_arm, _inclinometers, _plausible_context, _joint_units, _bearable, _order, _touches),
    *(_measured_at_all, _constant, _copies),
)
