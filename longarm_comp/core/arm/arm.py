"""The declared arm: what the user writes in `arm.yaml`, checked once.

Modified DH rows (Craig): ``T_i = Rx(alpha_{i-1}) Tx(a_{i-1}) Rz(theta_i) Tz(d_i)``; a row lists
``alpha_{i-1}, a_{i-1}``.  Keys carry their unit; properties of an `Arm` are in SI units and rad.
"""

from __future__ import annotations

import hashlib
import json
import math
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from longarm_comp.core.arm.joint import Joint
from longarm_comp.core.arm.measuring import (
    Anchor,
    CameraPlacement,
    CameraSensor,
    Inclinometer,
    Instrument,
    Marker,
    Placements,
    Sensors,
    TouchDistances,
)
from longarm_comp.core.arm.parts import Beam, Box, Payload, PointMass, Pose, Tip, Vec3, link_places
from longarm_comp.core.arm.spatial import IDENTITY
from longarm_comp.core.errors import InputError
from longarm_comp.core.html_table import html_table
from longarm_comp.core.yaml_file import Declared, Misdeclared, parse_declared, read_yaml


class Arm(Declared):
    """The declared arm."""

    name: str
    convention: Literal["mdh_craig"]
    base: Pose = Pose()
    tip: Tip
    gravity_mps2: Vec3 = (0.0, 0.0, -9.80665)
    reference_temperature_c: float = 20.0
    damping: float | None = Field(
        default=None,
        gt=0.0,
        lt=1.0,
        description="share of critical damping with which the arm rings after a move",
    )
    payload: Payload | None = None
    joints: tuple[Joint, ...] = Field(min_length=1)
    links: tuple[Beam, ...] = ()
    point_masses: tuple[PointMass, ...] = ()
    camera: CameraPlacement | None = None
    measuring: Instrument | None = Field(
        default=None, description="what measures positions; only its own causes are tried then"
    )
    markers: dict[str, Marker] = Field(default_factory=dict)
    anchors: dict[str, Anchor] = Field(default_factory=dict)
    sensors: Sensors = Field(default_factory=dict)
    touch_distances: TouchDistances = Field(
        default=(), description="known ones between touched points: [name, name, m] (, sd)"
    )
    keep_out: dict[str, Box] = Field(default_factory=dict)
    tolerance: Placements = Placements()

    def check_together(self) -> None:
        rows, ids = len(self.joints), [j.id for j in self.joints]
        if ids != list(range(1, rows + 1)):
            raise Misdeclared("joints.id", ids, f"1..{rows} in order, base to tip")
        for k, sensor in self.sensors.items():
            if isinstance(sensor, Inclinometer) and (sensor.row or 0) > rows:
                raise Misdeclared(f"sensors.{k}.row", sensor.row, f"0..{rows}")
        carried: dict[str, Any] = {"tip": self.tip}
        carried |= {f"point_masses.{k}": m for k, m in enumerate(self.point_masses)}
        carried |= {f"markers.{k}": m for k, m in self.markers.items()}
        carried |= {"payload": self.payload} if self.payload else {}
        for owner, part in carried.items():
            if not 0 <= part.frame <= rows:
                raise Misdeclared(f"{owner}.frame", part.frame, f"0..{rows}")
        for name in self.tolerance.markers:
            if name not in self.markers:
                declared = f"a declared marker: {', '.join(self.markers) or 'none'}"
                raise Misdeclared(f"tolerance.markers.{name}", "unknown", declared)
        if len(set(self.joint_names)) != self.n:
            raise Misdeclared("joints.name", list(self.joint_names), "names that differ")
        for joint in self.joints:
            for mimic in joint.mimics:
                if mimic.joint not in self.joint_names and not (
                    isinstance(mimic.joint, int) and mimic.joint in self.commanded
                ):
                    allowed = f"a commanded joint: {list(self.commanded)}, {list(self.joint_names)}"
                    key = "coupling" if joint.coupling else "mimic"
                    raise Misdeclared(f"joints.{joint.id - 1}.{key}.joint", mimic.joint, allowed)
            mine = (joint.id, joint.name or f"joint{joint.id}")
            if joint.coupling and joint.coupling.joint in mine:
                field = f"joints.{joint.id - 1}.coupling.joint"
                raise Misdeclared(field, joint.coupling.joint, "another joint")
        for number, whole in zip(self.commanded, self.circular, strict=True):
            if self.joints[number - 1].endless and not whole:
                allowed = "where the rows that mimic it turn, by whole turns"
                raise Misdeclared(f"joints.{number - 1}.endless", True, allowed)
        self._check_beams()

    def _check_beams(self) -> None:
        names = [beam.name for beam in self.links]
        if len(set(names)) != len(names):
            raise Misdeclared("links.name", names, "names that differ")
        movable = [j.id for j in self.joints if j.type != "fixed"]
        for k, beam in enumerate(self.links):
            if beam.row not in movable:
                allowed = f"a row that is not fixed: {movable}"
                raise Misdeclared(f"links.{k}.row", beam.row, allowed)
        for row, joint in enumerate(self.joints, 1):
            for role, size in (("d", joint.d_m), ("a", joint.a_m)):
                beams = [b for b in self.links if b.row == row and b.role == role]
                fixed = math.fsum(b.length_m for b in beams if b.length_m != "rest")
                rests = sum(b.length_m == "rest" for b in beams)
                slides = role == "d" and joint.type == "prismatic" and joint.commanded
                lowest = size + joint.limits[0] if slides else size
                field = f"links ({', '.join(b.name for b in beams)}).length_m"
                if rests > 1:
                    raise Misdeclared(field, f"{rests} times rest", f"one rest in row {row} {role}")
                if beams and (fixed > abs(lowest) + (-1e-9 if rests else 1e-9)):
                    allowed = f"less than {lowest} m, row {row} {role} at its shortest"
                    raise Misdeclared(field, f"{fixed} m together", allowed)

    @property
    def declares_weight(self) -> bool:
        """True if the weight of any part is declared."""
        return bool(self.links or self.point_masses or self.payload)

    @cached_property
    def usual_masses(self) -> tuple[tuple[int, Vec3, float], ...]:
        """Masses assumed for an arm that declares none: one kilogram per metre of length.

        Each is the row of a frame, the middle of the length in that frame (m), and the mass (kg).
        """
        x, y, z = self.tip.position_m
        masses = [(self.tip.frame, (x / 2, y / 2, z / 2), math.hypot(x, y, z))]
        for row, role, size in link_places(self.joints):
            first = role == "a"  # along the x axis of the row before
            at = (size / 2, 0.0, 0.0) if first else (0.0, 0.0, -size / 2)
            masses.append((row - 1 if first else row, at, abs(size)))
        return tuple(masses)

    @cached_property
    def usual_mass_kg(self) -> float:
        """Mass assumed for an arm that declares none: one kilogram per metre of length."""
        return sum(mass for *_, mass in self.usual_masses)

    @cached_property
    def commanded(self) -> tuple[int, ...]:
        """Row ids of the commanded joints, in the order of q."""
        return tuple(j.id for j in self.joints if j.commanded)

    @property
    def n(self) -> int:
        """The number of commanded joints, the length of q."""
        return len(self.commanded)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the commanded joints, in the order of q."""
        return tuple(self.joints[i - 1].name or f"joint{i}" for i in self.commanded)

    def order(self, names: list[str], where: str) -> list[int]:
        """Return the index in `names` of every commanded joint; InputError if one is missing."""
        for name in self.joint_names:
            if name not in names:
                raise InputError(where, f"servo of {name}", "missing", ", ".join(names))
        return [names.index(name) for name in self.joint_names]

    @cached_property
    def names_for_people(self) -> dict[str, str]:
        """Readable names of joints, rows and frames, by the default name that they replace.

        ``joint 4`` becomes ``luff (q2)`` and ``frame 4`` becomes ``frame luff`` if arm.yaml calls
        the joint of row 4 ``luff``. If the joint has no name of its own, only ``joint 4`` changes,
        to ``joint q2``. Names that stay the same are left out.
        """
        names: dict[str, str] = {}
        numbers = {row: f"q{k}" for k, row in enumerate(self.commanded, 1)}
        for joint in self.joints:
            row, number = joint.id, numbers.get(joint.id)
            own = joint.name not in (None, f"joint{row}", f"joint_{row}", number)
            if own:
                names |= {f"{kind} {row}": f"{kind} {joint.name}" for kind in ("row", "frame")}
                names[f"joint {row}"] = f"{joint.name} ({number})" if number else str(joint.name)
            elif number and number != f"q{row}":
                names[f"joint {row}"] = f"joint {number}"
        return names

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower joint limits, (n,), rad or m."""
        return np.array([self.joints[i - 1].limits[0] for i in self.commanded])

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper joint limits, (n,), rad or m."""
        return np.array([self.joints[i - 1].limits[1] for i in self.commanded])

    @cached_property
    def slides(self) -> np.ndarray:
        """(n,) bool: which commanded joints are prismatic; the others are revolute."""
        return np.array([self.joints[i - 1].type == "prismatic" for i in self.commanded])

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest (n,) and highest (n,) values that the joints can have, rad or m.

        They are infinite for an endless joint.
        """
        endless = np.array([self.joints[i - 1].endless for i in self.commanded])
        return np.where(endless, -np.inf, self.lower), np.where(endless, np.inf, self.upper)

    def box_about(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower (..., n) and upper (..., n) limits of a search from joints q (..., n).

        They are the joint limits; for an endless joint, half a turn to either side of q.
        """
        endless = np.isinf(self.bounds[1])
        low = np.where(endless, q - np.pi, self.lower)
        return low, np.where(endless, q + np.pi, self.upper)

    @cached_property
    def steps(self) -> np.ndarray:
        """Steps of the joints' servos, (n,), rad or m; 0 where a joint is continuous."""
        return np.array([self.joints[i - 1].step for i in self.commanded])

    @cached_property
    def telling(self) -> np.ndarray:
        """(n,) smallest motion of each joint, rad or m, that counts as a motion.

        It is the step of the joint's servo, or a ten-thousandth of the range if this is larger:
        0.04 degrees of a full turn, less than the repeatability of drives.
        """
        return np.maximum(self.steps, 1e-4 * (self.upper - self.lower))

    @property
    def mid(self) -> np.ndarray:
        """Middle of every joint's range, (n,), rad or m."""
        return (self.lower + self.upper) / 2

    @cached_property
    def mixing(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix M (rows, n) and offset c (rows,): the joint values of all rows are ``q M' + c``.

        Passive joints follow the commanded ones by `mimic`, and `coupling` is included.
        """
        matrix = np.zeros((len(self.joints), self.n))
        offset = np.zeros(len(self.joints))
        index = {row: k for k, row in enumerate(self.commanded)}
        names = dict(zip(self.joint_names, self.commanded, strict=True))
        for joint in self.joints:
            if joint.commanded and joint.moves:
                matrix[joint.id - 1, index[joint.id]] = 1.0
            for mimic in joint.mimics:
                row = names.get(mimic.joint, mimic.joint)  # type: ignore[arg-type]
                matrix[joint.id - 1, index[row]] += mimic.multiplier  # type: ignore[index]
                offset[joint.id - 1] += mimic.offset
        return matrix, offset

    @cached_property
    def circular(self) -> np.ndarray:
        """(n,) bool: joints after whose full turn the arm stands as before.

        Every row that such a joint moves is revolute and turns by a whole multiple of the joint.
        """
        turning = np.array([joint.type == "revolute" for joint in self.joints])
        moved = self.mixing[0]
        return np.asarray(((moved == 0) | (turning[:, None] & (moved % 1 == 0))).all(axis=0))

    def anchor(self, name: str) -> Vec3:
        """Return the declared position of an anchor (m); the origin if none is declared."""
        anchor = self.anchors.get(name)
        return (anchor and anchor.xyz_m) or (0.0, 0.0, 0.0)

    @property
    def inclinometers(self) -> tuple[str, ...]:
        """Allowed names in the column ``incl_<name>_x``: 0 (base), row ids, declared sensors."""
        named = [k for k, v in self.sensors.items() if isinstance(v, Inclinometer)]
        return (*(str(row) for row in range(len(self.joints) + 1)), *named)

    def camera_frame(self, name: str) -> np.ndarray:
        """Return the pose (3, 4) of a camera in the base frame; the identity if not declared."""
        sensor = self.sensors.get(name)
        return (sensor.frame() if isinstance(sensor, CameraSensor) else IDENTITY).matrix()[:3]

    def __repr__(self) -> str:
        bends = f"{len(self.links)} beams" if self.links else "rigid"
        return f"Arm({self.name}: {self.n} joints ({', '.join(self.joint_names)}), {bends})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        rows = [
            {
                "row": j.id,
                "name": j.name or "",
                "type": j.type,
                "a, m": j.a_m,
                "alpha, deg": j.alpha_deg,
                "d, m": j.d_m,
                "theta, deg": j.theta_offset_deg,
                "limits": " to ".join(f"{v:g}" for v in j.limits_deg or j.limits_m or ()),
            }
            for j in self.joints
        ]
        return html_table(repr(self), rows)

    @cached_property
    def hash(self) -> str:
        """The SHA-256 of the declared values on which a model depends.

        Comments and layout of arm.yaml do not change it, nor do `damping` and `payload.most_kg`.
        """
        beside: Any = {"damping": True, "payload": {"most_kg"}}
        declared = self.model_dump(mode="json", exclude_defaults=True, exclude=beside)
        return hashlib.sha256(json.dumps(declared, sort_keys=True).encode()).hexdigest()

    @classmethod
    def load(cls, path: str | Path) -> Arm:
        """Read `arm.yaml`; InputError if a key or a value is not allowed."""
        if Path(path).suffix.lower() in (".urdf", ".xacro", ".xml"):
            raise InputError(path, "file", "a URDF", "an arm.yaml: longarm import-urdf makes one")
        return cls.parse(read_yaml(path), str(path))

    @classmethod
    def parse(cls, data: Any, where: str) -> Arm:
        """Check parsed YAML and return the arm; `where` names the source in errors."""
        return parse_declared(cls, data, where)
