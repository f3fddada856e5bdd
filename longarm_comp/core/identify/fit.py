"""Robust joint fit of a model to a session: geometry and effects together.

Gauss-Newton on the posterior mode.  Every parameter has a prior (a tolerance), which is
what holds the gauge freedoms of a redundant geometry; sign bounds are kept exactly; rows
that no model of this kind explains get weight 0, anew at every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm import Arm
from longarm_comp.core.dataset import Session
from longarm_comp.core.effects.base_pose import BasePose
from longarm_comp.core.effects.dh_error import DhError
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.effects.tip_offset import TipOffset
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify import linear
from longarm_comp.core.model import Model, Slot, unstack

OUTLIER = 4.2
"""Rows beyond this many robust standard deviations (per axis norm) get weight 0."""
_MAD = 1.4826


@dataclass(frozen=True)
class Fit:
    """A model fitted to a session's seen rows.

    Attributes:
        model: at the posterior mode.
        session: the seen rows that were fitted.
        residual: (N, 3) measured - predicted, m.
        columns: (N, 3, p) design at the solution.
        covariance: (p, p) of the parameters, Laplace approximation.
        weights: (N,) 1 or 0 (outlier).
        sigma: (3,) noise per axis, m.
        effective: number of parameters that the data determine.
        iterations: Gauss-Newton steps taken.
        converged: whether the last step was below a hundredth of the standard errors.
    """

    model: Model
    session: Session
    residual: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    effective: float
    iterations: int
    converged: bool

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """The fitted parameters."""
        return self.model.slots

    @cached_property
    def standard_errors(self) -> np.ndarray:
        """(p,) Laplace standard errors."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def outliers(self) -> np.ndarray:
        """Rows (positions in `session`) that got weight 0."""
        return np.flatnonzero(self.weights == 0)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """(N, 3, k) columns in m per unit -> (3N, k), weighted and in units of the noise."""
        scale = (np.sqrt(self.weights)[:, None] / self.sigma)[..., None]
        return (columns * scale).reshape(-1, columns.shape[-1])

    @cached_property
    def design(self) -> np.ndarray:
        """(3N, p) whitened, prior-scaled design."""
        return self.whitened(self.columns * priors(self.slots))

    @cached_property
    def data(self) -> np.ndarray:
        """(3N,) whitened linearised data: the residual with all parameters at their prior mean."""
        taken = self.columns @ self.model.values
        return self.whitened((self.residual + taken)[..., None])[:, 0]


def priors(slots: tuple[Slot, ...]) -> np.ndarray:
    """(p,) prior standard deviations."""
    return np.array([s.parameter.prior for s in slots], dtype=float)


def geometry(arm: Arm, session: Session) -> tuple[Effect, ...]:
    """What is always fitted: every joint zero and DH row, base placements, markers."""
    groups = np.unique(session.labels["group"]) if "group" in session.labels else []
    bases = tuple(BasePose(group=str(g)) for g in groups) if len(groups) > 1 else (BasePose(),)
    return (*frames(arm, session, bases), *JointZero.for_arm(arm), *DhError.for_arm(arm))


def frames(
    arm: Arm, session: Session, bases: tuple[BasePose, ...] | None = None
) -> tuple[Effect, ...]:
    """Base placement(s) and markers only: what any measurement needs."""
    if bases is None:
        groups = np.unique(session.labels["group"]) if "group" in session.labels else []
        bases = tuple(BasePose(group=str(g)) for g in groups) if len(groups) > 1 else (BasePose(),)
    return (*bases, *TipOffset.for_arm(arm))


def align(model: Model, session: Session, beyond: float = 0.1) -> Model:
    """Put the base placements roughly where the data say, when they are far off (Kabsch).

    Args:
        model: holds one `base_pose` per group.
        session: measured rows.
        beyond: median misfit (m) above which the placement is replaced.
    """
    seen = session.take(session.seen)
    effects = list(model.effects)
    for k, effect in enumerate(effects):
        if not isinstance(effect, BasePose):
            continue
        mine = np.ones(len(seen), bool)
        if effect.group and "group" in seen.labels:
            mine = seen.labels["group"] == effect.group
        rows = seen.take(mine)
        if len(rows) < 4:
            continue
        predicted = model.tip(rows.q, rows.context())
        if np.median(np.linalg.norm(rows.xyz - predicted, axis=1)) <= beyond:
            continue
        home = model.arm.base.frame().matrix()
        local = (predicted - home[:3, 3]) @ home[:3, :3]
        target = (rows.xyz - home[:3, 3]) @ home[:3, :3]
        turn, _ = Rotation.align_vectors(target - target.mean(0), local - local.mean(0))
        shift = target.mean(0) - turn.apply(local.mean(0))
        d, w = _log(turn, shift)
        names = ("x", "y", "z", "rx", "ry", "rz")
        effects[k] = effect.with_values(dict(zip(names, (*d, *w), strict=True)))
    made = Model(model.arm, tuple(effects), model.biases, model.passes, model.elements_per_beam)
    return made


