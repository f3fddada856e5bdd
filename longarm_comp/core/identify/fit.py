"""Robust joint fit of a model to a session: geometry and effects together.

Gauss-Newton on the posterior mode, each step shortened until it does not raise the cost.  Every
parameter has a prior (a tolerance), which is what holds the gauge freedoms of a redundant geometry;
that of an unknown placement lies around its start, so that what the rows do not determine stays
there.  Sign bounds are kept exactly; rows that no model of this kind explains get weight 0, anew at
every step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.data.measurement import equations, metres, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify import linear
from longarm_comp.core.identify.linear import inliers, spread, whiten
from longarm_comp.core.model.model import Model, Slot, unstack

CLOSE = 0.01
"""A fit has converged when its last step was below so many standard errors."""
SHORTEST = 1e-3
"""Share of a Gauss-Newton step below which no shorter one is tried."""
WORSE = 0.1
"""Rise of the cost, as a share of it, from which a step is shortened.  Columns leave out how loads
follow a change, so that close to the solution a good step may raise the cost a little."""


@dataclass(frozen=True)
class ModelFit:
    """A model fitted to a session's seen rows.

    Attributes:
        model: at the posterior mode.
        session: the seen rows that were fitted.
        residual: (N, d) measured - predicted in the d channels of the session, m or rad; 0 where
            a row does not hold a channel.
        columns: (N, d, p) design at the solution.
        covariance: (p, p) of the parameters, Laplace approximation.
        weights: (N,) 1 or 0 (outlier).
        sigma: (d,) noise per channel, m or rad; infinite where nothing was measured.
        effective: number of parameters that the data determine.
        iterations: Gauss-Newton steps taken.
        converged: whether the last step was small enough.
        rho: correlation of the noise from one row to the next.
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
    rho: float = 0.0

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
        """(N, d, k) columns per unit -> (dM, k) of the M inliers, in units of the noise."""
        return whiten(columns, self.weights, self.sigma, self.rho, self.session.mask)

    @property
    def width(self) -> int:
        """Number d of channels."""
        return self.residual.shape[1]

    @cached_property
    def posture(self) -> Posture:
        """The arm at the rows."""
        return posture(self.model, self.session)

    @cached_property
    def metres(self) -> np.ndarray:
        """(d,) length (m) that a unit of each channel stands for; 0 where it is none."""
        return metres(self.model, self.session)

    @cached_property
    def design(self) -> np.ndarray:
        """(dM, p) whitened, prior-scaled design."""
        return self.whitened(self.columns * priors(self.slots))

    @cached_property
    def gram(self) -> np.ndarray:
        """(p, p) product of the design with itself."""
        return np.asarray(self.design.T @ self.design)

    @cached_property
    def data(self) -> np.ndarray:
        """(dM,) whitened linearised data: the residual with all parameters at their prior mean."""
        taken = self.columns @ self.model.values
        return self.whitened((self.residual + taken)[..., None])[:, 0]


def priors(slots: tuple[Slot, ...]) -> np.ndarray:
    """(p,) prior standard deviations."""
    return np.array([s.parameter.width for s in slots], dtype=float)


def fit(
    model: Model,
    session: Session,
    *,
    sigma: np.ndarray | None = None,
    rho: float = 0.0,
    robust: bool = True,
    weights: np.ndarray | None = None,
    max_iterations: int = 25,
    close: float = CLOSE,
    begun: ModelFit | None = None,
) -> ModelFit:
    """Fit all free parameters of a model to one session.

    Args:
        model: starting point; its terms decide what is fitted.
        session: rows; lost markers are left out.
        sigma: (d,) noise per channel in m or rad; estimated from the residual, one for all
            channels of a kind and sensor, when not given.
        rho: correlation of the noise from one row to the next (in the order of the rows).
        robust: give outliers weight 0, anew at every step.
        weights: (N of seen rows,) fixed weights instead.
        max_iterations: bound on the Gauss-Newton steps.
        close: the last step must be below so many standard errors.
        begun: what `unfitted` returned of the same model and session, if it is known.

    Raises:
        InputError: fewer than four seen rows, or an input that a term needs is missing.
        JobError: the fit did not stay finite.
    """
    part = _SessionProblem.of(model, session, sigma, weights, robust, rho)
    if begun is not None:
        part.took(begun)
    return _fit_parts([part], max_iterations, close)[0]


