"""A model fitted to the rows of a session: residual, design, covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.calibration.linear import whiten_rows
from longarm_comp.core.data.measurement import compute_unit_lengths
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model, Slot

Columns = dict[tuple[object, ...], np.ndarray]


@dataclass(frozen=True)
class ModelFit:
    """A model fitted to a session's seen rows.

    Attributes:
        model: the model at the posterior mode.
        session: the seen rows that were fitted.
        posture: the arm at the rows.
        residual: (N, d) measured - predicted in the d channels of the session, m or rad; 0 where
            a row does not hold a channel.
        columns: (N, d, p) design at the solution.
        covariance: (p, p) of the parameters, Laplace approximation.
        weights: (N,) weight of each row (`linear.weigh_rows`): 0 for an outlier, mostly 1.
        sigma: (d,) noise per channel, m or rad, of a row with weight 1; infinite where nothing
            was measured.
        effective: number of parameters that the data determine.
        iterations: number of Gauss-Newton steps.
        converged: whether the last step was small enough.
        rho: correlation of the noise from one row to the next.
    """

    model: Model
    session: Session
    posture: Posture
    residual: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    effective: float
    iterations: int
    converged: bool
    rho: float = 0.0

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """The p parameters that were fitted, in the order of `columns` and `covariance`."""
        return self.model.slots

    @cached_property
    def standard_errors(self) -> np.ndarray:
        """Standard errors (p,) of the parameters, in their units (Laplace approximation)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def noise_arguments(self) -> dict[str, Any]:
        """The noise and weights of the rows, as arguments of another `fit_model` of these rows."""
        return {"sigma": self.sigma, "rho": self.rho, "weights": self.weights}

    @property
    def outliers(self) -> np.ndarray:
        """The rows (positions in `session`) that got weight 0."""
        return np.flatnonzero(self.weights == 0)

    def whiten_columns(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns (N, d, k), m or rad: return (dM, k) of the M inliers, in noise units."""
        return whiten_rows(columns, self.weights, self.sigma, self.rho, self.session.measured)

    def whiten_with_residual(self, sigma: np.ndarray) -> np.ndarray:
        """Return the prior-scaled columns and the residual, whitened by a noise, (dM, p + 1).

        Rows count by their weights. Correlation of the noise between rows is ignored.

        Args:
            sigma: (d,) noise per channel, m or rad.
        """
        columns = self.columns * prior_widths(self.slots)
        both = np.concatenate([columns, self.residual[..., None]], axis=-1)
        return whiten_rows(both, self.weights, sigma, 0.0, self.session.measured)

    def stated_noise_ratio(self, rows: Session) -> np.ndarray:
        """Return the stated noise of M rows over the usual noise, (M,).

        It is 1 for all rows if the fit did not weight its rows by their stated noise.
        """
        believed = not np.isin(self.weights, (0.0, 1.0)).all()
        return rows.uneven(self.session.claimed_sigma) if believed else np.ones(len(rows))

    @cached_property
    def has_point(self) -> np.ndarray:
        """(N,) True for rows with three equations of the tip's place: a position or a touch."""
        if self.session.blocks[0].kind not in ("position", "touch"):
            return np.zeros(len(self.session), dtype=bool)
        return np.asarray(self.session.measured[:, :3].all(axis=1))

    @property
    def residual_by_tip(self) -> np.ndarray:
        """The residual (N, 3), m, of positions in the axes of the tip."""
        tip = self.model.tip_frame(self.posture).matrix()[..., :3, :3]
        axes = np.broadcast_to(tip, (len(self.residual), 3, 3))
        return np.asarray(np.einsum("nji,nj->ni", axes, self.residual[:, :3]))

    @property
    def width(self) -> int:
        """The number d of channels."""
        return self.residual.shape[1]

    @cached_property
    def known_columns(self) -> tuple[Columns, Columns, Columns]:
        """Caches of `FitColumns`: columns of candidates, displacements, and whitened columns."""
        return {}, {}, {}

    @cached_property
    def metres(self) -> np.ndarray:
        """The length at the tip (m) that a unit of each channel corresponds to, (d,); 0 if none."""
        return compute_unit_lengths(self.model, self.session)

    @cached_property
    def noise_m(self) -> np.ndarray:
        """The (d,) noise of the channels as lengths at the tip, m; 0 if there is no such length."""
        return np.where(np.isfinite(self.sigma), self.sigma, 0.0) * self.metres

    def to_lengths(self, white: np.ndarray) -> np.ndarray:
        """Map whitened data (dM,) of the M inliers to lengths at the tip (M, d), m."""
        count = self.weights[self.weights > 0][:, None]
        return white.reshape(-1, self.width) * self.noise_m / np.sqrt(count)

    @cached_property
    def design(self) -> np.ndarray:
        """The (dM, p) whitened, prior-scaled design."""
        return self.whiten_columns(self.columns * prior_widths(self.slots))

    @cached_property
    def gram(self) -> np.ndarray:
        """The (p, p) product of the design with itself."""
        return np.asarray(self.design.T @ self.design)

    @cached_property
    def data(self) -> np.ndarray:
        """The (dM,) whitened linearised data: the residual at the prior mean of all parameters."""
        data = self.residual + self.columns @ self.model.values
        return self.whiten_columns(data[..., None])[:, 0]


def choose_evenly(rows: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the row numbers (N,), evenly from the first to the last."""
    return np.asarray(rows[np.unique(np.linspace(0, len(rows) - 1, most).round().astype(int))])


def prior_widths(slots: tuple[Slot, ...]) -> np.ndarray:
    """Return the (p,) prior standard deviations of parameters, each in the parameter's unit."""
    return np.array([s.parameter.width for s in slots], dtype=float)


def bounds_of(slots: Sequence[Slot]) -> np.ndarray:
    """Return the lower and the upper bounds (2, p) of parameters, each in the parameter's unit."""
    return np.reshape([(s.parameter.lower, s.parameter.upper) for s in slots], (-1, 2)).T


def prior_bounds(slots: tuple[Slot, ...]) -> np.ndarray:
    """Return the lower and the upper bounds (2, p) of parameters over their prior widths."""
    return bounds_of(slots) / prior_widths(slots)
