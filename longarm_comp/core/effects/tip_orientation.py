"""How the measured body's axes stand against those of the tip."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Frame, Sites, Vec, parameter, place
from longarm_comp.core.effects.sites import markers


@dataclass(frozen=True)
class TipOrientation(Bias):
    """The axes of a tracked body (of one marker, to one sensor) are turned against the tip's.

    A tracker gives its bodies axes of their own, so the prior leaves any turn free.
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
