"""Truth and model, two physics routes by two hands, told of the same effect: they must agree.

Where they do not, by design: a slide's error makes the true beam longer, not only shifted;
true rotations are not first order; near a load gate one may fall on the other side; a true
deadband without load keeps the side it came from.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context as ModelContext
from longarm_comp.core.effects.camera_errors import CameraRadial, CameraScale
from longarm_comp.core.effects.compliances import (
    BaseCompliance,
    BearingTilt,
    JointCompliance,
    LinkStiffness,
    ServoDroop,
)
from longarm_comp.core.effects.drive_errors import (
    GearEccentricity,
    JointCoupling,
    JointGain,
    PrismaticPitch,
    ServoQuantisation,
    UnfinishedMove,
)
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.masses import GravityDirection, LinkMass, TipPayload
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.effects.plays import (
    Backlash,
    FrictionHysteresis,
    ServoDeadband,
    TelescopeClearance,
)
from longarm_comp.core.effects.slow_changes import (
    BaseSettling,
    Creep,
    ThermalGrowth,
    ThermalSoftening,
)
from longarm_comp.core.effects.typical_loads import typical_loads
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State
from longarm_comp.sim.hidden.catalogue import typical_context
from studies.true_camera import draw, make_truth

SIZE_MM = 3.0
TURNING, SLIDING = (1, 2, 4, 5, 6), (3, 7)
ALL = (*TURNING, *SLIDING)


def _each(rows: tuple[int, ...], make: Callable[..., Any], **fields: Any) -> list[Any]:
    """One term a row, its fields out of arrays over the joints."""
    return [
        make(joint=r, **{f: float(v[r - 1]) if np.ndim(v) else v for f, v in fields.items()})
        for r in rows
    ]


def _eccentric(e: Any) -> list[Any]:
    terms: list[Any] = []
    for order, (size, phase) in enumerate(zip(e.amplitude, e.phase, strict=True), 1):
        cosine, sine = size * np.sin(phase), size * np.cos(phase)
        terms += _each(TURNING, GearEccentricity, order=order, cosine=cosine, sine=sine)
    return terms


# name: (the model's terms for a hidden effect, rms difference allowed in mm at 3 mm of effect)
TORQUE = typical_loads(Arm.load(DEMO_ARM)).torque

SAME: dict[str, tuple[Callable[[Any], list[Any]], float]] = {
    "joint_zero": (lambda e: _each(ALL, JointZero, offset=e.offset), 0.06),
    "base_pose": (lambda e: [BasePose("", *e.delta.tolist())], 0.06),
    "gravity_direction": (
        lambda e: [GravityDirection(about_x=float(e.tilt[0]), about_y=float(e.tilt[1]))],
        1.0,  # 0.2 rad of tilt, first order in the model
    ),
    "thermal_growth": (lambda e: [ThermalGrowth(expansion=e.rate)], 0.5),  # d + q against d
    "joint_gain": (lambda e: _each(TURNING, JointGain, gain=e.gain), 0.01),
    "joint_coupling": (
        lambda e: [
            JointCoupling(r, other=r - 1, coupling=float(e.factor[r - 1]))
            for r in TURNING
            if e.factor[r - 1]
        ],
        0.06,
    ),
    "prismatic_pitch": (lambda e: _each(SLIDING, PrismaticPitch, gain=e.gain), 0.15),
    "gear_eccentricity": (_eccentric, 0.01),
    "servo_quantisation": (
        lambda e: [
            ServoQuantisation(joint=r, steps_per_turn=round(2 * np.pi / e.step[r - 1]))
            for r in TURNING
        ],
        0.01,
    ),
    "servo_droop": (lambda e: _each(TURNING, ServoDroop, compliance=e.compliance), 0.6),
    "servo_deadband": (
        lambda e: _each(TURNING, ServoDeadband, width=2 * e.half, gate=e.gate / TORQUE),
        0.3,
    ),
    "backlash": (lambda e: _each(TURNING, Backlash, width=2 * e.half, gate=e.gate / TORQUE), 0.3),
    "friction_hysteresis": (lambda e: _each(TURNING, FrictionHysteresis, width=2 * e.lag), 0.01),
    "servo_lag": (lambda e: _each(ALL, UnfinishedMove, share=e.left), 0.06),
    "joint_compliance": (lambda e: _each(TURNING, JointCompliance, compliance=e.compliance), 0.01),
    "bearing_tilt": (
        lambda e: _each(ALL, BearingTilt, about_x=e.compliance, about_y=e.compliance),
        0.01,
    ),
    "base_compliance": (
        lambda e: [BaseCompliance(about_x=e.compliance[0], about_y=e.compliance[1])],
        0.01,
    ),
    "base_settling": (
        lambda e: [BaseSettling(sink=e.sink, about_x=e.lean[0], about_y=e.lean[1])],
        0.01,
    ),
    "telescope_clearance": (
        lambda e: _each(SLIDING, TelescopeClearance, clearance=e.clearance, give=e.pads),
        0.02,
    ),
    "link_stiffness": (
        lambda e: [LinkStiffness(beam=b, softness=e.dose * s) for b, s in e.softer.items()],
        0.02,
    ),
    "thermal_softening": (lambda e: [ThermalSoftening(softening=e.rate)], 0.02),
    "creep": (lambda e: [Creep(time=e.time_s, amount=e.more)], 0.02),
    "tip_payload": (lambda e: [TipPayload(mass=e.mass_kg)], 0.02),
    "link_mass": (lambda e: [LinkMass(frame=e.row, mass=e.mass_kg)], 0.02),
    "measured_tilt": (lambda e: [MeasuredTilt(frame=e.row)], 0.01),
    "camera_scale": (lambda e: [CameraScale(scale=e.scale)], 0.01),
    "camera_radial": (lambda e: [CameraRadial(k1=e.k1)], 0.01),
}


@pytest.mark.parametrize("name", SAME)
def test_truth_and_model_agree_on(arm: Arm, name: str) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(arm.lower, arm.upper, (40, arm.n))
    context = typical_context(len(q), arm, rng)
    effect = draw(name, arm, rng, SIZE_MM, q)
    (true, eye), state = make_truth(arm, [effect]), State.of(arm, q, context)
    seen = eye.seen(true.tip(q, context), state.t_s)

    terms, allowed = SAME[name]
    columns = {"temperature_c": state.temperature_c, "t_s": state.t_s}
    for one in true.hidden:
        columns |= one.readings(state)
    recorded = ModelContext(
        approach=tuple(state.approach.T), columns=columns, last_way=tuple(state.way.T)
    )
    made = terms(effect)
    if eye.effects:
        model = Model(arm, (LinkDeflection(),), tuple(made))
    else:
        model = Model(arm, (LinkDeflection(), *made))
    apart = 1e3 * np.linalg.norm(model.measured(q, recorded) - seen, axis=1)
    assert np.sqrt(np.mean(apart**2)) < allowed


@pytest.mark.parametrize(("softer", "allowed_mm"), [(0.4, 0.002), (1.4, 0.05), (3.0, 0.2)])
def test_sag_agrees_from_5_to_40_mm(arm: Arm, softer: float, allowed_mm: float) -> None:
    """About 5, 18 and 40 mm of sag (the project's goal: 0.05 mm at 18, 0.2 mm at 40)."""
    data = arm.model_dump(mode="json", exclude_none=True)
    for beam in data["links"]:
        beam["E_pa"] /= softer
    soft = Arm.parse(data, "test")
    q = np.random.default_rng(6).uniform(arm.lower, arm.upper, (30, arm.n))
    rigid = TrueArm(soft.model_copy(update={"gravity_mps2": (0.0, 0.0, 0.0)})).tip(q)
    truth = TrueArm(soft).tip(q)
    sag = 1e3 * np.linalg.norm(truth - rigid, axis=1).mean()
    assert sag == pytest.approx(13.3 * softer, rel=0.1)
    apart = 1e3 * np.linalg.norm(Model(soft, (LinkDeflection(),)).tip(q) - truth, axis=1)
    assert apart.max() < allowed_mm
