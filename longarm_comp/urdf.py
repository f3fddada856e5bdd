"""An arm declared from a URDF: limits, masses, centres of mass, mimic joints.

A moving joint between the base link and the tip link becomes a row that holds the whole distance
from the joint before it as its a and d, along which beams can be declared; a fixed row precedes it
if a rotation is needed.  A joint beside the chain that a joint of the chain mimics becomes a
commanded row that does not move the chain itself.  A URDF has no beams.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.urdf_file import MOVING, UrdfJoint, UrdfRobot, resting, turn_z_to

_NO_LENGTH = 1e-10
"""A length (m) below this is the rounding of a file's digits."""


def import_urdf(path: str | Path, base: str, tip: str) -> dict[str, Any]:
    """Return the contents of arm.yaml for the chain from link `base` to `tip` of a URDF file."""
    return read_chain(UrdfRobot(path), base, tip)


def read_chain(robot: UrdfRobot, base: str, tip: str) -> dict[str, Any]:
    """Return the contents of arm.yaml for the chain from link `base` to link `tip`.

    Continuous joints are endless, unless a joint that mimics one stands elsewhere after a whole
    turn.  Limits are the tighter ones of hard and soft limits.  Every link's mass is lumped at its
    centre of mass.  Links beside the chain (a gripper, another arm) are carried with their joints
    at zero, or at the limit nearest to it.  Raises InputError.
    """
    way = robot.path(base, tip)
    moving = {joint.name: joint for joint in way if joint.moves}
    if not moving:
        raise robot.error("--tip", tip, f"a link that moves against {base}")
    mimics = {name: robot.leader(joint) for name, joint in moving.items()}
    leaders = {mimic["joint"]: robot.joints[mimic["joint"]] for mimic in mimics.values() if mimic}
    beside = {name: joint for name, joint in leaders.items() if name not in moving}
    robot.check_ranges(j for name, j in (beside | moving).items() if not mimics.get(name))
    geared = {  # joints whose followers stand elsewhere after a whole turn of theirs
        m["joint"]
        for name, m in mimics.items()
        if m and (MOVING[moving[name].type] != "revolute" or m["multiplier"] % 1 != 0)
    }
    rows = [
        _row(joint, number, None, name in geared) | {"moves": False}
        for number, (name, joint) in enumerate(beside.items(), 1)
    ]
    masses: list[dict[str, Any]] = []
    at, frame = np.eye(4), 0  # the link at hand, in the frame of row `frame`
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
            row = _row(joint, len(rows) + 1, mimics[joint.name], joint.name in geared)
            rows.append({**row, **lengths})
            frame, at = len(rows), align.T
        else:
            at = at @ joint.at(resting(joint))
        for name, place in robot.below(joint.child, following, at) if frame else ():
            mass, centre = robot.links[name]
            if mass > 0:
                position = [_tidy(v) for v in (place @ np.append(centre, 1.0))[:3]]
                held = {"name": name, "frame": frame, "position_m": position, "mass_kg": mass}
                masses.append(held)
    pose = _pose(at)
    return {
        "name": robot.name,
        "convention": "mdh_craig",
        "tip": {"frame": frame, "position_m": pose["xyz_m"], "rpy_deg": pose["rpy_deg"]},
        "joints": rows,
        "point_masses": masses,
    }


def read_drives(path: str | Path, data: Mapping[str, Any]) -> dict[int, UrdfJoint]:
    """Return the URDF joint of each commanded row, by row id; `data` as `import_urdf` made it."""
    joints = UrdfRobot(path).joints
    commanded = [row for row in data["joints"] if row["type"] != "fixed" and "mimic" not in row]
    return {row["id"]: joints[row["name"]] for row in commanded}


def describe_drive(joint: UrdfJoint) -> str:
    """Say whether a joint has soft limits, and its highest speed; empty if neither is given."""
    turns, said = MOVING[joint.type] == "revolute", []
    scale, unit = (math.degrees(1.0), "deg") if turns else (1e3, "mm")
    if joint.hard is not None and joint.hard != joint.limits:
        low, high = (scale * limit for limit in joint.hard)
        said.append(f"soft limits; the hard ones are {low:.6g} to {high:.6g} {unit}")
    if math.isfinite(joint.velocity):
        said.append(f"at most {scale * joint.velocity:.6g} {unit}/s")
    return ", ".join(said)


def chain_ends(path: str | Path, base: str, tip: str) -> tuple[str, str]:
    """Return base and tip link of a chain; a blank one is found if there is only one choice.

    For a blank base it is the only root link that carries links, for a blank tip the only end above
    the base.  Raises InputError if there are several.
    """
    robot = UrdfRobot(path)
    if not robot.links:
        raise robot.error("link", "none", "links and joints")
    if not base:
        roots = [link for link in robot.links if link not in robot.above]
        base = _only(robot, "--base", [link for link in roots if link in robot.children] or roots)
    if not tip and base in robot.links:
        above = [link for link, _ in robot.below(base, None, np.eye(4))]
        tip = _only(robot, "--tip", [link for link in above if link not in robot.children])
    return base, tip


def _only(robot: UrdfRobot, option: str, links: list[str]) -> str:
    if len(links) > 1:
        raise robot.error(option, "missing", f"one of {', '.join(links)}")
    return links[0]


def _along_own_axes(before: np.ndarray) -> tuple[np.ndarray | None, dict[str, float]]:
    """Split the pose of a joint in the frame before it into a rotation, and keys of its DH row.

    The rotation (4, 4) is that of a fixed row before the joint; None if the row's alpha is enough.
    """
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
    keys = {
        "a_m": a if abs(a) > _NO_LENGTH else 0.0,
        "d_m": d,
        "theta_offset_deg": math.degrees(math.atan2(rest[1, 0], rest[0, 0])),
    }
    if np.allclose(x, [1.0, 0.0, 0.0], rtol=0, atol=1e-15):
        keys["alpha_deg"] = math.degrees(math.atan2(-turn[1, 2], turn[2, 2]))
    kept = {key: _tidy(value) for key, value in keys.items() if _tidy(value)}
    return None if "alpha_deg" in keys else turn, kept


def _row(
    joint: UrdfJoint, number: int, mimic: dict[str, Any] | None, geared: bool
) -> dict[str, Any]:
    """Return the row of `joints` in arm.yaml for a joint, without its lengths.

    It is not endless if it is `geared`: a joint that follows it stands elsewhere after a turn.
    """
    row: dict[str, Any] = {"id": number, "name": joint.name, "type": MOVING[joint.type]}
    if mimic is not None:
        return {**row, "mimic": mimic}
    assert joint.limits is not None  # UrdfRobot.check_ranges
    if joint.type == "continuous" and not geared:
        row["endless"] = True
    if row["type"] == "revolute":
        return {**row, "limits_deg": [round(math.degrees(v), 9) + 0.0 for v in joint.limits]}
    return {**row, "limits_m": list(joint.limits)}


def _pose(matrix: np.ndarray) -> dict[str, list[float]]:
    return {
        "xyz_m": [_tidy(v) for v in matrix[:3, 3]],
        "rpy_deg": [_tidy(math.degrees(v)) for v in roll_pitch_yaw(matrix[:3, :3])],
    }


def _tidy(value: float) -> float:
    """Return a value rounded to 12 decimals; never -0."""
    return round(float(value), 12) + 0.0
