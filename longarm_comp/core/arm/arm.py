"""The declared arm: what the user writes in `arm.yaml`, checked once at the door.

Modified DH rows (Craig): ``T_i = Rx(alpha_{i-1}) Tx(a_{i-1}) Rz(theta_i) Tz(d_i)``;
a row lists ``alpha_{i-1}, a_{i-1}``.  Keys carry their unit; everything an `Arm`
hands out is SI and radians.
"""

from __future__ import annotations

import hashlib
import json
import math
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from longarm_comp.core.arm.spatial import IDENTITY, Frame, rpy_frame
from longarm_comp.core.yaml_file import RANGES, Declared, Misdeclared, parse_declared, read_yaml

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Pose(Declared):
    """A fixed placement: translation (m) and fixed-axis roll, pitch, yaw (deg)."""

    xyz_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_deg: Vec3 = (0.0, 0.0, 0.0)

    def frame(self) -> Frame:
        """As a frame in its parent."""
        return rpy_frame(self.xyz_m, tuple(map(math.radians, self.rpy_deg)))  # type: ignore[arg-type]


class Tip(Declared):
    """The point (and orientation) that is commanded and measured."""

    frame: int = Field(description="row whose frame carries the tip")
    position_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_deg: Vec3 = (0.0, 0.0, 0.0)

    def pose(self) -> Frame:
        """The tip in its frame."""
        return rpy_frame(self.position_m, tuple(map(math.radians, self.rpy_deg)))  # type: ignore[arg-type]


class Mimic(Declared):
    """URDF's mimic: this joint's value is ``multiplier * joint + offset``."""

    joint: int | str = Field(description="id or name of the commanded joint")
    multiplier: float = 1.0
    offset: float = Field(default=0.0, description="rad or m")


class Tolerance(Declared):
    """Prior standard deviations of a row's geometry, from the drawing or the print."""

    a_m: Positive | None = None
    d_m: Positive | None = None
    alpha_deg: Positive | None = None
    theta_deg: Positive | None = None


class Joint(Declared):
    """One row of the chain."""

    id: int = Field(ge=1)
    name: str | None = None
    type: Literal["revolute", "prismatic", "fixed"]
    a_m: float = 0.0
    alpha_deg: float = 0.0
    d_m: float = 0.0
    theta_offset_deg: float = 0.0
    limits_deg: tuple[float, float] | None = None
    limits_m: tuple[float, float] | None = None
    step_deg: Positive | None = Field(
        default=None, description="the servo's step, at a revolute joint; absent: continuous"
    )
    step_m: Positive | None = Field(
        default=None, description="the servo's step, at a prismatic joint; absent: continuous"
    )
    mimic: Mimic | list[Mimic] | None = Field(
        default=None, description="a passive joint; several terms are summed"
    )
    moves: bool = Field(
        default=True,
        description="false: a commanded joint beside the chain, which other rows mimic",
    )
    pose: Pose | None = Field(default=None, description="fixed rows: the whole transform")
    tolerance: Tolerance = Tolerance()

    @model_validator(mode="after")
    def _consistent(self) -> Joint:
        given = {"limits_deg": self.limits_deg, "limits_m": self.limits_m}
        key = {"revolute": "limits_deg", "prismatic": "limits_m"}.get(self.type)
        if self.type == "fixed" and self.mimic:
            raise Misdeclared("mimic", self.mimic, "none in a fixed row")
        if not self.moves and not self.commanded:
            raise Misdeclared("moves", False, "true, but in the row of a commanded joint")
        if self.pose is not None and self.type != "fixed":
            allowed = "in fixed rows only; use a_m, alpha_deg, d_m, theta_offset_deg"
            raise Misdeclared("pose", f"given in a {self.type} row", allowed)
        for name, limits in given.items():
            if limits is None:
                continue
            if name != key:
                allowed = f"{key} for a {self.type} joint" if key else "none in a fixed row"
                raise Misdeclared(name, list(limits), allowed)
            if not limits[0] < limits[1]:
                raise Misdeclared(name, list(limits), "[lower, upper] with lower < upper")
        if key is not None and not self.mimic and given[key] is None:
            raise Misdeclared(key, "missing", f"[lower, upper] of a commanded {self.type} joint")
        self._check_step(key)
        return self

    def _check_step(self, key: str | None) -> None:
        mine = key.replace("limits", "step") if key and not self.mimic else None
        for name, step in (("step_deg", self.step_deg), ("step_m", self.step_m)):
            if step is not None and name != mine:
                driven = "a passive" if self.mimic else "a fixed"
                allowed = f"{mine} for a {self.type} joint" if mine else f"none in {driven} row"
                raise Misdeclared(name, step, allowed)
            if step is not None and self.limits[1] - self.limits[0] < self.step:
                raise Misdeclared(name, step, "at most the joint's range, upper less lower limit")

    @property
    def commanded(self) -> bool:
        """Whether a motor drives this row."""
        return self.type != "fixed" and not self.mimic

    @property
    def mimics(self) -> list[Mimic]:
        """The mimic terms, none for a commanded joint."""
        if self.mimic is None:
            return []
        return self.mimic if isinstance(self.mimic, list) else [self.mimic]

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit in rad or m."""
        if self.limits_deg is not None:
            return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])
        return self.limits_m if self.limits_m is not None else (-math.inf, math.inf)

    @property
    def step(self) -> float:
        """The servo's step in rad or m; 0 where the joint is continuous."""
        return math.radians(self.step_deg) if self.step_deg is not None else self.step_m or 0.0


