"""The demo arm with a joint that yields, calibrated at payloads of 0.1 to 0.5 kg."""

from functools import cache

import numpy as np
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model

ARM = Arm.load(DEMO_ARM)
SOFT = declared_model(ARM).plus(JointCompliance(2, compliance=1e-3))


@cache
def loaded() -> Model:
    """The model that 60 sightings give."""
    columns, q = {"payload_kg": np.linspace(0.1, 0.5, 60)}, sobol(ARM, 60, 1).q
    seen = SOFT.measured(q, Context(columns=columns))
    seen = seen + 1e-4 * np.random.default_rng(0).standard_normal((60, 3))
    rows = Session.record(q, seen, columns=columns)
    return with_uncertainty(fit_model(SOFT.plus(*JointZero.for_arm(ARM)), rows))
