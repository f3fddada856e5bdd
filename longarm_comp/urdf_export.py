"""A calibrated arm as a URDF: the joint origins of the model's rigid part, exactly.

A joint's screw axis is found from its row's frame at two joint values, so all geometry effects on a
row are in its joint's origin and axis.  A URDF is rigid: deflection, play and the like stay in
model.yaml.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.joint import Joint
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import exp_large, roll_pitch_yaw
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.link_frames import BASE_LINK, TIP, joint_name, link_name
from longarm_comp.core.model.model import Model, unstack

Placed = tuple[Joint, np.ndarray, np.ndarray]
"""A row in the URDF: joint, its frame (4, 4) in the link before, its axis (3,) in its own frame."""


def export_urdf(model: Model, group: str = "", marker: str = "") -> str:
    """Return the rigid part of a model as URDF text, from `base_link` to `tip`.

    The link `base_link` is the frame of the measurements.

    Args:
        model: arm and effects; those that are no geometry are left out.
        group: which base placement to use, if the model has several.
        marker: marker to export as `tip`, instead of the arm's tip.
    """
    arm, geometry = model.arm, model.rigid
    context = _context(geometry, group, marker)
    placed, last, inner = _rows(geometry, context)
    bodies = _bodies(geometry, context, inner)
    root = ET.Element("robot", {"name": arm.name})
    root.append(ET.Comment(_write_remark(model)))
    ET.SubElement(root, "link", {"name": BASE_LINK})
    parent = BASE_LINK
    for row in placed:
        joint = row[0]
        node = ET.SubElement(root, "link", {"name": link_name(joint)})
        held = [m for m in arm.point_masses if m.frame == joint.id and not m.position_columns]
        points = [(m.mass_kg, inner[joint.id] @ np.append(m.position_m, 1.0)) for m in held]
        _add_inertial(node, [(m, p[:3]) for m, p in (*points, *bodies.get(joint.id, ())) if m > 0])
        _joint(root, arm, row, parent if joint.moves else BASE_LINK)
        parent = link_name(joint) if joint.moves else parent
    ET.SubElement(root, "link", {"name": TIP})
    node = ET.SubElement(root, "joint", {"name": "to_tip", "type": "fixed"})
    _ends(node, last, parent, TIP)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def zero_offsets(model: Model) -> list[tuple[str, float, str]]:
    """Return (joint name, value, unit): where joints with a zero error stand when commanded to 0.

    The joint origins of the URDF contain it already; a driver may correct it instead.
    """
    made = []
    for term in model.effects:
        if term.geometry and term.displaces_joint:
            (parameter,) = term.parameters(model.arm)
            row = model.arm.joints[term.joints[0] - 1]
            value = float(getattr(term, parameter.name))
            made.append((joint_name(row), value, parameter.unit))
    return made


def _context(model: Model, group: str, marker: str) -> Context:
    labels: dict[str, object] = {}
    for name, chosen in (("group", group), ("marker", marker)):
        placed = {str(e.places[name]) for e in model.effects if e.places.get(name)}
        known = placed | (set(model.arm.markers) if name == "marker" else set())
        if chosen and chosen not in known:
            raise InputError("export-urdf", f"--{name}", chosen, ", ".join(sorted(known)) or "none")
        if not chosen and len(placed) > 1:
            raise InputError("export-urdf", f"--{name}", "missing", ", ".join(sorted(known)))
        if chosen:
            labels[name] = chosen
    return Context(labels=labels)


def _rows(model: Model, context: Context) -> tuple[list[Placed], np.ndarray, dict[int, np.ndarray]]:
    """Return the placed rows, the tip (4, 4) in the last link, and each row's frame in its link."""
    arm = model.arm
    reach = np.maximum(np.abs(arm.mixing[0]).max(axis=0), 1.0)
    start = arm.mid
    end = start + np.minimum(0.25 * (arm.upper - arm.lower), 1.0) / reach
    at, then = (_frames(model, model.posture(unstack(q), context)) for q in (start, end))
    values = np.stack([start, end]) @ arm.mixing[0].T + arm.mixing[1]
    placed: list[Placed] = []
    inner: dict[int, np.ndarray] = {0: np.eye(4)}
    before = at[0]  # the frame before in its link; the first link is the measuring frame
    for k, joint in enumerate(arm.joints):
        step = _within(at[k], at[k + 1])
        turn = _within(step, _within(then[k], then[k + 1]))
        moved = values[1, k] - values[0, k]
        if not joint.moves:  # a link of its own at the base, which only leads others
            placed.append((joint, np.eye(4), np.array([0.0, 0.0, 1.0])))
            before = before @ step
            continue
        if joint.type == "fixed" or moved == 0.0:
            placed.append((joint, before @ step, np.array([0.0, 0.0, 1.0])))
            before = inner[joint.id] = np.eye(4)
            continue
        slides = joint.type == "prismatic"
        axis, point = _find_screw(turn, moved, slides)
        shift = np.eye(4)
        shift[:3, 3] = point
        back = -values[0, k] * axis
        twist = (*back, *np.zeros(3)) if slides else (*np.cross(point, back), *back)
        placed.append((joint, before @ step @ exp_large(twist).matrix() @ shift, axis))
        before = inner[joint.id] = np.linalg.inv(shift)
    return placed, before @ _within(at[-2], at[-1]), inner