class Tube(Declared):
    """Round tube, or round bar with ``id_m: 0``."""

    type: Literal["tube"]
    od_m: Positive
    id_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _hollow(self) -> Tube:
        if self.id_m >= self.od_m:
            raise Misdeclared("id_m", self.id_m, f"less than od_m {self.od_m}")
        return self

    def second_moments(self) -> tuple[float, float, float]:
        """(I about the first, I about the second transverse axis, torsion constant), m^4."""
        i = math.pi / 64 * (self.od_m**4 - self.id_m**4)
        return i, i, 2 * i


class Rect(Declared):
    """Solid or box rectangle; width along the first, height along the second transverse axis."""

    type: Literal["rect"]
    width_m: Positive
    height_m: Positive
    wall_m: Positive | None = Field(default=None, description="box wall; solid if absent")

    @model_validator(mode="after")
    def _walled(self) -> Rect:
        if self.wall_m is not None and 2 * self.wall_m >= min(self.width_m, self.height_m):
            raise Misdeclared("wall_m", self.wall_m, "less than half of width_m and of height_m")
        return self

    def second_moments(self) -> tuple[float, float, float]:
        """(I about the first, I about the second transverse axis, torsion constant), m^4.

        Torsion: Roark's formula for the solid rectangle, Bredt's for the thin-walled box.
        """
        b, h, t = self.width_m, self.height_m, self.wall_m
        about_first, about_second = b * h**3 / 12, h * b**3 / 12
        if t is None:
            long, short = max(b, h) / 2, min(b, h) / 2
            q = short / long
            j = long * short**3 * (16 / 3 - 3.36 * q * (1 - q**4 / 12))
            return about_first, about_second, j
        bi, hi = b - 2 * t, h - 2 * t
        bm, hm = b - t, h - t
        j = 2 * t * bm**2 * hm**2 / (bm + hm)
        return about_first - bi * hi**3 / 12, about_second - hi * bi**3 / 12, j


class Beam(Declared):
    """An elastic beam along ``z_i`` (role d) or ``x_{i-1}`` (role a) of a row, base to tip.

    ``length_m: rest`` is what is left of the row's ``d + q``; the body slides inside
    the beam before it.  Mass is uniform over `body_length_m`, which ends where the beam ends.
    """

    name: str
    row: int
    role: Literal["a", "d"]
    length_m: Positive | Literal["rest"]
    section: Annotated[Tube | Rect, Field(discriminator="type")] | None = None
    E_pa: Positive | None = None
    poisson: Annotated[float, Field(gt=-1, lt=0.5)] | None = None
    G_pa: Positive | None = None
    EI_nm2: Positive | None = None
    GJ_nm2: Positive | None = None
    mass_kg: NonNegative = 0.0
    mass: Literal["uniform"] = "uniform"
    body_length_m: Positive | None = None

    @model_validator(mode="after")
    def _stiff(self) -> Beam:
        if (self.section is None) == (self.EI_nm2 is None):
            state = "missing" if self.section is None else "given beside EI_nm2"
            raise Misdeclared("section", state, "either section with E_pa, or EI_nm2 with GJ_nm2")
        if self.section is not None and self.E_pa is None:
            raise Misdeclared("E_pa", "missing", "Young's modulus of the section in Pa")
        if self.section is not None and (self.poisson is None) == (self.G_pa is None):
            state = "missing" if self.poisson is None else "given beside G_pa"
            raise Misdeclared("poisson", state, "either poisson or G_pa")
        if self.EI_nm2 is not None and self.GJ_nm2 is None:
            raise Misdeclared("GJ_nm2", "missing", "torsional stiffness in N m^2, beside EI_nm2")
        if self.length_m == "rest" and self.body_length_m is None and self.mass_kg > 0:
            raise Misdeclared(
                "body_length_m", "missing", "needed by a beam of length rest with mass"
            )
        lowest, highest = RANGES["_nm2"]
        if not all(lowest <= value <= highest for value in self.stiffness):
            made = ", ".join(f"{value:.3g}" for value in self.stiffness)
            raise Misdeclared("section", made, f"EI and GJ of {lowest:g} to {highest:g} N m^2")
        return self

    @cached_property
    def stiffness(self) -> tuple[float, float, float]:
        """(EI about the first, EI about the second transverse axis, GJ) in N m^2."""
        if self.section is None:
            assert self.EI_nm2 is not None and self.GJ_nm2 is not None
            return self.EI_nm2, self.EI_nm2, self.GJ_nm2
        assert self.E_pa is not None
        shear = self.G_pa if self.G_pa is not None else self.E_pa / (2 * (1 + (self.poisson or 0)))
        first, second, torsion = self.section.second_moments()
        return self.E_pa * first, self.E_pa * second, shear * torsion


