"""Declared parts of `arm.yaml` other than DH rows: placements, masses, beams, cylinders, boxes."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.spatial import Frame, Scalar, rpy_frame
from longarm_comp.core.yaml_file import RANGES, Declared, Misdeclared

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Pose(Declared):
    """A fixed placement: translation (m) and fixed-axis roll, pitch, yaw (deg)."""

    xyz_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_deg: Vec3 = (0.0, 0.0, 0.0)

    def frame(self) -> Frame:
        return rpy_frame(self.xyz_m, tuple(map(math.radians, self.rpy_deg)))  # type: ignore[arg-type]


class Tip(Declared):
    """The point (and orientation) that is commanded and measured."""

    frame: int = Field(description="row whose frame carries the tip")
    position_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_deg: Vec3 = (0.0, 0.0, 0.0)

    def pose(self) -> Frame:
        return rpy_frame(self.position_m, tuple(map(math.radians, self.rpy_deg)))  # type: ignore[arg-type]


class Mimic(Declared):
    """URDF's mimic: this joint's value is ``multiplier * joint + offset``."""

    joint: int | str = Field(description="id or name of the commanded joint")
    multiplier: float = 1.0
    offset: float = Field(default=0.0, description="rad or m")


class Coupling(Declared):
    """A commanded joint whose value is its command plus ``factor`` times that of another joint."""

    joint: int | str = Field(description="id or name of the other commanded joint")
    factor: float


class Tolerance(Declared):
    """Prior standard deviations of a row's geometry, from the drawing or the print."""

    a_m: Positive | None = None
    d_m: Positive | None = None
    alpha_deg: Positive | None = None
    theta_deg: Positive | None = None


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
    """The load that the arm carries; a session's `payload_kg` column overrides the mass."""

    mass_kg: NonNegative = 0.0
    most_kg: NonNegative | None = Field(default=None, description="largest mass it may carry")
    frame: int = Field(ge=0)
    position_m: Vec3 = (0.0, 0.0, 0.0)

    def check_together(self) -> None:
        if self.most_kg is not None and self.most_kg < self.mass_kg:
            raise Misdeclared("most_kg", self.most_kg, f"at least mass_kg, {self.mass_kg}")


class Tube(Declared):
    """Round tube, or round bar with ``id_m: 0``."""

    type: Literal["tube"]
    od_m: Positive
    id_m: NonNegative = 0.0

    def check_together(self) -> None:
        if self.id_m >= self.od_m:
            raise Misdeclared("id_m", self.id_m, f"less than od_m {self.od_m}")

    def second_moments(self) -> tuple[float, float, float]:
        """Return second moments about the two transverse axes and the torsion constant, m^4."""
        i = math.pi / 64 * (self.od_m**4 - self.id_m**4)
        return i, i, 2 * i