def _bodies(
    model: Model, context: Context, inner: dict[int, np.ndarray]
) -> dict[int, list[tuple[float, np.ndarray]]]:
    """Return the beams as masses (kg) at points (4,) of a link, by the id of the link's row.

    A uniform rod has the same mass, centre and inertia as two halves at 1/sqrt(12) of its length on
    either side of its middle.  Beams along ``x_{i-1}``, and on a slide those before the beam of
    length ``rest``, stay with the row before; the others move with the row's own frame.
    """
    made: dict[int, list[tuple[float, np.ndarray]]] = {}
    posture = model.posture(unstack(model.arm.mid), context)
    at = _frames(model, posture)
    before = 0
    for joint, row in zip(model.arm.joints, posture.chain.rows, strict=True):
        before_rest = joint.type == "prismatic"
        for beam in (b for b in model.arm.links if b.row == joint.id):
            if beam.role == "d" and beam.length_m == "rest":
                before_rest = False
            stays = beam.role == "a" or before_rest
            carrier = before if stays else joint.id
            if carrier == 0 or carrier not in inner:
                continue  # it stands on the ground, or is carried by what is no part of the arm
            pieces = [e for e in (*row.elements_a, *row.elements_d) if e.beam is beam]
            length = sum(float(posture.lengths[e.station]) for e in pieces)
            body = math.copysign(beam.body_length_m or length, length)
            along = body * np.eye(4)[pieces[-1].axis]
            end = posture.frames[pieces[-1].station].matrix()
            link = inner[carrier] @ _within(at[carrier], end)
            for share in (0.5 - 1 / math.sqrt(12.0), 0.5 + 1 / math.sqrt(12.0)):
                point = link @ (np.eye(4)[3] - share * along)
                made.setdefault(carrier, []).append((beam.mass_kg / 2, point))
        before = joint.id if joint.moves else before
    return made


def _frames(model: Model, posture: Posture) -> list[np.ndarray]:
    """Return the frames (4, 4) of base, rows and tip, in this order."""
    frames = [posture.frames[posture.frame(k)] for k in range(len(model.arm.joints) + 1)]
    return [frame.matrix() for frame in (*frames, model.tip_frame(posture))]