def unfitted(model: Model, session: Session) -> ModelFit:
    """A model held against a session as it is: residual and design, nothing fitted yet."""
    part = _SessionProblem.of(model, session, None, None, False)
    part.look()
    part.weigh(settled=False)
    return part.fitted(np.diag(priors(model.slots) ** 2))


def fit_together(
    parts: Sequence[tuple[Model, Session]],
    own: Callable[[Slot], bool],
    *,
    max_iterations: int = 25,
) -> list[ModelFit]:
    """Fit several arms that share a part of their chain (two arms on one torso).

    Args:
        parts: a starting model and a session each.
        own: which parameters belong to each part alone; all others with the same label are
            one parameter.
        max_iterations: bound on the Gauss-Newton steps.

    Raises:
        InputError, JobError: as `fit`.
    """
    made = [_SessionProblem.of(model, session, None, None, True) for model, session in parts]
    return _fit_parts(made, max_iterations, CLOSE, own)


@dataclass
class _SessionProblem:
    """One session on its way through the Gauss-Newton steps."""

    model: Model
    seen: Session
    context: Context
    q: tuple[Scalar, ...]
    sigma: np.ndarray | None
    fixed: np.ndarray | None
    robust: bool
    weights: np.ndarray
    noise: np.ndarray
    residual: np.ndarray
    columns: np.ndarray
    effective: float = 0.0
    rho: float = 0.0
    posture: Posture | None = None
    looked: Model | None = None

    @classmethod
    def of(
        cls,
        model: Model,
        session: Session,
        sigma: np.ndarray | None,
        weights: np.ndarray | None,
        robust: bool,
        rho: float = 0.0,
    ) -> _SessionProblem:
        seen = session.take(session.seen)
        if len(seen) < 4:
            raise InputError(session.source, "xyz", f"{len(seen)} seen rows", "at least 4")
        context = seen.context()
        for term in model.terms:
            term.require(context)
        start = np.ones(len(seen)) if weights is None else np.asarray(weights, float)
        noise = np.full(len(seen.channels), np.nan) if sigma is None else np.asarray(sigma, float)
        empty = np.empty(0)
        return cls(
            dataclasses.replace(model, arrivals=seen.arrivals),
            seen,
            context,
            unstack(seen.q),
            sigma,
            weights,
            robust,
            start,
            noise,
            empty,
            empty,
            rho=rho,
        )

    def look(self) -> None:
        """Residual and design of the model as it is now."""
        if self.looked is self.model:
            return
        self.posture = self.model.posture(self.q, self.context)
        found = equations(self.model, self.seen, self.posture)
        self.residual, self.columns, self.looked = found.residual, found.columns, self.model
        if not (np.isfinite(self.residual).all() and np.isfinite(self.columns).all()):
            raise JobError("the fit did not stay finite", session=self.seen.source)

    def took(self, begun: ModelFit) -> None:
        """Residual and design as they were found before."""
        self.residual, self.columns, self.looked = begun.residual, begun.columns, self.model

    def fitted(
        self, covariance: np.ndarray, iterations: int = 0, converged: bool = False
    ) -> ModelFit:
        """The model as it is now."""
        found = ModelFit(
            self.model,
            self.seen,
            self.residual,
            self.columns,
            covariance,
            self.weights,
            self.noise,
            self.effective,
            iterations,
            converged,
            self.rho,
        )
        if self.posture is not None:
            found.__dict__["posture"] = self.posture
        return found

    def moved(self, values: np.ndarray) -> None:
        """Take other parameter values."""
        self.model = self.model.with_values(values)
        self.look()

    def cost(self) -> float:
        """Squared residual of the inliers in units of the noise."""
        white = whiten(self.residual[..., None], self.weights, self.noise, self.rho, self.seen.mask)
        return float((white**2).sum())

    def weigh(self, settled: bool) -> None:
        """Outliers and noise for the residual as it is now."""
        if self.robust and self.fixed is None:
            known = self.noise if settled else None
            self.weights = inliers(self.residual, known, self.seen.mask)
        if self.sigma is None:
            self.noise = self._common(self.spread())

    def spread(self) -> np.ndarray:
        """(d,) noise of every channel in the residual as it is now."""
        return spread(self.residual, self.weights, self.effective, self.seen.mask)

    def _common(self, sigma: np.ndarray) -> np.ndarray:
        """(d,) one figure for all channels of a kind and sensor."""
        made, start = [], 0
        for block in self.seen.blocks:
            mine = sigma[start : start + len(block.channels)]
            start += len(mine)
            held = mine[np.isfinite(mine)]
            common = np.sqrt((held**2).mean()) if len(held) else np.inf
            made.append(np.full(len(mine), common))
        return np.concatenate(made)

    def whitened(self, scale: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(dN, p) prior-scaled design and (dN,) linearised data, in units of the noise."""
        y = self.residual + self.columns @ (self.model.values - centre)
        both = np.concatenate([self.columns * scale, y[..., None]], axis=-1)
        white = whiten(both, self.weights, self.noise, self.rho, self.seen.mask)
        return white[:, :-1], white[:, -1]


def _fit_parts(
    parts: list[_SessionProblem],
    max_iterations: int,
    close: float,
    own: Callable[[Slot], bool] | None = None,
) -> list[ModelFit]:
    """Gauss-Newton on the posterior mode of all parts at once."""
    place: dict[tuple[object, ...], int] = {}
    maps, chosen = [], []
    for number, part in enumerate(parts):
        places = []
        for slot in part.model.slots:
            key = (*slot.identity, number if own is not None and own(slot) else -1)
            if key not in place:
                place[key] = len(place)
                chosen.append(slot)
            places.append(place[key])
        maps.append(np.array(places, dtype=int))
    scale = priors(tuple(chosen))
    now = np.array([getattr(s.owner, s.parameter.name) for s in chosen], dtype=float)
    centre = np.where([s.parameter.unknown for s in chosen], now, 0.0)
    lower = (np.array([s.parameter.lower for s in chosen]) - centre) / scale
    upper = (np.array([s.parameter.upper for s in chosen]) - centre) / scale
    converged, step = False, 0
    adapting = any(part.sigma is None or part.fixed is None for part in parts)
    for part in parts:
        part.look()
    posterior = linear.Posterior(np.zeros(0), np.zeros((0, 0)), 0.0)
    for step in range(1, max_iterations + 1):
        designs, data = [], []
        for part, mine in zip(parts, maps, strict=True):
            part.weigh(settled=step > 2)
            a, y = part.whitened(scale[mine], centre[mine])
            designs.append(_placed(a, mine, len(scale)))
            data.append(y)
        try:
            posterior = linear.solve(_joined(designs), _joined(data), lower, upper)
        except np.linalg.LinAlgError:
            rows = sum(len(part.seen) for part in parts)
            text = f"{rows} rows do not determine the {len(scale)} parameters of the model"
            raise JobError(text, session=parts[0].seen.source) from None
        goal = centre + posterior.u * scale
        small = np.abs(goal - now) <= close * np.sqrt(np.diag(posterior.covariance)) * scale
        now = _stepped(parts, maps, now, goal, centre, scale)
        for part in parts:
            part.effective = posterior.effective * len(part.seen) / sum(len(p.seen) for p in parts)
        if small.all() and (step > 2 or not adapting):
            converged = True
            break
    made = []
    for part, mine in zip(parts, maps, strict=True):
        if part.sigma is None:
            part.noise = part.spread()
        size = np.outer(scale[mine], scale[mine])
        covariance = posterior.covariance[np.ix_(mine, mine)] * size
        made.append(part.fitted(covariance, step, converged))
    return made


def _stepped(
    parts: list[_SessionProblem],
    maps: list[np.ndarray],
    now: np.ndarray,
    goal: np.ndarray,
    centre: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """Go towards a goal, all the way or as far as does not raise the cost; the values reached.

    Raises:
        JobError: the fit is not finite however short the step.
    """

    def cost(values: np.ndarray) -> float:
        return sum(p.cost() for p in parts) + float((((values - centre) / scale) ** 2).sum())

    def move(values: np.ndarray) -> None:
        for part, mine in zip(parts, maps, strict=True):
            part.moved(values[mine])

    before, share, failed = cost(now), 1.0, None
    while share > SHORTEST:
        values = now + share * (goal - now)
        try:
            move(values)
            if cost(values) <= (1.0 + WORSE) * before + 1.0:
                return values
        except JobError as error:
            failed = error
        share *= 0.5
    if failed is not None:
        raise failed
    move(now)
    return now


def _placed(columns: np.ndarray, places: np.ndarray, width: int) -> np.ndarray:
    """(m, k) columns of one part at their places among those of all parts, (m, width)."""
    if np.array_equal(places, np.arange(width)):
        return columns
    wide = np.zeros((len(columns), width))
    np.add.at(wide.T, places, columns.T)
    return wide


def _joined(blocks: list[np.ndarray]) -> np.ndarray:
    """Rows of all parts; those of a single one are not copied."""
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
