"""The small arm with play in one joint: its true tip by other physics, and a model fitted to it."""

from __future__ import annotations

from functools import cache

import numpy as np
from small_arm import ARM

from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.drives import FrictionHysteresis as TruePlay

JOINT = 2
LAG = 2e-3
"""Half play of that joint, rad."""
NOISE = 5e-5


def true_tip(q: np.ndarray, side: np.ndarray, more: float = 0.0) -> np.ndarray:
    """(N, 3) m at joints (N, n) that arrived from sides (N, n), with more half play."""
    return _truth(more).tip(q, TrueContext(approach=side))


@cache
def _truth(more: float) -> TrueArm:
    return TrueArm(ARM, [TruePlay((LAG + more) * np.eye(ARM.n)[JOINT - 1])], steps=2)


@cache
def fitted() -> Model:
    """The model that 120 sightings give, with the record of how good it is."""
    rng = np.random.default_rng(1)
    q = ARM.lower + rng.random((120, ARM.n)) * (ARM.upper - ARM.lower)
    side = rng.choice([-1.0, 1.0], len(q))
    tip = true_tip(q, np.repeat(side[:, None], ARM.n, axis=1))
    seen = tip + NOISE * rng.standard_normal(tip.shape)
    session = Session.record(q, seen, approach=side)
    base = dict(fit_stages(declared_model(ARM), session))["geometry"].model
    return with_uncertainty(fit_model(base.plus(FrictionHysteresis(JOINT)), session))
