"""Hidden effects by canonical name, at a typical size or scaled to a given one."""

from collections.abc import Callable
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import Array, TrueContext
from longarm_comp.sim.hidden import drives, geometry, loads
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.rods import QUICK_STEPS

_Maker = Callable[[Arm, np.random.Generator], HiddenEffect]


def _draw_turning(arm: Arm, rng: np.random.Generator, low: float, high: float) -> Array:
    """Return a random number from `low` to `high` per turning joint, 0 for sliding ones, (n,)."""
    return ~arm.slides * rng.uniform(low, high, arm.n)


def _draw_signs(rng: np.random.Generator, size: int) -> Array:
    return rng.choice([-1.0, 1.0], size)


def _draw_dh_error(arm: Arm, rng: np.random.Generator) -> HiddenEffect:
    sd = np.array([[3e-3], [1e-3], [0.0], [1e-3]])  # theta is the joint zero
    delta = sd * rng.standard_normal((4, len(arm.joints)))
    delta[:, [j.type == "fixed" and j.pose is not None for j in arm.joints]] = 0.0
    return geometry.DhError(delta)


def _draw_loose_screw(arm: Arm, rng: np.random.Generator) -> HiddenEffect:
    joint = int(rng.choice(np.flatnonzero(~arm.slides)))
    at = rng.uniform(0.35, 0.65)
    threshold = arm.lower[joint] + at * (arm.upper[joint] - arm.lower[joint])
    jump = float(rng.choice([-8e-3, 8e-3]))
    return geometry.LooseScrew(arm.commanded[joint], joint, threshold, jump)


def _draw_cogging(arm: Arm, rng: np.random.Generator) -> HiddenEffect:
    joint = int(rng.choice(np.flatnonzero(~arm.slides)))
    span = arm.upper[joint] - arm.lower[joint]
    centre = arm.lower[joint] + rng.uniform(0.3, 0.7) * span
    return drives.CoggingBump(joint, centre, 0.12 * span, float(rng.choice([-1e-2, 1e-2])))


def _draw_cable(arm: Arm, rng: np.random.Generator) -> HiddenEffect:
    joint, one, two = rng.permutation(np.flatnonzero(~arm.slides))[:3]
    return drives.CableDrag(int(joint), (int(one), int(two)), float(rng.choice([-1e-2, 1e-2])))


def _draw_link_stiffness(arm: Arm, rng: np.random.Generator) -> HiddenEffect:
    common = rng.uniform(0.15, 0.35)
    return loads.LinkStiffness({b.name: common * rng.uniform(0.7, 1.3) for b in arm.links})


HIDDEN: dict[str, _Maker] = {
    "joint_zero": lambda arm, rng: geometry.JointZero(
        np.where(arm.slides, 1e-3, 4e-3) * rng.standard_normal(arm.n)
    ),
    "dh_error": _draw_dh_error,
    "base_pose": lambda arm, rng: geometry.BasePose(
        rng.standard_normal(6) * ([2e-3] * 3 + [4e-3] * 3)
    ),
    "gravity_direction": lambda arm, rng: geometry.GravityDirection(0.05 * _draw_signs(rng, 2)),
    "thermal_growth": lambda arm, rng: geometry.ThermalGrowth(rng.uniform(7e-5, 1.2e-4)),
    "thermal_softening": lambda arm, rng: loads.ThermalSoftening(rng.uniform(5e-3, 2e-2)),
    "joint_gain": lambda arm, rng: drives.JointGain(
        _draw_turning(arm, rng, 0.01, 0.03) * _draw_signs(rng, arm.n)
    ),
    "joint_coupling": lambda arm, rng: drives.JointCoupling(
        (~arm.slides & np.r_[False, ~arm.slides[:-1]])
        * rng.uniform(0.005, 0.02, arm.n)
        * _draw_signs(rng, arm.n)
    ),
    "prismatic_pitch": lambda arm, rng: drives.PrismaticPitch(
        arm.slides * rng.uniform(0.02, 0.05, arm.n) * _draw_signs(rng, arm.n)
    ),
    "gear_eccentricity": lambda arm, rng: drives.GearEccentricity(
        np.stack([_draw_turning(arm, rng, 4e-3, 1e-2), _draw_turning(arm, rng, 1e-3, 4e-3)]),
        rng.uniform(-np.pi, np.pi, (2, arm.n)),
    ),
    "servo_quantisation": lambda arm, rng: drives.ServoQuantisation(2 * np.pi / 1000 * ~arm.slides),
    "servo_droop": lambda arm, rng: drives.ServoDroop(_draw_turning(arm, rng, 1e-3, 4e-3)),
    "servo_deadband": lambda arm, rng: drives.ServoDeadband(
        _draw_turning(arm, rng, 1e-3, 3e-3), gate=0.1
    ),
    "backlash": lambda arm, rng: drives.Backlash(
        _draw_turning(arm, rng, 3e-3, 8e-3), gate=rng.uniform(0.25, 0.45)
    ),
    "friction_hysteresis": lambda arm, rng: drives.FrictionHysteresis(
        _draw_turning(arm, rng, 2e-3, 6e-3)
    ),
    "friction_memory": lambda arm, rng: drives.FrictionMemory(_draw_turning(arm, rng, 1e-3, 3e-3)),
    "servo_lag": lambda arm, rng: drives.ServoLag(rng.uniform(1e-3, 5e-3, arm.n)),
    "joint_compliance": lambda arm, rng: loads.JointCompliance(_draw_turning(arm, rng, 1e-3, 5e-3)),
    "bearing_tilt": lambda arm, rng: loads.BearingTilt(_draw_turning(arm, rng, 5e-4, 2e-3)),
    "base_compliance": lambda arm, rng: loads.BaseCompliance(rng.uniform(5e-4, 1.5e-3, 2)),
    "base_settling": lambda arm, rng: loads.BaseSettling(
        -rng.uniform(5e-4, 1.5e-3), rng.uniform(1e-3, 3e-3, 2) * _draw_signs(rng, 2)
    ),
    "telescope_clearance": lambda arm, rng: loads.TelescopeClearance(
        rng.uniform(3e-4, 8e-4), pads=rng.uniform(2e-6, 1e-5)
    ),
    "link_stiffness": _draw_link_stiffness,
    "creep": lambda arm, rng: loads.Creep(rng.uniform(0.1, 0.3), rng.uniform(1500, 6000)),
    "tip_payload": lambda arm, rng: loads.TipPayload(rng.uniform(0.05, 0.15)),
    "link_mass": lambda arm, rng: loads.LinkMass(
        int(rng.choice([row.id for row in arm.joints][2:-1])), rng.uniform(0.1, 0.3)
    ),
    "measured_tilt": lambda arm, rng: loads.MeasuredTilt(
        0, rng.uniform(1e-3, 3e-3, 2), rng.uniform(1500, 4000), rng.uniform(-3e-3, 3e-3, 2)
    ),
    "cogging_bump": _draw_cogging,
    "cable_drag": _draw_cable,
    "loose_screw": _draw_loose_screw,
}
OUTSIDE_EVERY_LIBRARY = ("cogging_bump", "cable_drag", "loose_screw")