class PointMass(Declared):
    """A lumped mass fixed to a frame (servo, gripper, a link given by its centre of mass)."""

    name: str
    frame: int = Field(ge=0)
    position_m: Vec3 = (0.0, 0.0, 0.0)
    mass_kg: NonNegative
    position_columns: tuple[str, str, str] | None = Field(
        default=None,
        description="session columns (m, in the frame) where the mass is, instead of position_m",
    )


class Payload(Declared):
    """What the arm carries; a session's `payload_kg` column overrides the mass."""

    mass_kg: NonNegative = 0.0
    frame: int = Field(ge=0)
    position_m: Vec3 = (0.0, 0.0, 0.0)


class CameraPlacement(Declared):
    """The stereo head, in the base frame."""

    position_m: Vec3
    optical_axis: Vec3 = (0.0, 1.0, 0.0)

    @model_validator(mode="after")
    def _looks(self) -> CameraPlacement:
        if not any(self.optical_axis):
            raise Misdeclared("optical_axis", list(self.optical_axis), "a direction, not zero")
        return self


class Marker(Declared):
    """One of several markers that a session's `marker` column names."""

    frame: int = Field(ge=0)
    position_m: Vec3 = (0.0, 0.0, 0.0)


class Anchor(Declared):
    """A fixed point that distances are measured to, in the frame of the measurements."""

    xyz_m: Vec3 | None = Field(default=None, description="absent: solved from the data")


class CameraSensor(Pose):
    """A calibrated camera in the base frame, whose rays a session holds in its own axes."""

    kind: Literal["camera"]


Axis = Literal["x", "y", "z"]


class Inclinometer(Declared):
    """An inclinometer, whose two readings (rad) are the columns ``incl_<name>_x`` and ``_y``."""

    kind: Literal["inclinometer"]
    row: int | None = Field(default=None, ge=0, description="frame it turns with; absent: searched")
    axes: tuple[Axis, Axis] = Field(default=("x", "y"), description="frame axes they turn about")
    sign: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, 1)
    gain: Literal["one", "free"] = Field(default="one", description="free: fitted")

    @model_validator(mode="after")
    def _two(self) -> Inclinometer:
        if self.axes[0] == self.axes[1]:
            raise Misdeclared("axes", list(self.axes), "two that differ of x, y, z")
        return self


Sensors = dict[str, Annotated[CameraSensor | Inclinometer, Field(discriminator="kind")]]


Spread = Positive | tuple[Positive, Positive, Positive]
"""One standard deviation for all three components, or one each."""


class PointTolerance(Declared):
    """How well a point is known: standard deviation of its position (m)."""

    xyz_m: Spread


class PoseTolerance(Declared):
    """How well a placement is known: standard deviations of position (m) and rotation (deg)."""

    xyz_m: Spread
    rpy_deg: Spread


class Placements(Declared):
    """Placements that are known to a tolerance. What is absent is unknown and solved from data."""

    base: PoseTolerance | None = None
    tip: PointTolerance | None = None
    markers: dict[str, PointTolerance] = Field(default_factory=dict)


def three(spread: Spread) -> Vec3:
    """A standard deviation of each component."""
    return spread if isinstance(spread, tuple) else (spread, spread, spread)