def _log(turn: Rotation, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twist of a finite motion: the inverse of `spatial.exp_large`."""
    w = turn.as_rotvec()
    angle = np.linalg.norm(w)
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-9:
        return shift, w
    b = (1 - np.cos(angle)) / angle**2
    c = (angle - np.sin(angle)) / angle**3
    return np.linalg.solve(np.eye(3) + b * hat + c * hat @ hat, shift), w


def fit(
    model: Model,
    session: Session,
    *,
    sigma: np.ndarray | None = None,
    robust: bool = True,
    weights: np.ndarray | None = None,
    max_iterations: int = 25,
) -> Fit:
    """Fit all free parameters of a model.

    Args:
        model: starting point; its terms decide what is fitted.
        session: rows; lost markers are left out.
        sigma: (3,) noise per axis in m; estimated from the residual when not given.
        robust: give outliers weight 0, anew at every step.
        weights: (N of seen rows,) fixed weights instead.
        max_iterations: bound on the Gauss-Newton steps.

    Raises:
        InputError: fewer than four seen rows, or an input that a term needs is missing.
        JobError: the fit did not stay finite.
    """
    seen = session.take(session.seen)
    if len(seen) < 4:
        raise InputError(session.source, "xyz", f"{len(seen)} seen rows", "at least 4")
    context = seen.context()
    for term in model.terms:
        term.require(context)
    q = unstack(seen.q)
    slots = model.slots
    scale = priors(slots)
    lower = np.array([s.parameter.lower for s in slots]) / scale if slots else np.empty(0)
    upper = np.array([s.parameter.upper for s in slots]) / scale if slots else np.empty(0)
    fixed = weights is not None
    w = np.ones(len(seen)) if weights is None else np.asarray(weights, float)
    values = model.values
    effective = 0.0
    noise = np.full(3, np.nan) if sigma is None else np.asarray(sigma, float)
    converged = False
    step = 0
    for step in range(1, max_iterations + 1):
        posture = model.posture(q, context)
        point, columns = model.columns(posture)
        residual = seen.xyz - point
        if not (np.isfinite(residual).all() and np.isfinite(columns).all()):
            raise JobError("the fit did not stay finite", iteration=step)
        if robust and not fixed:
            w = inliers(residual, noise if step > 2 else None)
        if sigma is None:
            noise = spread(residual, w, effective)
        y = residual + columns @ values
        rows = (np.sqrt(w)[:, None] / noise)[..., None]
        a = (columns * scale * rows).reshape(-1, len(slots))
        posterior = linear.solve(a, (y[..., None] * rows).reshape(-1), lower, upper)
        change = posterior.u * scale - values
        effective = posterior.effective
        se = np.sqrt(np.diag(posterior.covariance)) * scale if len(slots) else np.ones(0)
        values = values + change
        model = model.with_values(values)
        if len(slots) == 0 or (step > 2 and np.all(np.abs(change) <= 0.01 * se)):
            converged = True
            break
    posture = model.posture(q, context)
    point, columns = model.columns(posture)
    residual = seen.xyz - point
    if sigma is None:
        noise = spread(residual, w, effective)
    covariance = posterior.covariance * np.outer(scale, scale)
    return Fit(model, seen, residual, columns, covariance, w, noise, effective, step, converged)


def inliers(residual: np.ndarray, sigma: np.ndarray | None = None) -> np.ndarray:
    """(N, 3) residual -> (N,) 1, or 0 beyond `OUTLIER` robust standard deviations.

    A row is out by its largest axis, scaled by the larger of the robust spread and the
    known noise.
    """
    centre = np.median(residual, axis=0)
    robust = _MAD * np.median(np.abs(residual - centre), axis=0)
    if sigma is not None and np.isfinite(sigma).all():
        robust = np.maximum(robust, sigma)
    worst = (np.abs(residual - centre) / np.maximum(robust, 1e-12)).max(axis=1)
    return (worst <= OUTLIER).astype(float)


def spread(residual: np.ndarray, weights: np.ndarray, effective: float) -> np.ndarray:
    """(3,) noise per axis from weighted residuals, degrees of freedom shared by the axes."""
    count = max(weights.sum() - effective / 3, 1.0)
    return np.maximum(np.sqrt((weights[:, None] * residual**2).sum(0) / count), 1e-7)
