"""Random variants of an arm, and a mix of hidden effects with the paper's error sizes."""

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import drives, geometry, loads
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import typical_context
from studies import true_camera as camera
from studies.true_camera import Hidden, TrueCamera

Array = np.ndarray
_STEPS = 2  # sizes need no nanometres


def random_arm(rng: np.random.Generator, base: Arm) -> Arm:
    """Return an arm like `base`: lengths by row, sections, masses and stiffness vary.

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


def paper_mix(
    rng: np.random.Generator, arm: Arm, *, deflection_only_mm: float = 15.4, mean_z_mm: float = 1.0
) -> tuple[Hidden, ...]:
    """Return typical effects of a printed arm with hobby servos, sized as in the paper's Table I.

    Pot gains, gear eccentricity, servo steps, backlash with a load gate, friction and telescope
    clearance, and some lens distortion; joints that lift err most.  One common dose makes the
    mean |z| that the declared sag leaves `deflection_only_mm` over random poses; the zero of
    the joint that lifts most makes the mean z `mean_z_mm` (the paper: 17.7 uncompensated, 15.39
    deflection only).
    """
    turning = ~arm.slides
    poses = rng.uniform(arm.lower, arm.upper, (120, arm.n))
    context = typical_context(len(poses), arm, rng)
    moves = _moves(arm, poses)
    lifting = np.abs(moves[..., 2]).mean(axis=1) / np.linalg.norm(moves, axis=2).mean(axis=1)
    signs = rng.choice([-1.0, 1.0], arm.n)
    phase = rng.uniform(-np.pi, np.pi, (2, arm.n))
    gain = rng.uniform(0.04, 0.12, arm.n) * signs * turning * (0.35 + 0.65 * lifting)
    play = turning * (0.5 + 0.5 * lifting)
    second = turning * rng.uniform(5e-4, 1.5e-3, arm.n)
    graded: tuple[HiddenEffect, ...] = (
        drives.JointGain(gain),
        drives.PrismaticPitch(0.03 * signs * arm.slides),
        drives.GearEccentricity(np.stack([0 * second, second]), phase),
        drives.FrictionHysteresis(play * rng.uniform(3e-3, 7e-3, arm.n)),
        drives.Backlash(play * rng.uniform(5e-3, 1e-2, arm.n), gate=0.35),
    )
    fixed: tuple[HiddenEffect, ...] = (
        drives.ServoQuantisation(turning * (2 * np.pi / 1000)),
        loads.TelescopeClearance(3.5e-4),
    )
    lens = (camera.CameraRadial(rng.uniform(0.03, 0.06)),)
    head = TrueCamera.of(arm, lens)
    declared = TrueArm(arm, steps=_STEPS).tip(poses, context)
    highest = int(np.argmax(turning * np.abs(moves[..., 2].mean(axis=1))))
    lifter, rise = np.eye(arm.n)[highest], moves[highest, :, 2].mean()
    dose, zero = 1.0, 0.0
    for _ in range(10):
        effects = (
            geometry.JointZero(zero * lifter),
            *(effect.scale_by(dose) for effect in graded),
            *fixed,
        )
        z = (
            1e3
            * (head.seen(TrueArm(arm, effects, steps=_STEPS).tip(poses, context)) - declared)[:, 2]
        )
        off = np.array([np.mean(np.abs(z)) - deflection_only_mm, np.mean(z) - mean_z_mm])
        if np.all(np.abs(off) < 0.05):
            break
        per_dose = (np.mean(z) - 1e3 * zero * rise) / dose
        centred = np.mean(np.abs(z - np.mean(z) + mean_z_mm))
        dose *= deflection_only_mm / centred
        zero = 1e-3 * (mean_z_mm - dose * per_dose) / rise
    return (*effects, *lens)


def _moves(arm: Arm, poses: Array) -> Array:
    """Return the travel of the tip per unit of each joint, (n, N, 3)."""
    true, step = TrueArm(arm, steps=_STEPS), 1e-3
    steps = step * np.eye(arm.n)
    return np.stack([(true.tip(poses + s) - true.tip(poses - s)) / (2 * step) for s in steps])
