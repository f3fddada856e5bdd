"""Where a further sensor stands, where several measured one arm."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Vec, parameter, place


@dataclass(frozen=True)
class SensorPlace(Bias):
    """A further sensor reports in a frame of its own, anywhere against that of the first one."""

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
        twist = (self.x, self.y, self.z, self.rx, self.ry, self.rz)
        return spatial.exp_large(tuple(mine * t for t in twist)).transform(point)  # type: ignore[arg-type]