class Rect(Declared):
    """A rectangular bar or box; width along the first transverse axis, height along the second."""

    type: Literal["rect"]
    width_m: Positive
    height_m: Positive
    wall_m: Positive | None = Field(default=None, description="box wall; solid if absent")

    def check_together(self) -> None:
        if self.wall_m is not None and 2 * self.wall_m >= min(self.width_m, self.height_m):
            raise Misdeclared("wall_m", self.wall_m, "less than half of width_m and of height_m")

    def second_moments(self) -> tuple[float, float, float]:
        """Return second moments about the two transverse axes and the torsion constant, m^4.

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

    With ``length_m: rest`` its length is the row's ``d + q`` (or ``a``) less the row's other beams,
    and its body slides inside the beam before it.  The mass is uniform over `body_length_m`, which
    ends where the beam ends; without it, over the beam.
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

    def check_together(self) -> None:
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
            allowed = "needed by a beam of length rest with mass"
            raise Misdeclared("body_length_m", "missing", allowed)
        lowest, highest = RANGES["_nm2"]
        if not all(lowest <= value <= highest for value in self.stiffness):
            made = ", ".join(f"{value:.3g}" for value in self.stiffness)
            raise Misdeclared("section", made, f"EI and GJ of {lowest:g} to {highest:g} N m^2")

    @cached_property
    def stiffness(self) -> tuple[float, float, float]:
        """EI about the first transverse axis, EI about the second, and GJ, in N m^2."""
        if self.section is None:
            assert self.EI_nm2 is not None and self.GJ_nm2 is not None
            return self.EI_nm2, self.EI_nm2, self.GJ_nm2
        assert self.E_pa is not None
        shear = self.G_pa if self.G_pa is not None else self.E_pa / (2 * (1 + (self.poisson or 0)))
        first, second, torsion = self.section.second_moments()
        return self.E_pa * first, self.E_pa * second, shear * torsion


class Cylinder(Declared):
    """The positions of the two pins of the cylinder that drives a revolute joint.

    ``length^2 = near^2 + far^2 - 2 near far cos(angle)``, the law of cosines.  The angle is between
    the pins, seen from the joint's axis.  It is ``angle_deg`` at joint value 0, and increases
    (``grows: 1``) or decreases (-1) with the joint value.
    """

    near_m: Positive = Field(description="joint axis to the pin on the part before the joint")
    far_m: Positive = Field(description="joint axis to the pin on the part that turns")
    angle_deg: Annotated[float, Field(gt=0, lt=180)] = Field(
        description="angle between the two at joint value 0"
    )
    grows: Literal[1, -1] = 1

    def angle(self, q: Scalar) -> Scalar:
        """Return the angle between the pins at the joint's axis, rad, at joint value q (rad)."""
        return math.radians(self.angle_deg) + self.grows * q

    def length(self, q: Scalar) -> Scalar:
        """Return the distance between the pins, m, at joint value q (rad)."""
        squares = self.near_m**2 + self.far_m**2
        return spatial.sqrt(squares - 2 * self.near_m * self.far_m * spatial.cos(self.angle(q)))

    def lever(self, q: Scalar) -> Scalar:
        """Return the derivative of the length by the joint value, m/rad, at joint value q (rad).

        Its size is the distance of the cylinder from the joint's axis; its sign is that of `grows`.
        """
        area = self.grows * self.near_m * self.far_m * spatial.sin(self.angle(q))
        return area / self.length(q)


class Box(Declared):
    """A box in the base frame, with sides parallel to the axes."""

    min_m: Vec3
    max_m: Vec3

    def check_together(self) -> None:
        if any(low >= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise Misdeclared("max_m", list(self.max_m), f"above min_m, {list(self.min_m)}")

    @property
    def thickness(self) -> float:
        """The length of its shortest side, m."""
        return min(high - low for low, high in zip(self.min_m, self.max_m, strict=True))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return (...) bool: which of points (..., 3), m, are in the box."""
        inside = (points >= np.array(self.min_m)) & (points <= np.array(self.max_m))
        return np.asarray(inside.all(axis=-1))

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return (...) depth of points (..., 3), m: the distance from the nearest side, inside."""
        inside = np.minimum(points - np.array(self.min_m), np.array(self.max_m) - points)
        return np.asarray(inside.min(axis=-1))

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return a lower bound of the distance of polyline segments from the box, (..., k - 1), m.

        It is 0 only for segments that have a point in the box.  It is the largest gap along the
        separating axes: the axes of the box, combined, and, for a segment longer than that
        gap, the axes perpendicular to the segment and to one axis of the box.

        Args:
            points: (..., k, 3) corners of the polylines, m.
        """
        begin, end = points[..., :-1, :], points[..., 1:, :]
        low, high = np.array(self.min_m), np.array(self.max_m)
        beside = np.maximum(low - np.maximum(begin, end), np.minimum(begin, end) - high)
        found = np.asarray(np.linalg.norm(np.maximum(beside, 0.0), axis=-1))
        longer = found < np.linalg.norm(end - begin, axis=-1)
        way, off = (end - begin)[longer], (begin - (low + high) / 2)[longer]
        half, gaps = (high - low) / 2, [found[longer]]
        for a, b in ((0, 1), (1, 2), (2, 0)):  # the plane in which the axis lies
            along, across = way[:, a], way[:, b]
            length = np.hypot(along, across)
            gap = np.abs(off[:, a] * across - off[:, b] * along)
            gap -= half[a] * np.abs(across) + half[b] * np.abs(along)
            gaps.append(np.divide(gap, length, np.zeros_like(gap), where=length > 0.0))
        found[longer] = np.max(gaps, axis=0)
        return found


def link_places(joints: Sequence[Any]) -> list[tuple[int, str, float]]:
    """List the lengths of movable rows along which a link can lie, the longest first.

    Each is the row id, the role (``a`` or ``d``) and the signed length at joint value 0, m.
    """
    movable = [j for j in joints if j.type != "fixed"]
    sizes = [(j.id, role, s) for j in movable for role, s in (("a", j.a_m), ("d", j.d_m)) if s]
    return sorted(sizes, key=lambda place: -abs(place[2]))
