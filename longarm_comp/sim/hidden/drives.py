"""Hidden effects between the command and the joint: gears, encoders, servos, cables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.sim.context import Array, State
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.loads import JointCompliance


@dataclass(frozen=True)
class JointGain(HiddenEffect):
    """Encoder or pot scale of the turning joints: the shaft turns (1 + gain) q; gain (n,)."""

    gain: Array

    def joints(self, q: Array, state: State) -> Array:
        return q * (1 + self.gain)


@dataclass(frozen=True)
class PrismaticPitch(JointGain):
    """Screw pitch of the sliding joints: they travel (1 + gain) q; gain (n,)."""


@dataclass(frozen=True)
class JointCoupling(HiddenEffect):
    """A rod past one joint to the next: joint k turns by factor[k] q[k - 1] more; factor (n,)."""

    factor: Array

    def joints(self, q: Array, state: State) -> Array:
        return q + self.factor * np.roll(q, 1, axis=-1)


@dataclass(frozen=True)
class GearEccentricity(HiddenEffect):
    """Gears off centre: q + sum over orders k of amplitude_k sin(k q + phase_k); (2, n), rad."""

    amplitude: Array
    phase: Array

    def joints(self, q: Array, state: State) -> Array:
        return q + sum(
            a * np.sin(k * q + p)
            for k, (a, p) in enumerate(zip(self.amplitude, self.phase, strict=True), 1)
        )


STEPS_PER_TURN = (180, 256, 300, 360, 512, 720, 1000, 1024, 2048, 4096, 16384)
"""Encoder steps per turn of servos on the market."""


@dataclass(frozen=True)
class ServoQuantisation(HiddenEffect):
    """Servos take whole steps: a command is rounded to `step` (n,), rad or m; 0: not rounded."""

    of_command = True
    step: Array

    def scale_by(self, dose: float) -> ServoQuantisation:
        """Return steps about `dose` times as large, of servos that exist (`STEPS_PER_TURN`)."""
        if dose == 0.0:
            return ServoQuantisation(0 * self.step)
        sold = 2 * np.pi / np.array(STEPS_PER_TURN)
        wanted = np.where(self.step > 0, dose * self.step, sold[0])
        nearest = sold[np.argmin(np.abs(np.log(wanted[:, None] / sold)), axis=1)]
        return ServoQuantisation(np.where(self.step > 0, nearest, 0.0))

    def joints(self, q: Array, state: State) -> Array:
        step = np.where(self.step > 0, self.step, 1.0)
        return np.where(self.step > 0, np.round(q / step) * step, q)

    def before(self, torques: Array, state: State) -> Array:
        return self.joints(state.q, state) - state.q


@dataclass(frozen=True)
class FrictionHysteresis(HiddenEffect):
    """Friction: a joint stops `lag` (n,), rad or m, before it reaches its command."""

    lag: Array

    def joints(self, q: Array, state: State) -> Array:
        return q - self.lag * state.approach

    def before(self, torques: Array, state: State) -> Array:
        return -self.lag * state.approach


@dataclass(frozen=True)
class FrictionMemory(HiddenEffect):
    """A gear train that winds up: the joint lags by up to `lag` (n,) behind its motion, rad or m.

    After a reversal it unwinds only over a long motion. So after a short last motion the lag still
    depends on the motion before.
    """

    lag: Array

    def joints(self, q: Array, state: State) -> Array:
        return q - self.lag * state.wound


@dataclass(frozen=True)
class ServoLag(HiddenEffect):
    """Measurements before the servos arrive: the share `left` (n,) of a motion is missing."""

    left: Array

    def joints(self, q: Array, state: State) -> Array:
        return q + self.before(q, state)

    def before(self, torques: Array, state: State) -> Array:
        start = state.q - state.way
        return start + (1.0 - self.left) * state.way - state.q


@dataclass(frozen=True)
class _Resting(HiddenEffect):
    """A joint at one end of a free motion: by its load where |torque| > gate, else by its side."""

    gated = True
    half: Array  # half of the way from side to side, (n,), rad or m
    gate: float  # torque or force above which the weight decides, N m or N

    def find_rest(self, torques: Array, state: State) -> Array | float:
        loaded = np.abs(torques) > self.gate
        return self.half * np.where(loaded, np.sign(torques), -state.approach)


@dataclass(frozen=True)
class Backlash(_Resting):
    """Play of `half` to either side: the load, or else the approach, decides on which it rests."""


@dataclass(frozen=True)
class ServoDeadband(_Resting):
    """A servo rests at the edge of its deadband, which its encoder sees."""

    def before(self, torques: Array, state: State) -> Array | float:
        return self.find_rest(torques, state)


@dataclass(frozen=True)
class ServoDroop(JointCompliance):
    """A proportional servo yields by torque / gain: `compliance` is 1 / gain; slides do not."""

    def before(self, torques: Array, state: State) -> Array:
        return ~state.arm.slides * self.compliance * torques


@dataclass(frozen=True)
class CoggingBump(HiddenEffect):
    """A joint is off by up to `height` (rad) near one angle. No library has this effect."""

    doses = ("height",)
    joint: int
    centre: float
    width: float
    height: float

    def joints(self, q: Array, state: State) -> Array:
        q = q.copy()
        at = (q[:, self.joint] - self.centre) / self.width
        q[:, self.joint] += self.height * np.exp(-0.5 * at**2)
        return q


@dataclass(frozen=True)
class CableDrag(HiddenEffect):
    """A cable pulls `joint` round as two others wind it up together. No library has this effect.

    The pull is `pull` (rad) times the product of both joints' places in their ranges, -1 to 1.
    """

    doses = ("pull",)
    joint: int
    wound_by: tuple[int, int]
    pull: float

    def joints(self, q: Array, state: State) -> Array:
        arm = state.arm
        place = 2 * (state.q - arm.mid) / (arm.upper - arm.lower)
        q = q.copy()
        q[:, self.joint] += self.pull * place[:, self.wound_by[0]] * place[:, self.wound_by[1]]
        return q
