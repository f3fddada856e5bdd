"""A session of the demonstration's arm with hidden effects, small enough for a search."""

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.model.model import Model

N = 90


def session_of(arm: Arm, seed: int, *hidden: Effect) -> Session:
    """Poses of an arm with geometry errors, 0.4 mm of noise and what is hidden."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper, (N, arm.n))
    zeros = tuple(JointZero(row, offset=3e-3 * rng.standard_normal()) for row in (1, 2, 4, 5, 6))
    truth = Model(arm, (LinkDeflection(), *zeros, *hidden))
    return Session.record(q, truth.tip(q) + 4e-4 * rng.standard_normal((N, 3)))
