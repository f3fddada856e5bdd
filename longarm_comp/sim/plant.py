"""The simulated workshop: emulated servos move the true arm, two rendered cameras look at it.

Nobody but the servo bus can command it, and nobody but the cameras can see it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, Conditions, Plate, render
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import draw
from longarm_comp.sim.servo_emulator import EmulatedArm, MotorSpec, ServoEmulator

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
_STEPS = 2  # integration steps a rod: good to a nanometre here
_SAME = 1e-7  # rad or m: the arm has not moved


def hidden_effects(
    arm: Arm, sizes_mm: Mapping[str, float], rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Effects by canonical name, each shifting the tip by so many mm rms.

    Raises:
        InputError: no such effect, or one of the camera side.
    """
    made = []
    for name, size_mm in sizes_mm.items():
        effect = draw(name, arm, rng, size_mm)
        if not isinstance(effect, HiddenEffect):
            raise InputError("workshop", "hidden", name, "an effect of the arm's side")
        made.append(effect)
    return tuple(made)


@dataclass(frozen=True)
class Room:
    """What stands in the workshop.

    Attributes:
        arm: as declared.
        servos: the servos that drive it.
        hidden: what nobody declared.
        cameras, plate, plate_on_tip: the eyes, the marker and its place (4, 4) on the tip.
        spec: mechanics of the servos.
        temperature_c: at the start, and its rise over hours (K).
        payload_kg: what it carries.
    """

    arm: Arm
    servos: EmulatedArm
    cameras: CameraPair
    plate: Plate
    plate_on_tip: Array
    hidden: tuple[HiddenEffect, ...] = ()
    spec: MotorSpec = field(default_factory=MotorSpec)
    conditions: Conditions = field(default_factory=Conditions)
    temperature_c: tuple[float, float] = (22.0, 0.0)
    payload_kg: float = 0.0


class Workshop:
    """The room in motion. `start` and `stop` it; time is seconds since the start, handed in."""

    def __init__(self, room: Room, link: Path, rng: np.random.Generator) -> None:
        if sorted(j.name for j in room.servos.joints) != sorted(room.arm.joint_names):
            names = ", ".join(j.name for j in room.servos.joints)
            raise InputError("workshop", "servo joints", names, ", ".join(room.arm.joint_names))
        self.room = room
        self.emulator = ServoEmulator(
            room.servos.protocol, room.servos.start_ticks(), room.spec, link=link
        )
        self._rng = rng
        self._true = TrueArm(room.arm, room.hidden, steps=_STEPS)
        self._last: tuple[Array, Array] | None = None

    def start(self) -> None:
        """Power on: the bus answers from now on."""
        self.emulator.start()

    def stop(self) -> None:
        """Power off."""
        self.emulator.stop()

    def joints(self) -> Array:
        """(n,) where the joints really stand (rad, m)."""
        values = self.room.servos.values(self.emulator.positions())
        return np.array([values[name] for name in self.room.arm.joint_names])

    def side(self) -> Array:
        """(n,) of -1, 0, +1: the side that each joint arrived from."""
        return self._upwards(self.emulator.approaches())

    def wound(self) -> Array:
        """(n,) of -1 to +1: how far each joint's gear train is wound up."""
        return self._upwards(self.emulator.windings())

    def _upwards(self, turned: Mapping[int, float]) -> Array:
        """(n,) of what is positive where a servo's ticks grow, positive where its joint does."""
        made = {j.name: np.sign(j.travel) * turned[j.servo_id] for j in self.room.servos.joints}
        return np.array([made[name] for name in self.room.arm.joint_names])

    def temperature_c(self, t_s: float) -> float:
        """The room warms up slowly."""
        start, rise = self.room.temperature_c
        return float(start - rise * np.expm1(-t_s / 5000.0))

    def tip_pose(self, t_s: float) -> Array:
        """(4, 4) true tip in the base frame: what nobody is told."""
        q, side, wound = self.joints(), self.side(), self.wound()
        known = np.concatenate([q, side, wound, [self.temperature_c(t_s)]])
        if self._last is None or np.abs(known - self._last[0]).max() > _SAME:
            context = TrueContext(side, self.temperature_c(t_s), self.room.payload_kg, t_s, wound)
            self._last = known, self._true.pose(q, context)
        return self._last[1]

    def look(self, t_s: float) -> tuple[Grey, Grey]:
        """The left and the right image of this moment."""
        room = self.room
        plate = self.tip_pose(t_s) @ room.plate_on_tip
        return render(plate, room.plate, room.cameras, self._rng, room.conditions)


def mounting(turn_rad: Sequence[float]) -> Array:
    """(4, 4) of a plate whose centre is the tip, turned by a rotation vector (rad) against it."""
    made = np.eye(4)
    made[:3, :3] = cv2.Rodrigues(np.asarray(turn_rad, dtype=float))[0]
    return made
