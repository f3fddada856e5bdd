"""Links and joints of a URDF file, read by ROS's parser (urdf_parser_py) and checked as a tree."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np
from urdf_parser_py import urdf, xml_reflection

from longarm_comp.core.arm.spatial import exp_large, rpy_frame
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import MOST_BYTES

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
_LINK = {"link": {"inertial"}, "inertial": {"origin", "mass"}}
_JOINT = {"joint": {"origin", "axis", "parent", "child", "limit", "mimic"}}


@dataclass(frozen=True)
class _UrdfLink:
    """A link's mass (kg) and centre of mass (3,) in its frame (m)."""

    mass: float
    com: np.ndarray


@dataclass(frozen=True)
class UrdfJoint:
    """A joint: origin (4, 4) in the parent's frame, unit axis (3,) in its own, limits."""

    name: str
    type: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float] | None
    mimic: dict[str, Any] | None

    @property
    def moves(self) -> bool:
        """Whether it has room to move."""
        return self.type in MOVING and (self.limits is None or self.limits[0] < self.limits[1])

    def at(self, value: float) -> np.ndarray:
        """(4, 4) parent to child at a joint value (rad or m)."""
        if self.type not in MOVING:
            return self.origin
        way, still = value * self.axis, (0.0, 0.0, 0.0)
        twist = (*way, *still) if self.type == "prismatic" else (*still, *way)
        made: np.ndarray = self.origin @ exp_large(twist).matrix()
        return made


class UrdfRobot:
    """The tree of a URDF file."""

    def __init__(self, path: str | Path) -> None:
        self.where = str(path)
        root = self._parse(Path(path))
        self.name = root.get("name") or Path(path).stem
        self.links = {link.name: self._link(link) for link in self._read(root, urdf.Link, _LINK)}
        self.joints = {j.name: self._joint(j) for j in self._read(root, urdf.Joint, _JOINT)}
        self.children: dict[str, list[UrdfJoint]] = {}
        self.above: dict[str, UrdfJoint] = {}
        for joint in self.joints.values():
            for end in (joint.parent, joint.child):
                if end not in self.links:
                    raise self.error(f"joint {joint.name}", end, "a link of this file")
            if joint.child in self.above:
                raise self.error(f"link {joint.child}", "two parents", "one joint above a link")
            self.children.setdefault(joint.parent, []).append(joint)
            self.above[joint.child] = joint
        self._check_tree()
        self._check_masses()

    def _check_masses(self) -> None:
        """Refuse a centre of mass that only a mistaken unit puts where it is."""
        extent = sum(float(np.linalg.norm(j.origin[:3, 3])) for j in self.joints.values())
        extent += sum(
            max(map(abs, j.limits)) for j in self.joints.values()
            if j.type == "prismatic" and j.limits is not None
        )  # fmt: skip
        for name, link in self.links.items():
            far = float(np.linalg.norm(link.com))
            # From 30 times the robot's length on millimetres taken for metres (1000) are the nearer
            if link.mass > 0 and extent > 0 and far > 30.0 * extent:
                allowed = f"metres; all joints together are {extent:.3g} m long"
                raise self.error(f"link {name} inertial origin", f"{far:.6g} m", allowed)

    def error(self, field: str, value: object, allowed: str) -> InputError:
        return InputError(self.where, field, value, allowed)

    def path(self, base: str, tip: str) -> list[UrdfJoint]:
        """Joints from base to tip. Raises InputError."""
        for option, link in (("--base", base), ("--tip", tip)):
            if link not in self.links:
                raise self.error(option, link, f"a link: {', '.join(self.links)}")
        way: list[UrdfJoint] = []
        at = tip
        while at != base:
            if at not in self.above:
                raise self.error("--tip", tip, f"a link below {base}")
            way.append(self.above[at])
            at = way[-1].parent
        return way[::-1]

    def below(
        self, link: str, without: UrdfJoint | None, at: np.ndarray
    ) -> Iterator[tuple[str, np.ndarray]]:
        """A link and all that hangs on it beside a joint, with their frames (4, 4).

        Side joints stand at zero, or at the limit nearest to it.
        """
        ahead = [(link, at)]
        while ahead:
            name, frame = ahead.pop()
            yield name, frame
            for joint in reversed(self.children.get(name, [])):
                if joint is not without:
                    ahead.append((joint.child, frame @ joint.at(resting(joint))))

    # ------------------------------------------------------------------ reading

    def _parse(self, path: Path) -> ET.Element:
        try:
            if path.stat().st_size > MOST_BYTES:
                raise self.error("file", f"more than {MOST_BYTES} bytes", "a smaller file")
            root = ET.fromstring(path.read_bytes().lstrip())  # blank lines may stand above the XML
        except OSError as error:
            raise self.error("file", error.strerror or str(error), "a readable file") from error
        except (ET.ParseError, ValueError, LookupError) as error:
            raise self.error("file", str(error), "a URDF (XML)") from error
        if root.tag != "robot":
            raise self.error("root element", root.tag, "robot")
        if path.suffix == ".xacro" or any("xacro" in str(node.tag) for node in root.iter()):
            plain = path.with_suffix("") if path.suffix == ".xacro" else path.with_suffix(".out")
            plain = plain if plain.suffix == ".urdf" else plain.with_suffix(".urdf")
            command = f"ros2 run xacro xacro {path} > {plain.name}"
            raise self.error("file", "xacro", f"a URDF; expand it first: {command}")
        for tag in ("link", "joint"):
            names = [node.get("name") or "" for node in root.findall(tag)]
            if len(set(names)) < len(names) or "" in names:
                raise self.error(tag, "a name is missing or twice", "names that differ")
        return root

    def _read(self, root: ET.Element, kind: Any, parts: Mapping[str, set[str]]) -> list[Any]:
        """What ROS's parser makes of links or joints; nothing but these parts is given to it."""
        made, core = [], xml_reflection.core
        said: list[str] = []
        before, core.on_error = core.on_error, said.append
        try:
            for node in root.findall(kind.__name__.lower()):
                plain = _plain(node, parts)
                try:
                    made.append(kind.from_xml_string(ET.tostring(plain)))
                except Exception as error:  # it raises every kind, also of AssertionError
                    field = f"{node.tag} {node.get('name')}{_part(plain, str(error))}"
                    raise self.error(field, _cause(error), "a value of URDF") from error
        finally:
            core.on_error = before
        return made

    def _check_tree(self) -> None:
        """Every link hangs, over however many joints, on one without a joint above it."""
        try:
            TopologicalSorter({link: [j.parent] for link, j in self.above.items()}).prepare()
        except CycleError as error:
            link = min(error.args[1])
            raise self.error(f"link {link}", "in a cycle of joints", "a tree of links") from error

    def _numbers(self, values: Any, count: int, field: str) -> np.ndarray:
        made = np.array([float(v) for v in values])
        if made.shape != (count,) or not (np.abs(made) <= 1e6).all():
            shown = " ".join(f"{v:g}" for v in made)
            raise self.error(field, shown, f"{count} finite numbers up to 1e6")
        return made

    def _frame(self, origin: Any, field: str) -> np.ndarray:
        if origin is None:
            return np.eye(4)
        xyz = self._numbers(origin.xyz or (0, 0, 0), 3, f"{field} xyz")
        rpy = self._numbers(origin.rpy or (0, 0, 0), 3, f"{field} rpy")
        return rpy_frame(tuple(xyz.tolist()), tuple(rpy.tolist())).matrix()

    def _link(self, link: Any) -> _UrdfLink:
        inertial, field = link.inertial, f"link {link.name}"
        if inertial is None:
            return _UrdfLink(0.0, np.zeros(3))
        mass = float(self._numbers([inertial.mass], 1, f"{field} mass")[0])
        if mass < 0:
            raise self.error(f"{field} mass", mass, "0 kg or more")
        return _UrdfLink(mass, self._frame(inertial.origin, f"{field} inertial")[:3, 3])

    def _joint(self, joint: Any) -> UrdfJoint:
        field, kind = f"joint {joint.name}", joint.type
        axis = self._numbers((1, 0, 0) if joint.axis is None else joint.axis, 3, f"{field} axis")
        length = float(np.linalg.norm(axis))
        if kind in MOVING and length < 1e-9:
            raise self.error(f"{field} axis", axis.tolist(), "a direction")
        limits: tuple[float, float] | None = None
        if kind == "continuous":
            limits = (-math.pi, math.pi)
        elif kind in MOVING and joint.limit is not None:
            ends = self._numbers([joint.limit.lower or 0, joint.limit.upper or 0], 2, field)
            limits = (float(ends[0]), float(ends[1]))
            if limits[0] > limits[1]:
                raise self.error(f"{field} limit", list(limits), "lower <= upper")
        follows: dict[str, Any] | None = None
        if joint.mimic is not None:
            m = joint.mimic
            given = (1 if m.multiplier is None else m.multiplier, m.offset or 0)
            multiplier, offset = self._numbers(given, 2, f"{field} mimic").tolist()
            follows = {"joint": m.joint, "multiplier": multiplier, "offset": offset}
        origin = self._frame(joint.origin, field)
        return UrdfJoint(
            joint.name, kind, joint.parent, joint.child, origin, axis / (length or 1.0), limits,
            follows,
        )  # fmt: skip