def _within(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    made: np.ndarray = np.linalg.inv(outer) @ inner
    return made


def _find_screw(turn: np.ndarray, moved: float, slides: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit axis of a row's motion `turn` and a point on it, both in the row's frame.

    The joint's value changes by `moved`, rad or m.
    """
    if slides:
        return turn[:3, 3] / moved, np.zeros(3)
    axis = quaternion.rotation_vector(quaternion.from_rotation(turn[:3, :3])) / moved
    point = np.linalg.lstsq(np.eye(3) - turn[:3, :3], turn[:3, 3], rcond=1e-6)[0]
    return axis / np.linalg.norm(axis), point


# ------------------------------------------------------------------ XML


def _joint(root: ET.Element, arm: Arm, placed: Placed, parent: str) -> None:
    joint, origin, axis = placed
    kind = "continuous" if joint.endless else joint.type
    node = ET.SubElement(root, "joint", {"name": joint_name(joint), "type": kind})
    _ends(node, origin, parent, link_name(joint))
    if joint.type == "fixed":
        return
    ET.SubElement(node, "axis", {"xyz": _text(axis)})
    weights, offset = arm.mixing[0][joint.id - 1], arm.mixing[1][joint.id - 1]
    if joint.coupling is not None:
        allowed = "a joint that counts with no other: a URDF has no coupling of commanded joints"
        raise InputError("export-urdf", f"joint {joint_name(joint)}", "coupling", allowed)
    if joint.commanded:
        lower, upper = joint.limits
    else:
        leaders = np.flatnonzero(weights)
        if len(leaders) != 1:
            followed, where = (arm.joint_names[k] for k in leaders), f"joint {joint_name(joint)}"
            found = ", ".join(followed) or "none"
            raise InputError("export-urdf", where, found, "a mimic of one joint")
        k = int(leaders[0])
        ends = weights[k] * np.array([arm.lower[k], arm.upper[k]]) + offset
        lower, upper = ends.min(), ends.max()
        follow = {"joint": arm.joint_names[k], "multiplier": repr(float(weights[k]))}
        ET.SubElement(node, "mimic", {**follow, "offset": repr(float(offset))})
    limits = {"lower": repr(float(lower)), "upper": repr(float(upper))}
    ET.SubElement(node, "limit", {**limits, "effort": "0", "velocity": "0"})  # not known


def _ends(node: ET.Element, origin: np.ndarray, parent: str, child: str) -> None:
    rpy = roll_pitch_yaw(origin[:3, :3])
    ET.SubElement(node, "origin", {"xyz": _text(origin[:3, 3]), "rpy": _text(rpy)})
    ET.SubElement(node, "parent", {"link": parent})
    ET.SubElement(node, "child", {"link": child})


def _add_inertial(node: ET.Element, points: Sequence[tuple[float, np.ndarray]]) -> None:
    """Write point masses (kg, (3,) m) as one inertia about their common centre."""
    if not points:
        return
    masses, at = (np.array(values) for values in zip(*points, strict=True))
    total, centre = float(masses.sum()), np.average(at, axis=0, weights=masses)
    off = at - centre
    spread = (masses * off.T) @ off
    tensor = np.trace(spread) * np.eye(3) - spread
    inertial = ET.SubElement(node, "inertial")
    ET.SubElement(inertial, "origin", {"xyz": _text(centre), "rpy": "0 0 0"})
    ET.SubElement(inertial, "mass", {"value": repr(total)})
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    parts = zip(names, tensor[np.triu_indices(3)].tolist(), strict=True)
    ET.SubElement(inertial, "inertia", {name: repr(part) for name, part in parts})


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _write_remark(model: Model) -> str:
    left = sorted({e.name for e in model.effects if not e.geometry})
    zeros = ", ".join(f"{joint} {value:.9g} {unit}" for joint, value, unit in zero_offsets(model))
    origins = "Calibrated" if any(e.geometry for e in model.effects) else "Declared"
    lines = [f"{origins} origins, written by longarm export-urdf. The payload is not in it."]
    lines += [f"Joint zeros, in the origins already: {zeros}"] if zeros else []
    lines += [f"Left out, because a URDF is rigid: {', '.join(left)}"] if left else []
    return "\n  ".join(["", *lines, ""]).replace("--", "- -")
