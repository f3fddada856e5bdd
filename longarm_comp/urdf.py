"""An arm declared from a URDF: limits, masses, centres of mass, mimic joints.

A joint between the base link and the tip link becomes a row with all lengths along its own a and d,
where beams can be, after a fixed row that turns where one is needed.  A joint beside the chain that
joints of it mimic becomes a row that does not move.  A URDF knows no beams.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.urdf_file import MOVING, UrdfJoint, UrdfRobot, resting, turn_z_to

_NO_LENGTH = 1e-10
"""m; less than this is the rounding of a file's digits."""


def import_urdf(path: str | Path, base: str, tip: str) -> dict[str, Any]:
    """What arm.yaml holds for the chain from link `base` to link `tip`.

    Continuous joints are endless; a joint whose limits coincide is fixed there.  Every link's mass
    is lumped at its centre of mass; what hangs beside the chain (a gripper, another arm) is
    carried with its own joints at zero.
    """
    robot = UrdfRobot(path)
    way = robot.path(base, tip)
    moving = [joint for joint in way if joint.moves]
    rows = [
        _row(robot, joint, number) | {"moves": False}
        for number, joint in enumerate(_beside(robot, moving), 1)
    ]
    masses: list[dict[str, Any]] = []
    at, frame = np.eye(4), 0  # the present link, in the frame of row `frame`
    for joint, following in zip(way, [*way[1:], None], strict=True):
        if joint.type not in (*MOVING, "fixed"):
            allowed = "revolute, continuous, prismatic or fixed"
            raise robot.error(f"joint {joint.name}", joint.type, allowed)
        if joint.moves:
            align = turn_z_to(joint.axis)
            turn, lengths = _along_own_axes(at @ joint.origin @ align)
            if turn is not None:
                fixed = {"id": len(rows) + 1, "name": f"to_{joint.name}", "type": "fixed"}
                rows.append({**fixed, "pose": _pose(turn)})
            rows.append({**_row(robot, joint, len(rows) + 1), **lengths})
            frame, at = len(rows), align.T
        else:
            at = at @ joint.at(resting(joint))
        if frame:
            masses += _carried(robot, joint.child, following, at, frame)
    if not frame:
        raise robot.error("--tip", tip, f"a link that moves against {base}")
    pose = _pose(at)
    return {
        "name": robot.name,
        "convention": "mdh_craig",
        "tip": {"frame": frame, "position_m": pose["xyz_m"], "rpy_deg": pose["rpy_deg"]},
        "joints": rows,
        "point_masses": masses,
    }


def chain_ends(path: str | Path, base: str, tip: str) -> tuple[str, str]:
    """Base and tip link of a chain; the root and the only link at an end where one is blank."""
    robot = UrdfRobot(path)
    if not base:
        base = next(link for link in robot.links if link not in robot.above)
    if not tip:
        ends = [link for link in robot.links if not robot.children.get(link)]
        if len(ends) != 1:
            raise robot.error("--tip", "missing", f"one of {', '.join(ends)}")
        tip = ends[0]
    return base, tip


def _beside(robot: UrdfRobot, moving: list[UrdfJoint]) -> list[UrdfJoint]:
    """Joints off the chain that joints of it mimic."""
    made: dict[str, UrdfJoint] = {}
    for joint in moving:
        if joint.mimic is None:
            continue
        name = joint.mimic["joint"]
        leader = robot.joints.get(name)
        if leader is None or not leader.moves or leader.mimic is not None:
            free = [j.name for j in robot.joints.values() if j.moves and j.mimic is None]
            raise robot.error(f"joint {joint.name} mimic", name, f"a joint: {', '.join(free)}")
        if name not in (other.name for other in moving):
            made[name] = leader
    return list(made.values())


def _along_own_axes(before: np.ndarray) -> tuple[np.ndarray | None, dict[str, float]]:
    """What lies before an axis, (4, 4) from the frame before to the joint's at rest: a turn (4, 4),
    None where the row's alpha is all of it, and the DH row's keys that are not 0."""
    z, way = before[:3, 2], before[:3, 3]
    d = float(way @ z)
    across = way - d * z
    a = float(np.linalg.norm(across))
    x = across / a if a > _NO_LENGTH else before[:3, 0]
    if a > _NO_LENGTH and x[0] < 0:
        x, a = -x, -a
    turn = np.eye(4)
    turn[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    rest = turn[:3, :3].T @ before[:3, :3]
    keys = {"a_m": a if abs(a) > _NO_LENGTH else 0.0, "d_m": d,
            "theta_offset_deg": math.degrees(math.atan2(rest[1, 0], rest[0, 0]))}  # fmt: skip
    if np.allclose(x, [1.0, 0.0, 0.0], rtol=0, atol=1e-15):
        keys["alpha_deg"] = math.degrees(math.atan2(-turn[1, 2], turn[2, 2]))
    kept = {key: _tidy(value) for key, value in keys.items() if _tidy(value)}
    return None if "alpha_deg" in keys else turn, kept


def _row(robot: UrdfRobot, joint: UrdfJoint, number: int) -> dict[str, Any]:
    row: dict[str, Any] = {"id": number, "name": joint.name, "type": MOVING[joint.type]}
    if joint.mimic is not None:
        return {**row, "mimic": joint.mimic}
    if joint.limits is None:
        raise robot.error(f"joint {joint.name} limit", "missing", "lower and upper")
    geared = any(_geared(other, joint.name) for other in robot.joints.values())
    if joint.type == "continuous" and not geared:
        row["endless"] = True
    if row["type"] == "revolute":
        return {**row, "limits_deg": [round(math.degrees(v), 9) + 0.0 for v in joint.limits]}
    return {**row, "limits_m": list(joint.limits)}


def _geared(joint: UrdfJoint, leader: str) -> bool:
    """Whether it mimics a leader so that it stands elsewhere after a whole turn of that."""
    if joint.mimic is None or joint.mimic["joint"] != leader or not joint.moves:
        return False
    return MOVING[joint.type] != "revolute" or joint.mimic["multiplier"] % 1 != 0


def _carried(
    robot: UrdfRobot, link: str, following: UrdfJoint | None, at: np.ndarray, frame: int
) -> list[dict[str, Any]]:
    """Point masses of a link and of all that hangs on it beside the chain."""
    made = []
    for name, place in robot.below(link, following, at):
        mass, centre = robot.links[name]
        if mass > 0:
            position = [_tidy(v) for v in (place @ np.append(centre, 1.0))[:3]]
            held = {"name": name, "frame": frame, "position_m": position, "mass_kg": mass}
            made.append(held)
    return made


def _pose(matrix: np.ndarray) -> dict[str, list[float]]:
    return {
        "xyz_m": [_tidy(v) for v in matrix[:3, 3]],
        "rpy_deg": [_tidy(math.degrees(v)) for v in roll_pitch_yaw(matrix[:3, :3])],
    }


def _tidy(value: float) -> float:
    """Without the last digits' noise; never -0."""
    return round(float(value), 12) + 0.0
