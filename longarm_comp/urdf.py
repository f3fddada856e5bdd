"""An arm declared from a URDF: limits, masses, centres of mass, mimic joints.

The joints between a base link and a tip link become rows: a fixed row for what lies before an
axis, then a row that turns about or slides along its own z.  A URDF knows no beams; add `links`
to the arm.yaml where the arm bends.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import rpy_frame
from longarm_comp.core.data.alignment import roll_pitch_yaw
from longarm_comp.core.errors import InputError

_MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


@dataclass(frozen=True)
class _Link:
    mass: float
    com: np.ndarray  # (3,) m, link frame


@dataclass(frozen=True)
class _Joint:
    name: str
    type: str
    parent: str
    child: str
    origin: np.ndarray  # (4, 4) in the parent's frame
    axis: np.ndarray  # (3,) unit vector in the joint's frame
    limits: tuple[float, float] | None  # rad or m
    mimic: dict[str, Any] | None

    @property
    def moves(self) -> bool:
        return self.type in _MOVING and (self.limits is None or self.limits[0] < self.limits[1])

    def resting(self) -> np.ndarray:
        """(4, 4) parent to child with the joint at zero, or at its nearest limit."""
        value = 0.0 if self.limits is None else min(max(0.0, self.limits[0]), self.limits[1])
        if value == 0.0 or self.type == "fixed":
            return self.origin
        align = _turn_z_to(self.axis)
        move = np.eye(4)
        if _MOVING[self.type] == "revolute":
            c, s = math.cos(value), math.sin(value)
            move[:2, :2] = [[c, -s], [s, c]]
        else:
            move[2, 3] = value
        made: np.ndarray = self.origin @ align @ move @ align.T
        return made


class _Robot:
    """Links and joints of a URDF file."""

    def __init__(self, path: Path) -> None:
        self.where = str(path)
        root = self._parse(path)
        self.name = root.get("name") or path.stem
        self.links = {name: self._link(name, node) for name, node in self._named(root, "link")}
        self.joints = [self._joint(name, node) for name, node in self._named(root, "joint")]
        self.children: dict[str, list[_Joint]] = {}
        self.above: dict[str, _Joint] = {}
        for joint in self.joints:
            for end in (joint.parent, joint.child):
                if end not in self.links:
                    raise self.error(f"joint {joint.name}", end, "a link of this file")
            if joint.child in self.above:
                raise self.error(f"link {joint.child}", "two parents", "one joint above a link")
            self.children.setdefault(joint.parent, []).append(joint)
            self.above[joint.child] = joint

    def error(self, field: str, value: object, allowed: str) -> InputError:
        return InputError(self.where, field, value, allowed)

    def path(self, base: str, tip: str) -> list[_Joint]:
        """Joints from base to tip."""
        for option, link in (("--base", base), ("--tip", tip)):
            if link not in self.links:
                raise self.error(option, link, f"a link: {', '.join(self.links)}")
        way: list[_Joint] = []
        at = tip
        while at != base:
            if at not in self.above or len(way) > len(self.joints):
                raise self.error("--tip", tip, f"a link below {base}")
            way.append(self.above[at])
            at = way[-1].parent
        return way[::-1]

    def _parse(self, path: Path) -> ET.Element:
        try:
            root = ET.parse(path).getroot()
        except OSError as error:
            raise self.error("file", error.strerror or str(error), "a readable file") from error
        except ET.ParseError as error:
            raise self.error("file", str(error), "a URDF (XML)") from error
        if root.tag != "robot":
            raise self.error("root element", root.tag, "robot")
        if any("xacro" in node.tag for node in root.iter()):
            raise self.error("file", "xacro", "a URDF: expand it with the program xacro first")
        return root

    def _named(self, root: ET.Element, tag: str) -> list[tuple[str, ET.Element]]:
        found = [(node.get("name") or "", node) for node in root.findall(tag)]
        names = [name for name, _ in found]
        if len(set(names)) < len(names) or "" in names:
            raise self.error(tag, "a name is missing or twice", "names that differ")
        return found

    def _numbers(self, text: str | None, count: int, field: str, default: str) -> np.ndarray:
        try:
            made = np.array([float(v) for v in (text or default).split()])
        except ValueError:
            made = np.empty(0)
        if made.shape != (count,) or not np.isfinite(made).all():
            raise self.error(field, text, f"{count} finite numbers")
        return made

    def _origin(self, node: ET.Element | None, field: str) -> np.ndarray:
        if node is None:
            return np.eye(4)
        xyz = self._numbers(node.get("xyz"), 3, f"{field} xyz", "0 0 0")
        rpy = self._numbers(node.get("rpy"), 3, f"{field} rpy", "0 0 0")
        return rpy_frame(tuple(xyz.tolist()), tuple(rpy.tolist())).matrix()

    def _link(self, name: str, node: ET.Element) -> _Link:
        inertial = node.find("inertial")
        if inertial is None or inertial.find("mass") is None:
            return _Link(0.0, np.zeros(3))
        text = inertial.find("mass").get("value")  # type: ignore[union-attr]
        mass = float(self._numbers(text, 1, f"link {name} mass", "0")[0])
        if mass < 0:
            raise self.error(f"link {name} mass", mass, "0 kg or more")
        return _Link(mass, self._origin(inertial.find("origin"), f"link {name} inertial")[:3, 3])

    def _joint(self, name: str, node: ET.Element) -> _Joint:
        field = f"joint {name}"
        kind = node.get("type") or ""
        ends = [
            getattr(node.find(end), "attrib", {}).get("link", "") for end in ("parent", "child")
        ]
        axis_node, limit, mimic = node.find("axis"), node.find("limit"), node.find("mimic")
        text = None if axis_node is None else axis_node.get("xyz")
        axis = self._numbers(text, 3, f"{field} axis", "1 0 0")
        length = np.linalg.norm(axis)
        if kind in _MOVING and length < 1e-9:
            raise self.error(f"{field} axis", text, "a direction")
        limits: tuple[float, float] | None = None
        if kind == "continuous":
            limits = (-math.pi, math.pi)
        elif kind in _MOVING and limit is not None:
            ends_ = [
                self._numbers(limit.get(k), 1, f"{field} {k}", "0") for k in ("lower", "upper")
            ]
            limits = (float(ends_[0][0]), float(ends_[1][0]))
            if limits[0] > limits[1]:
                raise self.error(f"{field} limit", list(limits), "lower <= upper")
        follows: dict[str, Any] | None = None
        if mimic is not None:
            follows = {"joint": mimic.get("joint") or ""}
            for key, default in (("multiplier", "1"), ("offset", "0")):
                follows[key] = float(self._numbers(mimic.get(key), 1, f"{field} {key}", default)[0])
        origin = self._origin(node.find("origin"), field)
        return _Joint(name, kind, ends[0], ends[1], origin, axis / (length or 1.0), limits, follows)


def import_urdf(path: str | Path, base: str, tip: str) -> dict[str, Any]:
    """What arm.yaml holds for the chain from link `base` to link `tip`.

    Continuous joints get +-180 deg; a joint whose limits coincide is fixed there.  Every link's
    mass is lumped at its centre of mass; what hangs beside the chain (a gripper, another arm) is
    carried with its own joints at zero.

    Raises:
        InputError: no URDF, no such link, a joint type or value that an arm cannot have.
    """
    robot = _Robot(Path(path))
    way = robot.path(base, tip)
    moving = [joint for joint in way if joint.moves]
    rows: list[dict[str, Any]] = []
    masses: list[dict[str, Any]] = []
    at, frame = np.eye(4), 0  # the present link, in the frame of row `frame`
    for joint, following in zip(way, [*way[1:], None], strict=True):
        if joint.type not in (*_MOVING, "fixed"):
            raise robot.error(
                f"joint {joint.name}", joint.type, "revolute, continuous, prismatic or fixed"
            )
        if joint.moves:
            align = _turn_z_to(joint.axis)
            before = at @ joint.origin @ align
            if not np.allclose(before, np.eye(4), atol=1e-15):
                fixed = {"id": len(rows) + 1, "name": f"to_{joint.name}", "type": "fixed"}
                rows.append({**fixed, "pose": _pose(before)})
            rows.append(_row(robot, joint, len(rows) + 1, [j.name for j in moving]))
            frame, at = len(rows), align.T
        else:
            at = at @ joint.resting()
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


def _row(robot: _Robot, joint: _Joint, number: int, commanded: list[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"id": number, "name": joint.name, "type": _MOVING[joint.type]}
    if joint.mimic is not None:
        if joint.mimic["joint"] not in commanded:
            allowed = f"a joint of the chain: {', '.join(commanded)}"
            raise robot.error(f"joint {joint.name} mimic", joint.mimic["joint"], allowed)
        return {**row, "mimic": joint.mimic}
    if joint.limits is None:
        raise robot.error(f"joint {joint.name} limit", "missing", "lower and upper")
    if row["type"] == "revolute":
        return {**row, "limits_deg": [_tidy(math.degrees(v)) for v in joint.limits]}
    return {**row, "limits_m": list(joint.limits)}


def _carried(
    robot: _Robot, link: str, following: _Joint | None, at: np.ndarray, frame: int
) -> list[dict[str, Any]]:
    """Point masses of a link and of all that hangs on it beside the chain."""
    made = []
    held = robot.links[link]
    if held.mass > 0:
        position = (at @ np.append(held.com, 1.0))[:3]
        made.append(
            {
                "name": link,
                "frame": frame,
                "position_m": [_tidy(v) for v in position],
                "mass_kg": held.mass,
            }
        )
    for joint in robot.children.get(link, []):
        if joint is not following:
            made += _carried(robot, joint.child, None, at @ joint.resting(), frame)
    return made


def _pose(matrix: np.ndarray) -> dict[str, list[float]]:
    return {
        "xyz_m": [_tidy(v) for v in matrix[:3, 3]],
        "rpy_deg": [_tidy(math.degrees(v)) for v in roll_pitch_yaw(matrix[:3, :3])],
    }


def _tidy(value: float) -> float:
    """Without the last digits' noise; never -0."""
    return round(float(value), 12) + 0.0


def _turn_z_to(axis: np.ndarray) -> np.ndarray:
    """(4, 4) the smallest rotation that takes z to the axis."""
    made = np.eye(4)
    x, y, z = axis
    if z < -1 + 1e-12:
        made[:3, :3] = np.diag([1.0, -1.0, -1.0])
    elif z < 1 - 1e-15:
        skew = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
        made[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + z)
    return made
