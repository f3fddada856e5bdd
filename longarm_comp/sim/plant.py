"""The simulated plant: emulated servos move the true arm, two rendered cameras observe it.

It is commanded only through the servo bus and observed only through the cameras.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, Conditions, Light, Plate, expose, light
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import draw
from longarm_comp.sim.hidden.drives import Backlash, ServoDeadband, ServoDroop
from longarm_comp.sim.ringing import Ringing
from longarm_comp.sim.rods import QUICK_STEPS
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import EmulatedArm, EmulatedJoint
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
_OF_SERVOS = (ServoDroop, ServoDeadband)
_SAME = 1e-7  # rad or m: the arm has not moved
_MOUTH_M = 0.009
"""Radius of a socket's mouth, from which the ball slides in."""
_SEATED_M = 5e-5
"""Distance (m) from the bottom of a socket within which the ball touches all round."""


def hidden_effects(
    arm: Arm, sizes_mm: Mapping[str, float], rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Return hidden effects, each scaled to shift the tip by its size in mm rms.

    Args:
        sizes_mm: sizes by canonical name of the effect.
    """
    return tuple(draw(name, arm, rng, size_mm) for name, size_mm in sizes_mm.items())


@dataclass(frozen=True)
class PlantConfig:
    arm: Arm
    servos: EmulatedArm
    cameras: CameraPair
    """cameras, plate, plate_on_tip: cameras, marker and the marker's pose (4, 4) on the tip."""
    plate: Plate
    plate_on_tip: Array
    hidden: tuple[HiddenEffect, ...] = ()
    spec: MotorSpec = field(default_factory=MotorSpec)  # mechanics of the servos
    temperature_c: tuple[float, float] = (22.0, 0.0)
    """Temperature at the start, and its rise over hours (K)."""
    payload_kg: float = 0.0
    damping: float = 0.0  # share of critical damping that the arm rings with; 0: it does not
    sockets: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Places (m, base frame) of conical sockets by name."""


class Plant:
    """The running plant: `start` and `stop` it. Times are seconds since the start."""

    def __init__(
        self,
        config: PlantConfig,
        link: Path,
        rng: np.random.Generator,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if sorted(j.name for j in config.servos.joints) != sorted(config.arm.joint_names):
            names = ", ".join(j.name for j in config.servos.joints)
            raise InputError("plant", "servo joints", names, ", ".join(config.arm.joint_names))
        self.config = config
        loose = [e for e in config.hidden if isinstance(e, _OF_SERVOS)]
        self._behind = tuple(e for e in config.hidden if not isinstance(e, _OF_SERVOS))
        by_name = {j.name: j for j in config.servos.joints}
        self._servos = [by_name[name] for name in config.arm.joint_names]
        specs = {
            j.servo_id: _servo_spec(config.spec, j, loose, number)
            for number, j in enumerate(self._servos)
        }
        self._loads: Mapping[int, float] = {}
        self._loaded = [j for j in self._servos if j.told or loose]
        self.emulator = ServoEmulator(
            config.servos.protocol,
            config.servos.start_ticks(),
            specs,
            link=link,
            loads=lambda: self._loads,
            clock=clock,
        )
        self._rng = rng
        self._true = TrueArm(config.arm, self._behind, steps=QUICK_STEPS)
        self._last: tuple[Array, Array] | None = None
        self.payload_kg = config.payload_kg
        self._lit: tuple[Array, tuple[Light, Light]] | None = None
        self._ringing = Ringing(self._true, config.damping) if config.damping else None
        self._swing, self._swings = np.zeros(3), threading.Lock()

    def ring(self, t_s: float) -> None:
        """Continue the arm's vibration up to a time (s); call it often.

        It does nothing if the configuration has no damping.
        """
        if self._ringing is not None:
            with self._swings:
                self._swing = self._ringing.move_joints(t_s, self.joints())

    def wear(self, play: Mapping[str, float]) -> None:
        """Make the play of some joints larger by `play` (rad, m) than it was at the start.

        Raises InputError for a joint that is not known or a negative play.
        """
        names = self.config.arm.joint_names
        for joint, value in play.items():
            if joint not in names:
                raise InputError("plant", "more_play", joint, ", ".join(names))
            if not 0.0 <= value < np.inf:
                raise InputError("plant", f"more_play {joint}", value, "0 or more, rad or m")
        more = 0.5 * np.array([play.get(name, 0.0) for name in names])
        worn = [
            replace(effect, half=effect.half + more) if isinstance(effect, Backlash) else effect
            for effect in self._behind
        ]
        if more.any() and not any(isinstance(effect, Backlash) for effect in worn):
            worn.append(Backlash(more, gate=np.inf))
        self._true = TrueArm(self.config.arm, worn, steps=QUICK_STEPS)
        self._last = None

    def carry(self, kg: float) -> None:
        """Carry another mass (kg) at the tool from now on."""
        self.payload_kg, self._last = kg, None

    def start(self) -> None:
        """Power on: the bus answers from now on."""
        self.emulator.start()

    def stop(self) -> None:
        self.emulator.unplug()

    def joints(self) -> Array:
        """Return (n,) true joint positions, rad and m."""
        values = self.config.servos.values(self.emulator.positions())
        return np.array([values[name] for name in self.config.arm.joint_names])

    def _signed_upwards(self, of: Callable[[Motor], float]) -> Array:
        """Return a signed quantity of all servos (n,) with the signs of the joints' directions."""
        turned = self.emulator.each(of)
        return np.array([np.sign(j.travel) * turned[j.servo_id] for j in self._servos])

    def temperature_c(self, t_s: float) -> float:
        """Return the temperature of the arm at a time (s), degrees Celsius; it rises slowly."""
        start, rise = self.config.temperature_c
        return float(start - rise * np.expm1(-t_s / 5000.0))

    def tip_pose(self, t_s: float) -> Array:
        """Return the true pose of the tip (4, 4), base frame; published for evaluation only."""
        q, side = self.joints(), self._signed_upwards(lambda motor: motor.approach)
        wound = self._signed_upwards(lambda motor: motor.wound)
        ticks = self.emulator.each(lambda motor: motor.way)
        way = np.array([j.travel * ticks[j.servo_id] for j in self._servos])
        known = np.concatenate([q, side, wound, way, [self.temperature_c(t_s)]])
        if self._last is None or np.abs(known - self._last[0]).max() > _SAME:
            context = TrueContext(
                side, self.temperature_c(t_s), self.payload_kg, t_s, wound=wound, way=way
            )
            found = self._true.settle(q, context)
            self._last = known, found.pose[0]
            # Shared out to the servos, by id, in the sense of their ticks
            self._loads = {
                j.servo_id: math.copysign(1.0, j.travel) * torque / j.full_effort
                for j, torque in zip(self._servos, found.torques[0].tolist(), strict=True)
                if j in self._loaded
            }
        pose = self._last[1].copy()
        pose[:3, 3] += self._swing
        return pose

    def contact(self, t_s: float) -> str:
        """Return the name of the socket that the ball at the tip sits in, or blank.

        While all servos are off, a ball in the mouth of a socket slides to its bottom, within two
        or three calls; the joints move as little as possible. Driven servos hold the arm.
        """
        for name, place in self.config.sockets.items():
            away = np.asarray(place) - self.tip_pose(t_s)[:3, 3]
            if np.linalg.norm(away) <= _SEATED_M:
                return name
            if np.linalg.norm(away) <= _MOUTH_M and not any(self.emulator.torques_on().values()):
                self._slide_joints(away)
        return ""

    def _slide_joints(self, away: Array) -> None:
        """Push the joints by the smallest motion that moves the tip by `away` (3,), m."""
        q, step = self.joints(), 1e-5
        turned = q + step * np.eye(len(q))
        tips = self._true.settle(np.vstack([q, turned])).pose[:, :3, 3]
        given = np.linalg.pinv((tips[1:] - tips[0]).T / step) @ away
        for joint, value in zip(self._servos, (q + given).tolist(), strict=True):
            self.emulator.push(joint.servo_id, joint.ticks(value))

    def look(self, t_s: float) -> tuple[Grey, Grey]:
        """Take a left and a right image (H, W) now; of an arm at rest only the noise differs."""
        config = self.config
        plate = self.tip_pose(t_s) @ config.plate_on_tip
        if self._lit is None or not np.array_equal(plate, self._lit[0]):
            self._lit = plate, light(plate, config.plate, config.cameras, Conditions())
        left, right = (expose(each, Conditions(), self._rng) for each in self._lit[1])
        return left, right


def _servo_spec(
    spec: MotorSpec,
    joint: EmulatedJoint,
    effects: Sequence[ServoDroop | ServoDeadband],
    number: int,
) -> MotorSpec:
    """Return joint `number`'s servo by its data sheet, with droop and dead band of `effects`."""
    spec = replace(spec, **joint.sheet)
    tick = abs(joint.travel)
    for effect in effects:
        if isinstance(effect, ServoDroop):
            soft = effect.compliance[number] * joint.full_effort
            spec = replace(spec, droop_ticks=spec.droop_ticks + soft / tick)
        else:
            wide, held = effect.half[number] / tick, effect.gate / joint.full_effort
            spec = replace(spec, dead_band_ticks=spec.dead_band_ticks + wide, hold_share=held)
    return spec


def mount_plate(turn_rad: Sequence[float]) -> Array:
    """Return the pose (4, 4) on the tip of a plate centred there, rotated by a vector (3,), rad."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.asarray(turn_rad, dtype=float))[0]
    return matrix
