"""Many arms of a kind, and the mix of hidden effects that errs as the paper's arm did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm import Arm
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import camera, drives, geometry, loads
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.camera import CameraEffect
from longarm_comp.sim.hidden.catalogue import typical_context

Array = np.ndarray


def random_arm(rng: np.random.Generator, base: Arm) -> Arm:
    """An arm like `base`: lengths by row, sections, masses and stiffness vary.

    Lengths +-12 %, wall diameters +-4 %, masses +-20 %, stiffness +-20 % in common and +-8 %
    by beam; joints, limits and camera as in `base`.
    """
    data = base.model_dump(mode="json", exclude_none=True)
    stretch = rng.uniform(0.88, 1.12, len(base.joints))
    for joint, factor in zip(data["joints"], stretch, strict=True):
        for key in ("a_m", "d_m"):
            joint[key] *= factor
    softness = rng.uniform(0.8, 1.2)
    for beam in data["links"]:
        factor = stretch[beam["row"] - 1]
        for key in ("length_m", "body_length_m"):
            if isinstance(beam.get(key), float):
                beam[key] *= factor
        beam["mass_kg"] *= rng.uniform(0.8, 1.2)
        thick, own = rng.uniform(0.96, 1.04), rng.uniform(0.92, 1.08)
        for key in ("od_m", "id_m", "width_m", "height_m", "wall_m"):
            if key in beam.get("section", {}):
                beam["section"][key] *= thick
        for key in ("E_pa", "G_pa", "EI_nm2", "GJ_nm2"):
            if key in beam:
                beam[key] *= softness * own
    for mass in data["point_masses"]:
        mass["mass_kg"] *= rng.uniform(0.8, 1.2)
    data["name"] = f"{base.name}_like"
    return Arm.parse(data, "random arm")


@dataclass(frozen=True)
class Mix:
    """Hidden effects of both sides."""

    arm_side: tuple[HiddenEffect, ...]
    camera_side: tuple[CameraEffect, ...]


def paper_mix(
    rng: np.random.Generator, arm: Arm, *, deflection_only_mm: float = 15.4, mean_z_mm: float = 1.0
) -> Mix:
    """What a printed arm with hobby servos has, sized as in the paper's Table I.

    Pot gains, gear eccentricity, servo steps, backlash with a load gate, friction and telescope
    clearance, and some lens distortion.  One common dose makes the mean |z| that the declared
    sag leaves `deflection_only_mm` over random poses; the zero of the second turning joint
    makes the mean z `mean_z_mm` (the paper: 17.7 uncompensated, 15.39 deflection only).
    """
    turning = np.array([arm.joints[row - 1].type == "revolute" for row in arm.commanded])
    sliding = ~turning
    signs = rng.choice([-1.0, 1.0], arm.n)
    phase = rng.uniform(-np.pi, np.pi, (2, arm.n))
    gain = rng.uniform(0.03, 0.12, arm.n) * signs * turning
    second = turning * rng.uniform(5e-4, 1.5e-3, arm.n)
    graded: tuple[HiddenEffect, ...] = (
        drives.JointGain(gain),
        drives.PrismaticPitch(0.03 * signs * sliding),
        drives.GearEccentricity(np.stack([0 * second, second]), phase),
        drives.FrictionHysteresis(turning * rng.uniform(5e-3, 1.2e-2, arm.n)),
        drives.Backlash(turning * rng.uniform(6e-3, 1.2e-2, arm.n), gate=0.35),
    )
    fixed: tuple[HiddenEffect, ...] = (
        drives.ServoQuantisation(turning * (2 * np.pi / 1000)),
        loads.TelescopeClearance(3.5e-4),
    )
    poses = rng.uniform(arm.lower, arm.upper, (80, arm.n))
    context = typical_context(len(poses), arm, rng)
    declared = TrueArm(arm).tip(poses, context)
    lifter = np.eye(arm.n)[np.flatnonzero(turning)[min(1, turning.sum() - 1)]]
    dose, zero = 1.0, 0.0
    for _ in range(6):
        effects = (
            geometry.JointZero(zero * lifter),
            *(effect.scaled(dose) for effect in graded),
            *fixed,
        )
        z = 1e3 * (TrueArm(arm, effects).tip(poses, context) - declared)[:, 2]
        dose *= (deflection_only_mm / np.mean(np.abs(z))) ** 0.8
        zero -= 1e-3 * (np.mean(z) - mean_z_mm) / _lift(arm, lifter, poses)
    return Mix(effects, (camera.CameraRadial(rng.uniform(0.03, 0.06)),))


def _lift(arm: Arm, joint: Array, poses: Array) -> float:
    """Mean rise of the tip per radian of a joint, m."""
    step = 1e-3 * joint
    true = TrueArm(arm)
    return float(np.mean((true.tip(poses + step) - true.tip(poses - step))[:, 2])) / 2e-3