class Arm(Declared):
    """The declared arm."""

    name: str
    convention: Literal["mdh_craig"]
    base: Pose = Pose()
    tip: Tip
    gravity_mps2: Vec3 = (0.0, 0.0, -9.80665)
    reference_temperature_c: float = 20.0
    payload: Payload | None = None
    joints: tuple[Joint, ...] = Field(min_length=1)
    links: tuple[Beam, ...] = ()
    point_masses: tuple[PointMass, ...] = ()
    camera: CameraPlacement | None = None
    markers: dict[str, Marker] = Field(default_factory=dict)
    anchors: dict[str, Anchor] = Field(default_factory=dict)
    sensors: Sensors = Field(default_factory=dict)
    tolerance: Placements = Placements()

    @model_validator(mode="after")
    def _chain(self) -> Arm:
        rows = len(self.joints)
        if [j.id for j in self.joints] != list(range(1, rows + 1)):
            ids = [j.id for j in self.joints]
            raise Misdeclared("joints.id", ids, f"1..{rows} in order, base to tip")
        carried = [("tip", self.tip.frame)]
        carried += [(f"point_masses.{k}", m.frame) for k, m in enumerate(self.point_masses)]
        carried += [(f"markers.{k}", m.frame) for k, m in self.markers.items()]
        for k, sensor in self.sensors.items():
            if isinstance(sensor, Inclinometer) and (sensor.row or 0) > rows:
                raise Misdeclared(f"sensors.{k}.row", sensor.row, f"0..{rows}")
        carried += [("payload", self.payload.frame)] if self.payload else []
        for owner, frame in carried:
            if not 0 <= frame <= rows:
                raise Misdeclared(f"{owner}.frame", frame, f"0..{rows}")
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
                    raise Misdeclared(f"joints.{joint.id - 1}.mimic.joint", mimic.joint, allowed)
        self._check_beams()
        return self

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
                lowest = size
                if role == "d" and joint.type == "prismatic" and joint.commanded:
                    lowest += joint.limits[0]
                field = f"links ({', '.join(b.name for b in beams)}).length_m"
                if rests > 1:
                    raise Misdeclared(field, f"{rests} times rest", f"one rest in row {row} {role}")
                if beams and (fixed > abs(lowest) + (-1e-9 if rests else 1e-9)):
                    allowed = f"less than {lowest} m, row {row} {role} at its shortest"
                    raise Misdeclared(field, f"{fixed} m together", allowed)

    @cached_property
    def commanded(self) -> tuple[int, ...]:
        """Row ids of the commanded joints, in the order of q."""
        return tuple(j.id for j in self.joints if j.commanded)

    @property
    def n(self) -> int:
        """Number of commanded joints."""
        return len(self.commanded)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the commanded joints, in the order of q."""
        return tuple(self.joints[i - 1].name or f"joint{i}" for i in self.commanded)

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower joint limits, (n,), rad or m."""
        return np.array([self.joints[i - 1].limits[0] for i in self.commanded])

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper joint limits, (n,), rad or m."""
        return np.array([self.joints[i - 1].limits[1] for i in self.commanded])

    @cached_property
    def steps(self) -> np.ndarray:
        """Steps of the joints' servos, (n,), rad or m; 0 where a joint is continuous."""
        return np.array([self.joints[i - 1].step for i in self.commanded])

    @property
    def mid(self) -> np.ndarray:
        """Middle of the joint box, (n,)."""
        return (self.lower + self.upper) / 2

    @cached_property
    def mixing(self) -> tuple[np.ndarray, np.ndarray]:
        """(M, c) with joint values of all rows = q M' + c: M (rows, n), c (rows,)."""
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

    def anchor(self, name: str) -> Vec3:
        """Declared place of an anchor (m), the origin where it is to be solved."""
        held = self.anchors.get(name)
        return held.xyz_m if held is not None and held.xyz_m is not None else (0.0, 0.0, 0.0)

    @property
    def inclinometers(self) -> tuple[str, ...]:
        """Names that ``incl_<name>_x`` may hold: rows, 0 for the base, and declared sensors."""
        named = [k for k, v in self.sensors.items() if isinstance(v, Inclinometer)]
        return (*(str(row) for row in range(len(self.joints) + 1)), *named)

    def camera_frame(self, name: str) -> np.ndarray:
        """Pose (3, 4) of a declared camera in the base frame; the base where there is none."""
        held = self.sensors.get(name)
        return (held.frame() if isinstance(held, CameraSensor) else IDENTITY).matrix()[:3]

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the arm's contents (not of the file's layout)."""
        text = json.dumps(self.model_dump(mode="json", exclude_defaults=True), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @classmethod
    def load(cls, path: str | Path) -> Arm:
        """Read `arm.yaml`.

        Raises:
            InputError: the file cannot be read, a key is unknown, a value is not allowed.
        """
        return cls.parse(read_yaml(path), str(path))

    @classmethod
    def parse(cls, data: Any, where: str) -> Arm:
        """From parsed YAML; `where` names the source in errors."""
        return parse_declared(cls, data, where)