def resting(joint: UrdfJoint) -> float:
    """Zero, or the limit nearest to it."""
    return 0.0 if joint.limits is None else min(max(0.0, joint.limits[0]), joint.limits[1])


def turn_z_to(axis: np.ndarray) -> np.ndarray:
    """(4, 4) the smallest rotation that takes z to the axis."""
    made = np.eye(4)
    x, y, z = axis
    if z < -1 + 1e-12:
        made[:3, :3] = np.diag([1.0, -1.0, -1.0])
    elif z < 1 - 1e-15:
        skew = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
        made[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + z)
    return made


def _plain(node: ET.Element, parts: Mapping[str, set[str]]) -> ET.Element:
    """An element with only these parts, one of each, by the tag of the element they are in."""
    made = ET.Element(node.tag, dict(node.attrib))
    for part in node:
        if part.tag in parts.get(str(node.tag), ()) and made.find(str(part.tag)) is None:
            held = _plain(part, parts)
            if part.tag == "limit":  # of no use here, and often left out
                held.attrib = {"effort": "0", "velocity": "0", **held.attrib}
            made.append(held)
    inertial = made.find("inertial")
    if inertial is not None and inertial.find("mass") is None:
        made.remove(inertial)
    return made


def _part(node: ET.Element, said: str) -> str:
    """Which part of an element an error of the parser is about, where that can be told."""
    quoted = re.search(r"'(.*)'", said)
    for part in node.iter():
        for key, value in part.attrib.items():
            short = "vector length" in said and key in ("xyz", "rpy") and len(value.split()) != 3
            if short or (quoted and quoted.group(1) in (value, *value.split())):
                return "" if part is node else f" {part.tag}"
    return ""


def _cause(error: Exception) -> str:
    """The value that could not be read, or what the parser says."""
    said = str(error) or type(error).__name__
    quoted = re.search(r"could not convert string to float: '(.*)'", said)
    return quoted.group(1) if quoted else said
