"""Hidden geometry errors."""

from dataclasses import dataclass

from longarm_comp.sim.context import Array, State
from longarm_comp.sim.hidden.base import THETA, A, D, HiddenEffect
from longarm_comp.sim.rods import rpy_matrix


@dataclass(frozen=True)
class JointZero(HiddenEffect):
    """Zeros off by `offset` (n,), rad or m."""

    offset: Array

    def joints(self, q: Array, state: State) -> Array:
        return q + self.offset


@dataclass(frozen=True)
class DhError(HiddenEffect):
    """Rows off by `delta` (4, R): alpha, a, theta, d in rad and m."""

    delta: Array

    def rows(self, rows: Array, state: State) -> Array:
        return rows + self.delta[:, :, None]


@dataclass(frozen=True)
class BasePose(HiddenEffect):
    """Placement error `delta` (6,) of the foot: x, y, z, roll, pitch, yaw in m and rad."""

    delta: Array

    def base(self, pose: Array) -> Array:
        return pose + self.delta


@dataclass(frozen=True)
class GravityDirection(HiddenEffect):
    """Gravity tilted by `tilt` (2,), rad about x, then y of the base frame."""

    tilt: Array

    def gravity(self, gravity: Array) -> Array:
        return rpy_matrix([*self.tilt, 0.0]) @ gravity


@dataclass(frozen=True)
class ThermalGrowth(HiddenEffect):
    """All printed lengths grow by `rate` (1/K) from the declared reference temperature."""

    rate: float

    def rows(self, rows: Array, state: State) -> Array:
        growth = 1 + self.rate * (state.temperature_c - state.arm.reference_temperature_c)
        rows = rows.copy()
        rows[[A, D]] *= growth
        return rows


@dataclass(frozen=True)
class LooseScrew(HiddenEffect):
    """A jump of row `row` by `jump` (rad) beyond an angle of a joint; it is not in the library."""

    doses = ("jump",)
    row: int
    joint: int
    threshold: float
    jump: float

    def rows(self, rows: Array, state: State) -> Array:
        rows = rows.copy()
        rows[THETA, self.row - 1] += self.jump * (state.q[:, self.joint] > self.threshold)
        return rows
