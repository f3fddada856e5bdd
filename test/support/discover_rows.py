"""Sessions of arms with something hidden, and the geometry fitted to them."""

import numpy as np
from hidden_arm import white

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model, fit_stages
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect

ROWS, HELD_OUT = 120, 60
DEMO = Arm.load(folder("config") / "arm_demo.yaml")


def measured(arm: Arm, hidden: tuple[HiddenEffect, ...], n: int, seed: int) -> Session:
    """Poses all over the box, with what such an arm would record, and 0.2 mm of noise."""
    rng = np.random.default_rng(seed)
    q = sobol(arm, n, rng).q
    t = np.linspace(0.0, 15.0 * n, n)
    context = TrueContext(t_s=t, temperature_c=arm.reference_temperature_c + 3 * np.sin(t / 700))
    xyz = TrueArm(arm, hidden, steps=2).tip(q, context) + white(rng, n)
    state = State.of(arm, q, context)
    columns = {"t_s": t, "temperature_c": state.temperature_c}
    for effect in hidden:
        columns |= effect.readings(state)
    return Session.record(q, xyz, columns=columns)


def calibrated(arm: Arm, session: Session) -> ModelFit:
    *_, (_, fitted) = fit_stages(declared_model(arm), session)
    return fitted
