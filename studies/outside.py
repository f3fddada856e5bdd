"""Causes that are in no library of effects, to test what finds effects without a name.

Sizes are for the demonstration's arm. Their physics is their own: forces on the bent rods, servo
errors from the settled torques, seats, stops, recorded drivers, a window before the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.sim.context import State
from longarm_comp.sim.hidden.base import HiddenEffect, Place
from longarm_comp.sim.rods import Walker, rpy_matrix
from studies.true_camera import CameraEffect

Array = np.ndarray


@dataclass(frozen=True)
class HosePull(HiddenEffect):
    """A hose pulls sideways at joint `row` with a force that grows with two joints' product.

    Attributes:
        row: where it is clamped; the force is along y of the link there.
        first, second: commanded joints (0-based).
        pull: N/rad^2.
    """

    name: ClassVar[str] = "hose_pull"
    doses: ClassVar[tuple[str, ...]] = ("pull",)
    row: int
    first: int
    second: int
    pull: float

    def push(self, place: Place, state: State) -> Sequence[tuple[Array, Array]]:
        if place.kind != "bearing" or place.row != self.row:
            return ()
        force = self.pull * state.q[:, self.first] * state.q[:, self.second]
        return ((np.stack([0 * force, force, 0 * force]), np.zeros(3)),)


@dataclass(frozen=True)
class CableBundle(HiddenEffect):
    """A cable bundle is stretched like a spring between a point of one link and one of another.

    Attributes:
        links: rows of the two; at: (2, 3) m, its ends in their axes.
        stiffness: N/m.
        slack_m: length below which it hangs loose.
    """

    name: ClassVar[str] = "cable_bundle"
    doses: ClassVar[tuple[str, ...]] = ("stiffness",)
    links: tuple[int, int]
    at: Array
    stiffness: float
    slack_m: float

    def push(self, place: Place, state: State) -> Sequence[tuple[Array, Array]]:
        if place.kind != "bearing" or place.row not in self.links:
            return ()
        poses = [_bearing(state, row) for row in self.links]
        ends = [pose[:, :3, 3] + pose[:, :3, :3] @ at for pose, at in zip(poses, self.at)]  # noqa: B905
        mine = self.links.index(place.row)
        way = ends[1 - mine] - ends[mine]
        length = np.linalg.norm(way, axis=1)
        tension = self.stiffness * np.maximum(length - self.slack_m, 0.0)
        force = (tension / length)[:, None] * way
        here = np.einsum("nji,nj->in", poses[mine][:, :3, :3], force)
        return ((here, self.at[mine]),)


def _bearing(state: State, row: int) -> Array:
    """Pose (N, 4, 4) of the rigid arm's link at a bearing, in the base's axes."""
    arm = state.arm
    mixing, offset = arm.mixing
    value = state.q @ mixing.T + offset
    pose = np.broadcast_to(np.eye(4), (len(value), 4, 4)).copy()
    for k, joint in enumerate(arm.joints[:row]):
        sliding = joint.type == "prismatic"
        theta = np.radians(joint.theta_offset_deg) + (0 if sliding else value[:, k])
        before = np.eye(4)
        before[:3, :3] = rpy_matrix((np.radians(joint.alpha_deg), 0.0, 0.0))
        before[:3, 3] = before[:3, :3] @ (joint.a_m, 0.0, 0.0)
        turn = np.broadcast_to(np.eye(4), pose.shape).copy()
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(theta)
        turn[:, 1, 0] = np.sin(theta)
        turn[:, 0, 1] = -turn[:, 1, 0]
        pose = pose @ before @ turn
        if k + 1 < row:
            along = np.broadcast_to(np.eye(4), pose.shape).copy()
            along[:, 2, 3] = joint.d_m + (value[:, k] if sliding else 0.0)
            pose = pose @ along
    return pose


@dataclass(frozen=True)
class SupplySag(HiddenEffect):
    """The common supply sags with the sum of the torques, so every servo gives more.

    Attributes:
        sag: rad/(N m)^2: a turning joint gives this times its torque times the sum of all.
    """

    name: ClassVar[str] = "supply_sag"
    doses: ClassVar[tuple[str, ...]] = ("sag",)
    gated: ClassVar[bool] = True
    sag: float

    def find_rest(self, torques: Array, state: State) -> Array:
        turning = ~state.arm.slides
        drawn = np.abs(torques * turning).sum(axis=1, keepdims=True)
        return self.sag * torques * turning * drawn


@dataclass(frozen=True)
class TwoSeats(HiddenEffect):
    """A bracket rests on one of two seats and flips with the moment on it.

    Attributes:
        row: what it carries. axis: it turns about, 0 or 1.
        angle: rad to either side. flips_at: moment about the axis, N m.
    """

    name: ClassVar[str] = "two_seats"
    doses: ClassVar[tuple[str, ...]] = ("angle",)
    row: int
    axis: int
    angle: float
    flips_at: float

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "bearing" or place.row != self.row:
            return None
        turn = np.zeros_like(beyond.moment)
        side = np.tanh((beyond.moment[self.axis] - self.flips_at) / 4e-3)
        turn[self.axis] = self.angle * side
        return turn


@dataclass(frozen=True)
class RubberStop(HiddenEffect):
    """A joint runs onto a rubber stop before its limit and is held back.

    Attributes:
        joint: commanded, 0-based. begins: rad. holds: share of what is beyond that is lost.
    """

    name: ClassVar[str] = "rubber_stop"
    doses: ClassVar[tuple[str, ...]] = ("holds",)
    joint: int
    begins: float
    holds: float

    def joints(self, q: Array, state: State) -> Array:
        moved = q.copy()
        moved[:, self.joint] -= self.holds * np.maximum(q[:, self.joint] - self.begins, 0.0)
        return moved


@dataclass(frozen=True)
class WarmBoom(HiddenEffect):
    """A boom that is warm on one side bows the more the farther it is out.

    Attributes:
        row: of the slide. bow: rad/(K m) about x at its end, per its travel.
    """

    name: ClassVar[str] = "warm_boom"
    doses: ClassVar[tuple[str, ...]] = ("bow",)
    row: int
    bow: float

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "frame" or place.row != self.row:
            return None
        turn = np.zeros_like(beyond.moment)
        warm = state.temperature_c - state.arm.reference_temperature_c
        travel = state.q[:, state.arm.commanded.index(self.row)]
        turn[0] = self.bow * warm * travel
        return turn


@dataclass(frozen=True)
class PumpShake(HiddenEffect):
    """The carrier sways to one side with the pressure of a pump, which is recorded.

    Attributes:
        sway: m. waves: rad per bar.
    """

    name: ClassVar[str] = "pump_shake"
    doses: ClassVar[tuple[str, ...]] = ("sway",)
    sway: float
    waves: float

    def readings(self, state: State) -> dict[str, Array]:
        return {"pump_bar": 1.5 + 0.8 * np.sin(state.t_s / 97.0) + 0.2 * np.cos(state.t_s / 31.0)}

    def foot(self, state: State) -> Array:
        moved = self.sway * np.sin(self.waves * self.readings(state)["pump_bar"])
        return np.stack([moved, 0 * moved, 0 * moved])


@dataclass(frozen=True)
class WindowGlass(CameraEffect):
    """A curved window before the camera displaces what is seen across, with the square of x.

    Attributes:
        bend: 1/m.
    """

    name: ClassVar[str] = "window_glass"
    doses: ClassVar[tuple[str, ...]] = ("bend",)
    bend: float

    def seen(self, points: Array, t_s: Array) -> Array:
        moved = points.copy()
        moved[:, 1] += self.bend * points[:, 0] ** 2
        return moved


def outside(arm: Arm) -> dict[str, HiddenEffect | CameraEffect]:
    """Return one of each for the demonstration's arm, moving its tip by about 1 to 3 mm."""
    return {
        "hose_pull": HosePull(row=5, first=1, second=4, pull=24.0),
        "supply_sag": SupplySag(sag=2.5e-4),
        "two_seats": TwoSeats(row=7, axis=1, angle=4e-3, flips_at=-0.6),
        "cable_bundle": CableBundle(
            links=(2, 5),
            at=np.array([[0.02, -0.05, 0.06], [0.03, 0.02, 0.05]]),
            stiffness=300.0,
            slack_m=0.5,
        ),
        "rubber_stop": RubberStop(joint=4, begins=-0.25, holds=0.04),
        "warm_boom": WarmBoom(row=3, bow=8e-3),
        "pump_shake": PumpShake(sway=2e-3, waves=6.0),
        "window_glass": WindowGlass(bend=0.02),
    }
