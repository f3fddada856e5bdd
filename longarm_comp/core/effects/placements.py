"""Placements of base, tip, markers, sensors and anchors, which every calibration solves."""

import math
from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.measuring import three
from longarm_comp.core.arm.posture import PLACEMENT, Posture, Twists
from longarm_comp.core.arm.spatial import Frame, Twist, Vec, exp_large
from longarm_comp.core.effects.effect import Bias, Effect, Parameter, Sites, parameter, place
from longarm_comp.core.effects.sites import markers


class RigidMotion:
    """A term with the six parameters of a finite motion."""

    x: float
    y: float
    z: float
    rx: float
    ry: float
    rz: float

    @property
    def twist(self) -> Twist:
        """The twist of the motion (m, rad)."""
        return self.x, self.y, self.z, self.rx, self.ry, self.rz


@dataclass(frozen=True)
class BasePose(RigidMotion, Effect):
    """Placement of the base relative to the declared one; one per `group` if the base was moved.

    It is the placement in the frame of the measurements.  Gravity turns with it, so it keeps its
    declared direction in the arm's base; a base that leans is `gravity_direction`.  The base may
    stand anywhere, unless arm.yaml gives a tolerance.
    """

    name = "base_pose"
    title = "base placement"
    action = "Fix the base so that it cannot shift; calibrate after every move of it."
    geometry = True
    knocked = True
    seen_only = True

    group: str = place(default="")
    x: float = parameter("m", "base position error", prior=0.05, unknown=True)
    y: float = parameter("m", "base position error", prior=0.05, unknown=True)
    z: float = parameter("m", "base position error", prior=0.05, unknown=True)
    rx: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)
    ry: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)
    rz: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)

    @property
    def where(self) -> str:
        return f"base of group {self.group}" if self.group else "base"

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Return one placement; a session adds those of its groups."""
        return [{}]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        known = arm.tolerance.base
        if known is None:
            return self.declared()
        turn = (math.radians(v) for v in three(known.rpy_deg))
        return self.with_prior(*three(known.xyz_m), *turn, unknown=False)

    def base(self, arm: Arm) -> Frame:
        return arm.base.frame() @ exp_large(self.twist)

    def twists(self, posture: Posture) -> Twists:
        if not self.group:
            return {PLACEMENT: self.twist}
        mine = posture.context.is_label("group", self.group)
        return {PLACEMENT: tuple(mine * t for t in self.twist)}  # type: ignore[dict-item]


@dataclass(frozen=True)
class TipOffset(Effect):
    """Position error of the tip, or of one of several markers, in the frame that carries it.

    The tip may be anywhere in its frame, unless arm.yaml gives a tolerance.
    """

    name = "tip_offset"
    title = "marker offset"
    whole = "tip"
    action = "Check the mount of the marker or tool."
    geometry = True
    knocked = True

    marker: str = place(markers, default="")
    x: float = parameter("m", "tip position error along x", prior=3e-3, unknown=True)
    y: float = parameter("m", "tip position error along y", prior=3e-3, unknown=True)
    z: float = parameter("m", "tip position error along z", prior=3e-3, unknown=True)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"marker": name} for name in arm.markers or [""]]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        tolerance = arm.tolerance
        known = tolerance.markers.get(self.marker) if self.marker else tolerance.tip
        if known is None:
            return self.declared()
        return self.with_prior(*three(known.xyz_m), unknown=False)

    def twists(self, posture: Posture) -> Twists:
        """Return a displacement (m) of the tip or marker alone; masses in its frame do not move."""
        spot = posture.spot(self.marker)
        if not self.marker:
            return {spot: (self.x, self.y, self.z, 0.0, 0.0, 0.0)}
        mine = posture.context.is_label("marker", self.marker)
        return {spot: (mine * self.x, mine * self.y, mine * self.z, 0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class TipOrientation(Bias):
    """Rotation of a tracked body's axes relative to the tip's, for one marker and one sensor.

    A tracker defines the axes of its bodies, so the prior allows any rotation.
    """

    name = "tip_orientation"
    title = "marker orientation"
    action = "Check the mount of the marker or tool."
    geometry = True
    sees = frozenset({"orientation"})

    marker: str = place(markers, default="")
    sensor: str = place(default="")
    rx: float = parameter("rad", "turn of the measured axes about the tip's", 0.05, unknown=True)
    ry: float = parameter("rad", "turn of the measured axes about the tip's", 0.05, unknown=True)
    rz: float = parameter("rad", "turn of the measured axes about the tip's", 0.05, unknown=True)

    @property
    def where(self) -> str:
        what = f"marker {self.marker}" if self.marker else "tip"
        return f"{what} seen by {self.sensor}" if self.sensor else what

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"marker": name} for name in arm.markers or [""]]

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        return point

    def seen_pose(self, tip: Frame, context: Context, arm: Arm) -> Frame:
        mine = 1.0
        for label, value in (("marker", self.marker), ("sensor", self.sensor)):
            mine = mine * context.is_label(label, value) if value else mine
        turn = spatial.exp_large((0.0, 0.0, 0.0, mine * self.rx, mine * self.ry, mine * self.rz))
        n, o, a = (tip.rotate(axis) for axis in turn[:3])
        return Frame(n, o, a, tip.p)


@dataclass(frozen=True)
class AnchorPlace(Bias):
    """The fixed point (anchor) of a draw-wire or distance meter is not where it was declared.

    An anchor without a declared place may be anywhere; its place is relative to the origin.
    """

    name = "anchor_place"
    title = "anchor placement"
    action = "Measure where the anchor stands and declare it."
    geometry = True
    sees = frozenset({"distance"})

    anchor: str = place(default="")
    x: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    y: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    z: float = parameter("m", "place of the anchor", 0.05, unknown=True)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"anchor": k} for k, v in arm.anchors.items() if v.xyz_m is None]

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """Return the tip less the anchor's displacement (m), in rows that measure to it."""
        mine = context.is_label("anchor", self.anchor)
        return spatial.sub(point, spatial.scale(mine, (self.x, self.y, self.z)))


