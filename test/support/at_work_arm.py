"""The small arm with play in one joint, by other physics: a model fitted to it, and sightings."""

from functools import cache

import numpy as np
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import LEGS
from longarm_comp.core.at_work.learner import Learner
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
VARIANCE = np.full(3, NOISE**2)


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


class Work:
    """Sightings of an arm at random joints from random sides."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.number = 0

    def pose(self) -> tuple[np.ndarray, Context, np.ndarray]:
        """Joints, circumstances and sides of the next pose."""
        q = ARM.lower + self.rng.random(ARM.n) * (ARM.upper - ARM.lower)
        side = self.rng.choice([-1.0, 1.0], ARM.n)
        long = np.zeros((ARM.n, LEGS))
        long[:, 0] = side
        return q, Context(approach=tuple(side), legs=tuple(long.ravel())), side

    def learned(
        self, learner: Learner, count: int, more: float = 0.0, off: float = 0.0, noise: float = 1.0
    ) -> Learner:
        """After sightings with more half play, a wrong marker, other noise."""
        for _ in range(count):
            q, context, side = self.pose()
            self.number += 1
            tip = true_tip(q[None], side[None], more)[0] + off
            tip = tip + noise * NOISE * self.rng.standard_normal(3)
            learner = learner.learn(q, context, tip, VARIANCE, 60.0 * self.number)
        return learner

    def missed(self, model: Model, more: float, count: int = 20) -> float:
        """Mean distance of the true tip from what a model promises, m."""
        poses = [self.pose() for _ in range(count)]
        off = [model.tip(q, c) - true_tip(q[None], s[None], more)[0] for q, c, s in poses]
        return float(np.linalg.norm(off, axis=1).mean())
