"""Kinds of measurement: each turns a sensor's readings into scalar equations of the tip.

Fit, diagnosis and report use only channels and equations, so a new kind is one class here.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.quaternion import LENGTH_TOLERANCE
from longarm_comp.core.model.tip_motion import TipMotion

_Labels = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Equations:
    """N rows of k scalar equations."""

    residual: np.ndarray  # (N, k) measured - predicted, m or rad
    columns: np.ndarray  # (N, k, p) derivative of the prediction by each of p parameters
    pull: np.ndarray  # (N, k, 3) derivative of the prediction by the position of the tip


class Kind(ABC):
    """A kind of measurement: it turns readings of one sensor into k equations of the tip."""

    name: ClassVar[str]  # in messages, and in `Bias.sees`
    cells: ClassVar[tuple[str, ...]]  # the c numbers of a reading, as columns of a file
    scalars: ClassVar[tuple[str, ...]]  # names of its k equations
    unit: ClassVar[str] = "m"  # of the equations, ``m`` or ``rad``
    turns: ClassVar[bool] = False  # whether the prediction depends on the tip's orientation
    label: ClassVar[str] = ""
    """Text column that every reading needs, or empty.

    For a kind without cells, a text in it says that the tip was at the place of this name.
    """
    takes: ClassVar[int] = 0
    """Number of rows that determine the place of one name, for a kind without cells."""
    sigma: ClassVar[str] = ""  # column of its standard deviation in a file, or empty
    outside: ClassVar[bool] = True  # whether it measures from outside the arm
    of_joint: ClassVar[bool] = False  # whether it measures a joint and not the tip
    number: int = 0  # of that joint, from 1

    def find_measured(self, values: np.ndarray) -> np.ndarray:
        """Return (N, k) True for the equations that readings (N, c) give; NaN: not measured."""
        whole = np.isfinite(values).all(axis=1, keepdims=True)
        return np.repeat(whole, len(self.scalars), axis=1)

    def wrong(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        """Return (N,) True for impossible readings, and the text of what is allowed instead."""
        return np.zeros(len(values), dtype=bool), ""

    def has_own_frame(self, arm: Arm) -> bool:
        """Tell whether the sensor has a frame of its own, in which the base is to be placed."""
        return self.outside

    @abstractmethod
    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        """Return the equations of readings (N, c); arbitrary in rows where nothing was measured.

        Args:
            tip: the model's tip at the N rows.
            labels: text columns of the rows, (N,) each.
        """


class _Position(Kind):
    """The position: one, two or three coordinates of the tip in the frame of the measurements."""

    name = "position"
    cells = ("x", "y", "z")
    scalars = cells

    def find_measured(self, values: np.ndarray) -> np.ndarray:
        return np.isfinite(values)

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        point, columns = tip.point()
        pull = np.broadcast_to(np.eye(3), (*point.shape, 3))
        return Equations(values - point, columns, pull)


class _Orientation(Kind):
    """The tip's orientation; the residual is the rotation vector (rad), predicted to measured."""

    name = "orientation"
    cells = ("qx", "qy", "qz", "qw")
    scalars = ("rx", "ry", "rz")
    unit = "rad"
    turns = True
    sigma = "sigma_rot"

    def wrong(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        length = np.linalg.norm(values, axis=1)
        return np.abs(length - 1.0) > LENGTH_TOLERANCE, "x, y, z, w of length 1"

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        axes, columns = tip.axes()
        residual = rotation_vector(compute_rotations(values) @ np.swapaxes(axes, -1, -2))
        return Equations(residual, columns, np.zeros((*residual.shape, 3)))


class _Distance(Kind):
    """Distance (m) of the tip to a fixed point, the `anchor` of the row."""

    name = "distance"
    cells = ("distance",)
    scalars = cells
    label = "anchor"
    sigma = "sigma_distance"

    def wrong(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        return values[:, 0] <= 0, "above 0 (m)"

    def has_own_frame(self, arm: Arm) -> bool:
        """Tell whether an anchor's place is declared; if none is, distances refer to the base."""
        return any(anchor.xyz_m is not None for anchor in arm.anchors.values())

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        point, columns = tip.point(self.name)
        places = by_name(tip.model.arm.anchor, labels[self.label])
        away = point - places
        length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        pull = (away / length)[:, None, :]
        return Equations(values - length, pull @ columns, pull)


class _Ray(Kind):
    """Direction in which a calibrated camera sees the tip, in the camera's axes; of any length.

    The residual is the angle (rad) between measured and predicted direction, about two axes.
    """

    name = "ray"
    cells = ("ray_x", "ray_y", "ray_z")
    scalars = ("ray_u", "ray_v")
    unit = "rad"
    label = "sensor"
    sigma = "sigma_ray"

    def wrong(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        return np.linalg.norm(values, axis=1) < 1e-6, "a direction, not zero"

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        point, columns = tip.point(self.name)
        frames = by_name(tip.model.arm.camera_frame, labels[self.label])
        local = np.einsum("nji,nj->ni", frames[:, :, :3], point - frames[:, :, 3])
        length = np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-9)
        seen = local / length
        sideways = compute_axes_across(values)
        flat = np.eye(3) - seen[:, :, None] * seen[:, None, :]
        turned = sideways @ flat / length[..., None]
        pull = np.einsum("nki,nji->nkj", turned, frames[:, :, :3])
        residual = -np.einsum("nki,ni->nk", sideways, seen)
        return Equations(residual, pull @ columns, pull)


class _Contact(Kind):
    """The tip touched something: the same in all rows of one name, at an unknown place."""

    cells = ()
    outside = False


class _Touch(_Contact):
    """A point that the tip touched."""

    name = label = "touch"
    scalars = ("touch_x", "touch_y", "touch_z")
    takes = 1

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        away, columns = tip.point(self.name)
        return Equations(-away, columns, np.broadcast_to(np.eye(3), (*away.shape, 3)))


class _Plane(_Contact):
    """A plane that the tip touched."""

    name = label = "plane"
    scalars = ("plane_z",)
    takes = 3

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        point, columns = tip.point(self.name)
        return Equations(-point[:, 2:], columns[:, 2:], tip.pull(self.name)[:, 2:])


class EncoderReading(Kind):
    """The value that a joint's encoder reads at rest, rad (m for a prismatic joint)."""

    unit = "rad"
    of_joint = True
    outside = False

    def __init__(self, number: int) -> None:
        self.number = number
        self.name = f"read_q{number}"  # type: ignore[misc]
        self.cells = self.scalars = (self.name,)  # type: ignore[misc]

    def equations(self, tip: TipMotion, values: np.ndarray, labels: _Labels) -> Equations:
        read, columns = tip.read(self.number - 1)
        return Equations(values - read, columns, np.zeros((*read.shape, 3)))


class _Kinds(dict[str, Kind]):
    """The kinds that measure the tip; a name such as ``read_q2`` gives an `EncoderReading`."""

    def __missing__(self, name: str) -> Kind:
        return EncoderReading(int(name.removeprefix("read_q")))

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or bool(re.fullmatch(r"read_q[1-9]\d*", str(name)))


KINDS: Mapping[str, Kind] = _Kinds(
    {k.name: k for k in (_Position(), _Orientation(), _Distance(), _Ray(), _Touch(), _Plane())}
)
"""Every kind by name; positions come first in the channels of a session, joints last."""


def compute_axes_across(directions: np.ndarray) -> np.ndarray:
    """Return two unit vectors (N, 2, 3) perpendicular to each direction (N, 3).

    A direction of NaN, which was not measured, counts as (1, 1, 1).
    """
    known = np.where(np.isfinite(directions), directions, 1.0)
    along = known / np.linalg.norm(known, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    first = np.cross(along, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(along, first)], axis=1)


def compute_rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return the matrices (N, 3, 3) of quaternions x, y, z, w (N, 4); the identity for NaN."""
    from scipy.spatial.transform import Rotation  # not for a control program

    known = np.isfinite(quaternions).all(axis=1, keepdims=True)
    q = np.where(known, quaternions, np.array([0.0, 0.0, 0.0, 1.0]))
    return np.asarray(Rotation.from_quat(q).as_matrix())


def by_name(declared: Callable[[str], Any], names: np.ndarray) -> np.ndarray:
    """Return the declared value of each of N names, (N, ...); `declared` returns that of one."""
    known, which = np.unique(names, return_inverse=True)
    return np.array([declared(str(name)) for name in known])[which]


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3), rad, of matrices (N, 3, 3), which may be scaled.

    They are NaN where a matrix is not finite, singular or mirrored.
    """
    from scipy.spatial.transform import Rotation  # not for a control program

    finite = np.isfinite(matrix).all(axis=(1, 2))
    proper = finite & (np.linalg.det(np.where(finite[:, None, None], matrix, 0.0)) > 0)
    found = np.full((len(matrix), 3), np.nan)
    found[proper] = Rotation.from_matrix(matrix[proper]).as_rotvec()
    return found