@dataclass(frozen=True)
class SensorPlace(RigidMotion, Bias):
    """Pose of a further sensor's frame relative to that of the first sensor; it may be any pose."""

    name = "sensor_place"
    title = "sensor placement"
    action = "Fix the sensor's stand; calibrate after every move of it."
    geometry = True

    sensor: str = place(default="")
    x: float = parameter("m", "shift of the points that it sees", 0.05, unknown=True)
    y: float = parameter("m", "shift of the points that it sees", 0.05, unknown=True)
    z: float = parameter("m", "shift of the points that it sees", 0.05, unknown=True)
    rx: float = parameter("rad", "turn of the points that it sees", 0.05, unknown=True)
    ry: float = parameter("rad", "turn of the points that it sees", 0.05, unknown=True)
    rz: float = parameter("rad", "turn of the points that it sees", 0.05, unknown=True)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        mine = context.is_label("sensor", self.sensor)
        return exp_large(tuple(mine * t for t in self.twist)).transform(point)  # type: ignore[arg-type]


@dataclass(frozen=True)
class CameraPose(RigidMotion, Bias):
    """The camera's pose in the base frame differs from the declared one.

    Positions cannot distinguish it from `base_pose`; a calibration fits one of the two.
    """

    name = "camera_pose"
    title = "camera pose"
    action = "Fix the camera's mount; repeat the hand-eye calibration after every move of it."
    geometry = True

    x: float = parameter("m", "shift of the seen points", prior=0.05)
    y: float = parameter("m", "shift of the seen points", prior=0.05)
    z: float = parameter("m", "shift of the seen points", prior=0.05)
    rx: float = parameter("rad", "turn of the seen points", prior=0.05)
    ry: float = parameter("rad", "turn of the seen points", prior=0.05)
    rz: float = parameter("rad", "turn of the seen points", prior=0.05)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        return exp_large(self.twist).transform(point)