def hidden(name: str, arm: Arm, dose: float, rng: np.random.Generator) -> HiddenEffect:
    """Return an effect by name, `dose` times its typical size, at a random place.

    Raises InputError if the name is not known, or the arm has too few joints for it.
    """
    if name not in HIDDEN:
        raise InputError("hidden effect", "name", name, ", ".join(HIDDEN))
    try:
        return HIDDEN[name](arm, rng).scale_by(dose)
    except ValueError as error:  # no place left to choose from
        raise _no_motion(name) from error


def _no_motion(name: str) -> InputError:
    return InputError("hidden effect", "name", name, "an effect that moves this arm")


def draw(name: str, arm: Arm, rng: np.random.Generator, size_mm: float) -> HiddenEffect:
    """Return an effect by name, scaled so that it shifts the tip by about `size_mm` rms.

    Servo steps exist only in a few sizes, so the nearest of them is taken.
    """
    return scale_to_size(hidden(name, arm, 1.0, rng), arm, rng, size_mm)


def moved_tip(
    effect: HiddenEffect, arm: Arm, poses: Array, context: TrueContext, sound: Array
) -> Array:
    """Return the tip (N, 3), m, with one effect.

    Args:
        sound: (N, 3) m, the tip without it. This function does not need it; another one given to
            `scale_to_size` as ``seen`` may.
    """
    return TrueArm(arm, [effect], steps=QUICK_STEPS).tip(poses, context)


def scale_to_size(
    effect: Any,
    arm: Arm,
    rng: np.random.Generator,
    size_mm: float,
    poses: Array | None = None,
    seen: Callable[..., Array] = moved_tip,
) -> Any:
    """Scale an effect so that the seen tip shifts by about `size_mm` rms.

    Args:
        poses: (N, n) joints, rad and m; 60 random ones by default.
        seen: returns the seen tip (N, 3), m, with an effect; it is called like `moved_tip`.

    Raises:
        InputError: the effect does not move this arm.
    """
    poses = rng.uniform(arm.lower, arm.upper, (60, arm.n)) if poses is None else poses
    context = typical_context(len(poses), arm, rng)
    sound = TrueArm(arm, steps=QUICK_STEPS).tip(poses, context)
    dose = 1.0
    for _ in range(8):
        moved = seen(effect.scale_by(dose), arm, poses, context, sound) - sound
        size = 1e3 * float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
        if size == 0.0:
            raise _no_motion(effect.name)
        if abs(size - size_mm) < 0.02 * size_mm:
            break
        dose *= size_mm / size
    return effect.scale_by(dose)


def typical_context(postures: int, arm: Arm, rng: np.random.Generator) -> TrueContext:
    """Return random circumstances of some postures: within two hours, up to 12 K warmer.

    Approach, winding of the gears and the last motion are random too.
    """
    return TrueContext(
        approach=np.repeat(_draw_signs(rng, postures)[:, None], arm.n, axis=1),
        temperature_c=arm.reference_temperature_c + rng.uniform(0, 12, postures),
        t_s=rng.uniform(0, 7200, postures),
        wound=rng.spawn(1)[0].uniform(-1.0, 1.0, (postures, arm.n)),
        way=rng.spawn(1)[0].uniform(-0.5, 0.5, (postures, arm.n)) * (arm.upper - arm.lower),
    )
