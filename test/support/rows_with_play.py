"""Rows of an arm with play in its joints, which come from either side."""

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.model.model import Model


def session_of(arm: Arm, seed: int, play: Backlash) -> Session:
    """Poses that the joints reach from either side, of an arm with play; 0.4 mm of noise."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper, (120, arm.n))
    side = rng.choice([-1, 1], q.shape)
    truth = Model(arm, (LinkDeflection(), play))
    known = Session.record(q, np.zeros((120, 3)), approach=side).context()
    xyz = truth.tip(q, known) + 4e-4 * rng.standard_normal((120, 3))
    return Session.record(q, xyz, approach=side)
