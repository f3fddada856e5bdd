"""One session during the Gauss-Newton steps of a fit: its residual, design, weights and noise."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.calibration.linear import (
    BEFOREHAND,
    degrees_of_freedom,
    estimate_noise,
    mark_inliers,
    weigh_rows,
    whiten_rows,
)
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.commanded import with_frame_shift
from longarm_comp.core.data.measurement import compute_posture, make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model

AHEAD = 0.1
"""Fraction of a step over which the second derivative is computed (Transtrum and Sethna).

The third derivative then adds a tenth of what it adds over a whole step, and rounding nothing.
"""

FARTHEST_M = 200.0
"""Largest allowed coordinate of a measured point, m.

At 300 m rounding errors widen an interval of uncertainty by a half.
"""
RUN_AWAY = 1e100
"""Prediction (m, rad, or either per parameter) that counts as infinite: its square in units of the
noise is hardly a number."""


class SessionProblem:
    """A session during the Gauss-Newton steps; arguments and errors are those of `fit_model`.

    Attributes:
        own_places: indices of its parameters among those of all sessions that are fitted together.
    """

    own_places: np.ndarray

    def __init__(
        self,
        model: Model,
        session: Session,
        sigma: np.ndarray | None = None,
        weights: np.ndarray | None = None,
        robust: bool = True,
        rho: float = 0.0,
        usual: Mapping[str, float] | None = None,
        begun: ModelFit | None = None,
        near: ModelFit | None = None,
    ) -> None:
        self.seen = seen = session.take(session.seen)
        if len(seen) < 4:
            raise InputError(session.source, "xyz", f"{len(seen)} seen rows", "at least 4")
        farthest = float(np.max(np.abs(seen.xyz), initial=0.0, where=np.isfinite(seen.xyz)))
        if farthest > FARTHEST_M:
            allowed = f"at most {FARTHEST_M:g} m from the frame's origin: subtract a constant"
            raise InputError(session.source, "xyz", f"{farthest:g} m", allowed)
        context = seen.context()
        for term in model.terms:
            term.require(context)
        self.model = model = dataclasses.replace(
            model, arrivals=seen.arrivals, row_legs=seen.row_legs, uncertainty=None
        )
        self.sigma, self.fixed, self.robust, self.rho = sigma, weights, robust, rho
        self.usual = usual or {}
        self.weights = np.ones(len(seen)) if weights is None else np.asarray(weights, float)
        self.noise = np.asarray(
            np.full(len(seen.channels), np.nan) if sigma is None else sigma, float
        )
        self.uneven = seen.uneven(seen.claimed_sigma)
        self.effective = 0.0
        if begun is not None:
            self.residual, self.columns = begun.residual, begun.columns
            self.posture = self.near = begun.posture
        else:
            at = compute_posture(model, seen) if near is None else model.posture_near(near.posture)
            self._predict_rows(at)
            self.update_design()

    def _predict_rows(self, at: Posture) -> None:
        self.posture = at
        self.residual = make_equations(self.model, self.seen, (), at=at).residual
        self._check_finite(self.residual)

    def update_design(self) -> None:
        """Compute the design of the present model; later postures start from its posture."""
        self.columns = make_equations(self.model, self.seen, at=self.posture).columns
        self._check_finite(self.columns)
        self.near = self.posture

    def _check_finite(self, values: np.ndarray) -> None:
        if not (np.abs(values) < RUN_AWAY).all():
            raise JobError("the fit did not stay finite", session=self.seen.source)

    def make_fit(
        self, covariance: np.ndarray, iterations: int = 0, converged: bool = False
    ) -> ModelFit:
        """Return the fit with the present model.

        Args:
            covariance: (p, p) of the parameters.
            iterations: number of Gauss-Newton steps.
            converged: whether the last step was small enough.
        """
        model = self.model
        if any(not b.geometry for b in model.biases):
            model = with_frame_shift(model, self.seen, self.posture)
        return ModelFit(
            model=model,
            session=self.seen,
            posture=self.posture,
            residual=self.residual,
            columns=self.columns,
            covariance=covariance,
            weights=self.weights,
            sigma=self.noise,
            effective=self.effective,
            iterations=iterations,
            converged=converged,
            rho=self.rho,
        )

    def move_to(self, values: np.ndarray, close: bool) -> None:
        """Compute the residual at other parameter values (p,); the design stays.

        Args:
            close: whether the values are close to those at which the design was computed.
        """
        self.model = self.model.with_values(values)
        self._predict_rows(self.model.posture_near(self.near, close))

    def project_curvature(self, step: np.ndarray, scale: np.ndarray, close: bool) -> np.ndarray:
        """Return the product (p,) of the prior-scaled design with the curvature of the predictions.

        The curvature is half the second derivative along a step. Afterwards the model stays at
        `AHEAD` of the step.

        Args:
            step: (p,) change of the values.
            scale: (p,) standard deviations of the priors.
            close: as in `move_to`.
        """
        values, residual = self.model.values, self.residual
        self.move_to(values + AHEAD * step, close)
        half = (residual - self.residual - AHEAD * (self.columns @ step)) / AHEAD**2
        white = self._whiten_rows(np.concatenate([self.columns * scale, half[..., None]], axis=-1))
        return np.asarray(white[:, :-1].T @ white[:, -1])

    def compute_cost(self) -> float:
        """Return the squared residual of the inliers in units of the noise."""
        return float((self._whiten_rows(self.residual[..., None]) ** 2).sum())

    def judge_rows(self, step: int) -> None:
        """Find outliers and noise in the present residual.

        At the first step all rows count, so that the start values do not decide which rows are
        outliers.

        Args:
            step: number of the step of the fit, from 1.
        """
        if self.robust and self.fixed is None:
            self.weights = weigh_rows(self.residual, self.uneven, self.seen.measured)
            if step > 1:
                even = self.residual * np.sqrt(self.weights)[:, None]
                known = self.noise if step > 2 else None
                self.weights = self.weights * mark_inliers(even, self.seen.measured, known)
        if self.sigma is None:
            self.noise = self._pool_noise()

    def estimate_noise(self) -> np.ndarray:
        """Return the noise (d,) of every channel in the present residual, m or rad."""
        return estimate_noise(self.residual, self.weights, self.effective, self.seen.measured)

    def _pool_noise(self) -> np.ndarray:
        """Return the noise (d,) with one value for all channels of a kind and sensor.

        If the usual noise of the kind is known, it counts as `BEFOREHAND` further equations.
        """
        sigma = self.estimate_noise()
        pooled = np.full(len(sigma), np.inf)
        free = degrees_of_freedom(self.weights, self.effective, self.seen.measured)
        start = 0
        for block in self.seen.blocks:
            mine = slice(start, start := start + len(block.channels))
            found = np.isfinite(sigma[mine])
            if not found.any():
                continue
            pooled[mine] = np.sqrt((sigma[mine][found] ** 2).mean())
            if (known := self.usual.get(block.kind)) is not None:
                degrees = float(free[mine][found].sum())
                square = BEFOREHAND * known**2 + degrees * pooled[start - 1] ** 2
                pooled[mine] = np.sqrt(square / (BEFOREHAND + degrees))
        return pooled

    def linearise_rows(
        self, scale: np.ndarray, centre: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the prior-scaled design (dM, p) and the linearised data (dM,) of the M inliers.

        Both are in units of the noise.

        Args:
            scale, centre: (p,) standard deviations and means of the priors.
        """
        y = self.residual + self.columns @ (self.model.values - centre)
        white = self._whiten_rows(np.concatenate([self.columns * scale, y[..., None]], axis=-1))
        return white[:, :-1], white[:, -1]

    def _whiten_rows(self, columns: np.ndarray) -> np.ndarray:
        return whiten_rows(columns, self.weights, self.noise, self.rho, self.seen.measured)
