"""The arm of `read_arm` with known zeros: models that sightings give it, judged at fresh poses."""

from functools import cache

import numpy as np
from hidden_arm import SIGMA
from read_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.geometry import JointZero

ZEROS = JointZero(np.array([3e-3, -4e-3, 2e-3, 4e-3]))
RIGID = TrueArm(ARM, [ZEROS])
RNG = np.random.default_rng(7)
FRESH = ARM.lower + RNG.random((200, ARM.n)) * (ARM.upper - ARM.lower)
WORK = ARM.lower + RNG.random((40, ARM.n)) * (ARM.upper - ARM.lower)
NOISE = SIGMA * RNG.standard_normal((40, 3))


@cache
def calibrated(truth: TrueArm, rows: str) -> Model:
    """The geometry that 80 rows give: on one line of the joint space, in a box, or all over."""
    rng = np.random.default_rng(2)
    share = {
        "line": np.repeat(rng.random((80, 1)), ARM.n, axis=1),
        "box": 0.4 + 0.2 * rng.random((80, ARM.n)),
        "wide": rng.random((80, ARM.n)),
    }[rows]
    q = ARM.lower + share * (ARM.upper - ARM.lower)
    seen = truth.tip(q) + SIGMA * rng.standard_normal((80, 3))
    *_, (_, fit) = fit_stages(declared_model(ARM), Session.record(q, seen))
    return with_uncertainty(fit)


def judged(model: Model, truth: TrueArm) -> tuple[float, float, float]:
    """Share of true tips inside the promised radius, mean error, and the median radius, m."""
    predicted = model.tip(FRESH, Context())
    off = np.linalg.norm(predicted - truth.tip(FRESH), axis=1)
    radius = expected_miss(model, FRESH, Context(), predicted).sizes[1]
    return float((off <= radius).mean()), float(off.mean()), float(np.median(radius))
