"""The declared means of measuring of `arm.yaml`: cameras, markers, anchors, sensors."""

from typing import Annotated, Literal

from pydantic import Field

from longarm_comp.core.arm.parts import Pose, Positive, Vec3
from longarm_comp.core.yaml_file import RANGES, Declared, Misdeclared

Instrument = Literal["camera", "tracker", "total_station", "touch"]
"""Instruments that measure positions."""


class CameraPlacement(Declared):
    """The stereo head, in the base frame."""

    position_m: Vec3
    optical_axis: Vec3 = (0.0, 1.0, 0.0)

    def check_together(self) -> None:
        if not any(self.optical_axis):
            raise Misdeclared("optical_axis", list(self.optical_axis), "a direction, not zero")


class Marker(Declared):
    """A marker on the arm; a session's `marker` column names the one that was measured."""

    frame: int = Field(ge=0)
    position_m: Vec3 = (0.0, 0.0, 0.0)


class Anchor(Declared):
    """A fixed point that distances are measured to, in the frame of the measurements."""

    xyz_m: Vec3 | None = Field(default=None, description="absent: solved from the data")


class CameraSensor(Pose):
    """A calibrated camera in the base frame, whose rays a session holds in its own axes."""

    kind: Literal["camera"]


_Axis = Literal["x", "y", "z"]


class Inclinometer(Declared):
    """An inclinometer, whose two readings (rad) are the columns ``incl_<name>_x`` and ``_y``."""

    kind: Literal["inclinometer"]
    row: int | None = Field(default=None, ge=0, description="frame it turns with; absent: searched")
    axes: tuple[_Axis, _Axis] = Field(default=("x", "y"), description="frame axes they turn about")
    sign: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, 1)
    gain: Literal["one", "free"] = Field(default="one", description="free: fitted")

    def check_together(self) -> None:
        if self.axes[0] == self.axes[1]:
            raise Misdeclared("axes", list(self.axes), "two that differ of x, y, z")


Sensors = dict[str, Annotated[CameraSensor | Inclinometer, Field(discriminator="kind")]]


VISIBLE_M = 1e-4
"""Smallest displacement that a good camera detects in one image, m."""
PRINTED = 1e-4
"""Default tolerance (m) of a known distance: that of a printed or drilled part."""
KnownDistance = tuple[str, str, float, float]
"""Names of two touched points, their distance (m), its standard deviation (m)."""
_Length = Annotated[float, Field(ge=1e-9, le=RANGES["_m"][1])]
TouchDistances = tuple[tuple[str, str, _Length] | tuple[str, str, _Length, _Length], ...]
"""Known distances as a file declares them; the standard deviation may be left out."""


def known_distances(declared: TouchDistances) -> tuple[KnownDistance, ...]:
    """Return declared distances with the default tolerance (`PRINTED`) where none is given."""
    return tuple((d[0], d[1], d[2], d[3] if len(d) == 4 else PRINTED) for d in declared)


class Touches(Declared):
    """`touches.yaml`, a file beside a session: known distances between touched points."""

    touch_distances: TouchDistances = Field(description="[name, name, m] or [name, name, m, sd]")


_Spread = Positive | tuple[Positive, Positive, Positive]
"""A standard deviation for all three components, or one for each."""


class _PointTolerance(Declared):
    """The tolerance of a point: standard deviation of its position (m)."""

    xyz_m: _Spread


class _PoseTolerance(_PointTolerance):
    """The tolerance of a placement: standard deviations of position (m) and rotation (deg)."""

    rpy_deg: _Spread


class Placements(Declared):
    """Tolerances of known placements. A placement without a tolerance is solved from the data."""

    base: _PoseTolerance | None = None
    tip: _PointTolerance | None = None
    markers: dict[str, _PointTolerance] = Field(default_factory=dict)


def three(spread: _Spread) -> Vec3:
    """Return the standard deviations of the three components."""
    return spread if isinstance(spread, tuple) else (spread, spread, spread)
