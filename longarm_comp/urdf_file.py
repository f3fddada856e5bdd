"""Links and joints of a URDF file, checked as a tree."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import exp_large, rpy_frame
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import MOST_BYTES

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
_TYPES = (*MOVING, "fixed", "floating", "planar")
_TURN = 2 * math.pi
_LIMITS = {
    "revolute": (
        2 * _TURN,
        f"rad, two turns ({2 * _TURN:.3g}) to either side at most, not degrees; type continuous "
        "where it turns on and on",
    ),
    "prismatic": (100.0, "m, 100 to either side at most, not millimetres"),
}
"""By type of joint: the largest limit that can be in the right unit, and the text of an error."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint of a URDF file.

    `limits` (rad, m) are None if the file gives none, and may coincide. They are the tighter ones
    of its hard limits (`hard`) and of the soft ones of its safety controller.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: np.ndarray  # (4, 4) in the parent's frame
    axis: np.ndarray  # (3,) unit vector in its own frame
    limits: tuple[float, float] | None
    mimic: dict[str, Any] | None
    hard: tuple[float, float] | None = None
    velocity: float = math.inf  # highest, rad/s or m/s, if the file gives one that is not 0

    @property
    def moves(self) -> bool:
        """True if its type moves, whatever its limits say."""
        return self.type in MOVING

    def at(self, value: float) -> np.ndarray:
        """Return the pose (4, 4) of the child in the parent at a joint value (rad or m)."""
        if not self.moves:
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
        self.links = {node.get("name", ""): self._link(node) for node in root.findall("link")}
        """Mass (kg) and centre of mass (3,), m, in the link's frame, by name."""
        self.joints = {node.get("name", ""): self._joint(node) for node in root.findall("joint")}
        self.children: dict[str, list[UrdfJoint]] = {}  # below each link
        self.above: dict[str, UrdfJoint] = {}  # above each link
        for joint in self.joints.values():
            for end in (joint.parent, joint.child):
                if end not in self.links:
                    raise self.error(f"joint {joint.name}", end, "a link of this file")
            if joint.child in self.above:
                raise self.error(f"link {joint.child}", "two parents", "one joint above a link")
            self.children.setdefault(joint.parent, []).append(joint)
            self.above[joint.child] = joint
        try:
            TopologicalSorter({link: [j.parent] for link, j in self.above.items()}).prepare()
        except CycleError as error:
            link = min(error.args[1])
            raise self.error(f"link {link}", "in a cycle of joints", "a tree of links") from error
        self._check_masses()

    def _check_masses(self) -> None:
        """Refuse a centre of mass that is so far off that its unit must be wrong."""
        extent = sum(float(np.linalg.norm(j.origin[:3, 3])) for j in self.joints.values())
        slides = [j.limits for j in self.joints.values() if j.type == "prismatic" and j.limits]
        extent += sum(max(map(abs, limits)) for limits in slides)
        for name, (mass, centre) in self.links.items():
            far = float(np.linalg.norm(centre))
            # From 30 times the robot's length on millimetres taken for metres (1000) are the nearer
            if mass > 0 and extent > 0 and far > 30.0 * extent:
                allowed = f"metres; all joints together are {extent:.3g} m long"
                raise self.error(f"link {name} inertial origin", f"{far:.6g} m", allowed)

    def error(self, field: str, value: object, allowed: str) -> InputError:
        return InputError(self.where, field, value, allowed)

    def path(self, base: str, tip: str) -> list[UrdfJoint]:
        """Return the joints from link `base` to link `tip`. Raises InputError."""
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

    def leader(self, joint: UrdfJoint) -> dict[str, Any] | None:
        """Return a joint's `mimic` of the commanded joint at the end of its mimics, or None.

        Raises InputError if its mimics lead to no commanded joint.
        """
        if joint.mimic is None:
            return None
        at, met, multiplier, offset = joint, [joint.name], 1.0, 0.0
        while at.mimic is not None:
            offset += multiplier * at.mimic["offset"]
            multiplier *= at.mimic["multiplier"]
            name = at.mimic["joint"]
            if name in met or name not in self.joints or not self.joints[name].moves:
                free = [j.name for j in self.joints.values() if j.moves and j.mimic is None]
                raise self.error(f"joint {at.name} mimic", name, f"a joint: {', '.join(free)}")
            met.append(name)
            at = self.joints[name]
        return {"joint": at.name, "multiplier": multiplier, "offset": offset}

    def check_ranges(self, joints: Iterable[UrdfJoint]) -> None:
        """Raise InputError for commanded joints whose limits leave no room or have a wrong unit."""
        faults: dict[str, list[tuple[str, str]]] = {}
        for joint in joints:
            given = "missing" if joint.limits is None else "{:g} to {:g}".format(*joint.limits)
            most, allowed = _LIMITS[MOVING[joint.type]]
            if joint.limits is None or not joint.limits[0] < joint.limits[1]:
                allowed = "lower < upper, or type fixed where it stands still"
            elif max(map(abs, joint.limits)) <= most:
                continue
            faults.setdefault(allowed, []).append((joint.name, given))
        for allowed, ((name, given), *others) in faults.items():
            also = ", ".join(other for other, _ in others)
            allowed += f"; so too joint {also}" if also else ""
            raise self.error(f"joint {name} limit", given, allowed)

    def below(
        self, link: str, without: UrdfJoint | None, at: np.ndarray
    ) -> Iterator[tuple[str, np.ndarray]]:
        """Yield a link and all links below it, with their frames (4, 4).

        Side joints are at zero, or at the limit nearest to it.

        Args:
            without: a joint of the link; it and everything below it are left out.
            at: (4, 4) frame of the link.
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

    def _numbers(
        self,
        node: ET.Element,
        part: str,
        key: str,
        usual: str,
        needed: bool = False,
        most: float = 1e6,
    ) -> np.ndarray:
        """Return the numbers of an attribute of a part of a link or a joint, `most` at the most.

        There must be as many as in `usual`: the text if the part is missing, or if its attribute is
        and is not `needed`.
        """
        found = node.find(part)
        text = usual if found is None else found.get(key, "" if needed else usual)
        try:
            made = np.array([float(v) for v in text.split()])
        except ValueError:
            made = np.empty(0)
        count = len(usual.split())
        if len(made) != count or not (np.abs(made) <= most).all():
            field = f"{node.tag} {node.get('name')} {part.rpartition('/')[2]}"
            bound = "finite numbers up to 1e6" if most < math.inf else "numbers"
            raise self.error(field, text, f"{key}, {count} {bound}")
        return made

    def _frame(self, node: ET.Element, part: str) -> np.ndarray:
        xyz, rpy = (self._numbers(node, part, key, "0 0 0") for key in ("xyz", "rpy"))
        return rpy_frame(tuple(xyz.tolist()), tuple(rpy.tolist())).matrix()

    def _link(self, node: ET.Element) -> tuple[float, np.ndarray]:
        (mass,) = self._numbers(node, "inertial/mass", "value", "0", needed=True).tolist()
        if mass < 0:
            raise self.error(f"link {node.get('name')} mass", mass, "0 kg or more")
        return mass, self._frame(node, "inertial/origin")[:3, 3]

    def _joint(self, node: ET.Element) -> UrdfJoint:
        name, kind = node.get("name", ""), node.get("type", "")
        if kind not in _TYPES:
            raise self.error(f"joint {name} type", kind, ", ".join(_TYPES))
        axis = self._numbers(node, "axis", "xyz", "1 0 0", needed=True)
        length = float(np.linalg.norm(axis))
        if kind in MOVING and length < 1e-9:
            raise self.error(f"joint {name} axis", axis.tolist(), "a direction")
        limits: tuple[float, float] | None = None
        ends = node.find("limit")
        if kind == "continuous":
            limits = (-math.pi, math.pi)
        elif kind in MOVING and ends is not None and {"lower", "upper"} & set(ends.keys()):
            lower, upper = (
                float(self._numbers(node, "limit", key, "0", most=math.inf)[0])
                for key in ("lower", "upper")
            )
            if lower > upper:
                raise self.error(f"joint {name} limit", [lower, upper], "lower <= upper")
            limits = lower, upper
        hard, limits = limits, self._soften_limits(node, limits) if kind != "continuous" else limits
        (velocity,) = self._numbers(node, "limit", "velocity", "0", most=math.inf).tolist()
        if velocity < 0:
            allowed = "velocity, 0 (not told) or more"
            raise self.error(f"joint {name} limit", velocity, allowed)
        follows: dict[str, Any] | None = None
        mimic = node.find("mimic")
        if mimic is not None:
            follows = {"joint": mimic.get("joint", "")}
            for key, usual in (("multiplier", "1"), ("offset", "0")):
                follows[key] = float(self._numbers(node, "mimic", key, usual)[0])
        parent, child = (
            "" if end is None else end.get("link", "")
            for end in (node.find("parent"), node.find("child"))
        )
        origin = self._frame(node, "origin")
        turns = self._numbers(node, "origin", "rpy", "0 0 0")
        if np.abs(turns).max() > 1.01 * _TURN:
            allowed = f"rpy in rad, a turn ({_TURN:.3g}) at most, not degrees"
            raise self.error(f"joint {name} origin", turns.tolist(), allowed)
        axis = axis / (length or 1.0)
        top = velocity or math.inf
        return UrdfJoint(name, kind, parent, child, origin, axis, limits, follows, hard, top)

    def _soften_limits(
        self, node: ET.Element, limits: tuple[float, float] | None
    ) -> tuple[float, float] | None:
        """Return the part of hard limits that lies within the soft ones, where they are given.

        A safety controller whose two soft limits are 0, their default, sets no limits.
        """
        controller = node.find("safety_controller")
        if controller is None or limits is None:
            return limits
        keys = ("soft_lower_limit", "soft_upper_limit")
        lower, upper = (
            float(self._numbers(node, "safety_controller", key, "0", most=math.inf)[0])
            if controller.get(key) is not None
            else hard
            for key, hard in zip(keys, limits, strict=True)
        )
        if lower == upper == 0.0:
            return limits
        made = max(limits[0], lower), min(limits[1], upper)
        if made[0] > made[1]:
            allowed = f"soft limits that leave a range of {limits[0]:g} to {limits[1]:g}"
            raise self.error(f"joint {node.get('name')} safety_controller", [lower, upper], allowed)
        return made


def resting(joint: UrdfJoint) -> float:
    """Return the joint value 0, or the limit nearest to it."""
    return 0.0 if joint.limits is None else min(max(0.0, joint.limits[0]), joint.limits[1])


def turn_z_to(axis: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (4, 4) that takes z to a unit vector (3,)."""
    made = np.eye(4)
    x, y, z = axis
    if z < -1 + 1e-12:
        made[:3, :3] = np.diag([1.0, -1.0, -1.0])
    elif z < 1 - 1e-15:
        skew = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
        made[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + z)
    return made
