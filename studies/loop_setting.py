"""Set-up of a case: the true arm, its measured session, and the visibility of its effects."""

import math
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model, geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.plan import grid, sobol
from longarm_comp.core.data.session import Session
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.rods import QUICK_STEPS
from studies.loop_cases import SPOILED, Case
from studies.loop_truth import at_one_place, size
from studies.random_arms import random_arm
from studies.simulated import arrival, measure_session
from studies.true_camera import (
    Hidden,
    Noise,
    TrueCamera,
    draw_geometry_errors,
    hidden,
    make_truth,
)

HELD_OUT = 100
"""Number of further poses, uniform over the joint box."""
CANDIDATES = 150
"""Approximate number of candidates; visibility accounts for the choice among them."""
_PLANS = {"grid": grid, "sobol": sobol}
_MOST = 6.0  # times the typical size


@dataclass(frozen=True)
class LoopSetting:
    """Arm, effects and data of a case.

    Attributes:
        case: the case.
        arm: as declared.
        effects: hidden effects besides the geometry errors.
        visible: per effect, size that remains after a full geometry refit over the smallest
            detectable size; 1 and more is visible.
        train: rows to fit. held_out: fresh poses.
        clean_train: (N, 3) without noise, m. clean_held_out: likewise.
        sigma: (3,) true noise per axis, m.
    """

    case: Case
    arm: Arm
    effects: tuple[Hidden, ...]
    visible: tuple[float, ...]
    train: Session
    held_out: Session
    clean_train: np.ndarray
    clean_held_out: np.ndarray
    sigma: np.ndarray


def set_up(case: Case, declared: Arm) -> LoopSetting:
    """Draw arm, effects and noise, and measure.

    Raises:
        InputError, JobError: the arm cannot have such an effect or is not stable with it.
    """
    rng = case.rng
    arm = declared if case.arm == 0 else random_arm(np.random.default_rng(case.arm), declared)
    spoiled = SPOILED[case.spoiled]
    repeats = case.rows // 20
    plan = _PLANS[case.plan](arm, case.rows - 2 * repeats, rng).q
    fresh = sobol(arm, HELD_OUT, rng).q
    noise = Noise(0.22e-3 * case.noise, 0.28e-3 * case.noise, spoiled.rho, spoiled.tail_dof)
    off = draw_geometry_errors(arm, spoiled.geometry, rng)
    head = TrueCamera.of(arm)
    sight = np.asarray(head.axes[2])
    sigma = np.sqrt(noise.sigma_m**2 + (noise.depth_m * sight) ** 2)
    gauge, drawn = _Gauge(arm, plan, sigma, rng), []
    for name in case.effects:  # of 0.7 to 2 times its typical size
        effect = hidden(name, arm, float(np.exp(rng.uniform(np.log(0.7), np.log(2.0)))), rng)
        effect = at_one_place(effect, arm, rng) if case.one_place else effect
        drawn.append(gauge.scale_to_visible(effect, rng))
    effects = [effect for effect, _ in drawn]
    true, eye = make_truth(arm, (*effects, *off))
    train = measure_session(
        true, eye, plan, rng=rng, repeats=repeats, lost=0.01, outliers=spoiled.outliers, noise=noise
    )
    end = float(train.session.columns["t_s"][-1]) + 60.0
    held = measure_session(true, eye, fresh, rng=rng, noise=noise, start_s=end)
    return LoopSetting(
        case,
        arm,
        tuple(effects),
        tuple(v for _, v in drawn),
        train.session,
        held.session,
        train.truth["seen"],
        held.truth["seen"],
        sigma,
    )


class _Gauge:
    """Size of an effect after a geometry refit, on the poses of a plan."""

    def __init__(
        self, arm: Arm, plan: np.ndarray, sigma: np.ndarray, rng: np.random.Generator
    ) -> None:
        side = arrival(plan, rng.choice([-1.0, 1.0], len(plan)))
        t = np.linspace(0.0, 16.0 * len(plan), len(plan))
        warm = arm.reference_temperature_c - 10.0 * np.expm1(-t / 5000.0)
        self.q, self.t_s = plan, t
        self.context = TrueContext(side, warm, None, t)
        self.arm = arm
        self.sound = self._see()
        session = Session.record(plan, self.sound)
        model = declared_model(arm)
        base = model.plus(*geometry_terms(arm, session))
        self.fit: ModelFit = fit_model(base, session, sigma=sigma, robust=False)
        self.marginal = Marginal(self.fit.design, self.fit.data)

    def _see(self, *effects: Hidden) -> np.ndarray:
        true, eye = make_truth(self.arm, effects, QUICK_STEPS)
        return eye.seen(true.tip(self.q, self.context), self.t_s)

    def visibility(self, effect: Hidden) -> float:
        """Return remaining size in units of the noise over the smallest detectable size.

        Detectable is what an ideal observer finds who knows the shape of each of `CANDIDATES`
        effects, asks for odds of 20 and pays half a log of the number of readings per
        parameter (BIC).
        """
        moved = self._see(effect)
        white = self.fit.whiten_columns((moved - self.sound)[..., None])[:, 0]
        left = float(white @ self.marginal.project(white))
        readings = 3 * len(moved)
        needed = 2 * (math.log(CANDIDATES) + math.log(20.0))
        needed += size(effect, self.arm) * math.log(readings)
        return math.sqrt(max(left, 0.0) / needed)

    def scale_to_visible(self, effect: Hidden, rng: np.random.Generator) -> tuple[Hidden, float]:
        """Return the effect scaled to a random visibility of 1.25 to 3, at most 6 times typical."""
        wanted = float(np.exp(rng.uniform(np.log(1.25), np.log(3.0))))
        now = self.visibility(effect)
        if now < wanted and now > 0:
            effect = effect.scale_by(min(wanted / now, _MOST))
            now = self.visibility(effect)
        return effect, now
