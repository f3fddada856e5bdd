"""Robust fit of a model to a session: geometry and effects are fitted at the same time.

Gauss-Newton iteration to the posterior mode. If a step would raise the cost by more than `AMISS`,
points of a parabola that follows the curvature of the model are tried instead (geodesic
acceleration; Transtrum and Sethna 2012, arXiv 1201.5885). Strong curvature is common, because often
the rows determine only the product of a load and the compliance under it. If this does not help,
the step is damped (Levenberg 1944, Marquardt 1963). Every parameter has a prior (a tolerance),
which makes the fit of a redundant geometry unique. The prior of an unknown placement is centred on
its start, so parameters that the rows do not determine stay there. Bounds are kept exactly.
Outliers get weight 0, decided anew at every step but the first, in which all rows count.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.model_fit import ModelFit, bounds_of, prior_widths
from longarm_comp.core.calibration.session_problem import SessionProblem
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model, Slot

CLOSE = 0.01
"""A fit has converged when its last step was at most this many standard errors."""
SHARES = (1.0, 0.5, 0.25)
"""Points that are tried on the parabola of geodesic acceleration, as fractions of the whole step.

While the noise is not known, only the first is tried. The solution of the linearised problem is
then far away, and a damped step comes nearer to it.
"""
LEAST_DAMPING, MOST_DAMPING, DAMPING_FACTOR = 1e-6, 1e3, 30.0
"""Smallest and largest damping, and the factor from one damping to the next.

The damping times the diagonal of the normal equations is added to this diagonal.
"""
STALLED = 3
"""Number of steps without gain after which a fit ends with its best values.

If loads and compliances are fitted together, steps may circle around the solution for ever.
"""
GAUSS_NEWTON_STEPS = 25
"""Largest number of steps; fits of simulated arms take one to six."""
GAIN = 0.1
"""Smallest decrease of the cost (minus twice the log posterior) that counts as a gain."""
AMISS = 1.0
"""Largest accepted excess of the cost, which is in units of the noise.

If the cost exceeds the prediction of the design by more, the design is computed anew; if it rises
by more, the step is shortened.
"""


def fit_model(
    model: Model,
    session: Session,
    *,
    sigma: np.ndarray | None = None,
    rho: float = 0.0,
    robust: bool = True,
    weights: np.ndarray | None = None,
    close: float = CLOSE,
    begun: ModelFit | None = None,
    near: ModelFit | None = None,
    usual: Mapping[str, float] | None = None,
) -> ModelFit:
    """Fit all free parameters of a model to one session.

    Args:
        model: starting point; its terms decide what is fitted.
        session: the rows; those in which nothing was measured are left out.
        sigma: (d,) noise per channel in m or rad. By default it is estimated from the residual, one
            value for all channels of the same kind and sensor.
        rho: correlation of the noise from one row to the next (in the order of the rows).
        robust: give outliers weight 0, decided anew at every step.
        weights: fixed weights, one for each row that is not left out; `robust` is then ignored.
        close: the fit ends when a step is below this many standard errors. If it is more than
            `CLOSE`, the design may be that of the values before the last step.
        begun: a fit of the same model to the same session, whose residual and design are reused.
        near: a fit of a similar model to the same session, from whose posture the loads start.
        usual: noise that is known of arms of this kind, m or rad, by kind of measurement.

    Raises:
        InputError: fewer than four rows are left, a measured point is too far from the origin, or a
            term lacks an input.
        JobError: the rows do not determine the parameters, or the fit did not stay finite.
    """
    part = SessionProblem(model, session, sigma, weights, robust, rho, usual, begun, near)
    return _fit_parts([part], close)[0]


def linearise_model(model: Model, session: Session, near: ModelFit | None = None) -> ModelFit:
    """Return the residual and design of a model at a session as a `ModelFit`, without a fit.

    Args:
        near: a fit of a similar model to the same session, from whose posture the loads start.
    """
    part = SessionProblem(model, session, robust=False, near=near)
    part.judge_rows(1)
    return part.make_fit(np.diag(prior_widths(model.slots) ** 2))


def fit_together(
    parts: Sequence[tuple[Model, Session]], own: Callable[[Slot], bool]
) -> list[ModelFit]:
    """Fit several arms that share a part of their chain, such as two arms on one torso.

    Errors are those of `fit_model`.

    Args:
        parts: the starting model and the session of each arm.
        own: tells whether a parameter belongs to one arm alone; all other parameters with the same
            identity are one common parameter.
    """
    return _fit_parts([SessionProblem(model, session) for model, session in parts], CLOSE, own)


def _fit_parts(
    parts: list[SessionProblem], close: float, own: Callable[[Slot], bool] = lambda slot: False
) -> list[ModelFit]:
    """Find the joint posterior mode of all sessions by Gauss-Newton, as `fit_together`."""
    problem = _JointProblem(parts, own)
    scale, centre, now = problem.scale, problem.centre, problem.start
    converged, step = False, 0
    cost, best, least, stalled = np.inf, now, np.inf, 0
    for step in range(1, GAUSS_NEWTON_STEPS + 1):
        for part in parts:
            part.judge_rows(step)
        try:
            gram, moment, square = problem.normal_equations()
            posterior = linear.solve_products(gram, moment, *problem.bounds)
        except np.linalg.LinAlgError:
            rows = sum(len(part.seen) for part in parts)
            text = f"{rows} rows do not determine the {len(scale)} parameters of the model"
            raise JobError(text, session=parts[0].seen.source) from None
        goal = np.clip(centre + posterior.u * scale, *problem.limits)
        error = np.sqrt(np.diag(posterior.covariance)) * scale
        step_size = np.abs(goal - now) / error
        expected = square + posterior.u @ (gram @ posterior.u + posterior.u - 2.0 * moment)
        near = bool((step_size <= 1.0).all())
        if not problem.knows_noise:  # costs of two steps are of two noises
            best, least = now, problem.compute_cost(now)
        now, cost = problem.step_towards(goal, now, gram, moment, near, close * error)
        holds = near and cost <= expected + AMISS
        for part in parts:
            part.effective = posterior.effective * len(part.seen) / sum(len(p.seen) for p in parts)
            if not holds:
                part.update_design()
        if holds and (step_size <= close).all() and (step > 2 or problem.knows_noise):
            converged = True
            break
        stalled = 0 if cost < least - GAIN else stalled + 1
        if cost < least:
            best, least = now, cost
        if stalled == STALLED:
            break
    back = not converged and cost > least + GAIN
    if back or close <= CLOSE:
        for part in parts:
            if back:
                part.move_to(best[part.own_places], close=False)
            part.update_design()
        posterior = linear.solve_products(*problem.normal_equations()[:2])
    covariance = posterior.covariance * np.outer(scale, scale)
    for part in parts:
        if part.sigma is None:
            part.noise = part.estimate_noise()
    return [
        p.make_fit(covariance[np.ix_(p.own_places, p.own_places)], step, converged) for p in parts
    ]


class _JointProblem:
    """Sessions that are fitted together, and their p parameters.

    Attributes:
        start: (p,) values at the start.
        scale, centre: (p,) standard deviations and means of the priors.
        limits: (2, p) bounds of the values. Values are clipped to them, because rounding may
            exceed them and files refuse such values.
        bounds: (2, p) the bounds relative to `centre`, in units of `scale`.
        knows_noise: whether noise and weights of all sessions are given.
        damping: damping of the next damped step; 0: undamped steps are tried first.
    """

    def __init__(self, parts: Sequence[SessionProblem], own: Callable[[Slot], bool]) -> None:
        self.parts = parts
        place: dict[tuple[object, ...], int] = {}
        slots: list[Slot] = []
        for number, part in enumerate(parts):
            places = []
            for slot in part.model.slots:
                key = (*slot.identity, number if own(slot) else -1)
                if key not in place:
                    place[key] = len(place)
                    slots.append(slot)
                places.append(place[key])
            part.own_places = np.array(places, dtype=int)
        self.start = np.array([s.value for s in slots], dtype=float)
        self.scale = prior_widths(tuple(slots))
        self.centre = np.where([s.parameter.unknown for s in slots], self.start, 0.0)
        self.limits = bounds_of(slots)
        self.bounds = (self.limits - self.centre) / self.scale
        self.knows_noise = all(p.sigma is not None and p.fixed is not None for p in parts)
        self.damping = 0.0

    def normal_equations(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the matrix (p, p) and right side (p,) in units of the priors, and the data's norm.

        The latter is the squared norm of the whitened data.
        """
        p = len(self.scale)
        gram, moment, square = np.zeros((p, p)), np.zeros(p), 0.0
        for part in self.parts:
            a, y = part.linearise_rows(self.scale[part.own_places], self.centre[part.own_places])
            gram[np.ix_(part.own_places, part.own_places)] += a.T @ a
            moment[part.own_places] += a.T @ y
            square += float(y @ y)
        return gram, moment, square

    def compute_cost(self, values: np.ndarray) -> float:
        prior = (((values - self.centre) / self.scale) ** 2).sum()
        return sum(part.compute_cost() for part in self.parts) + float(prior)

    def _move_to(self, values: np.ndarray, near: bool) -> None:
        for part in self.parts:
            part.move_to(values[part.own_places], near)

    def step_towards(
        self,
        goal: np.ndarray,
        now: np.ndarray,
        gram: np.ndarray,
        moment: np.ndarray,
        near: bool,
        least: np.ndarray,
    ) -> tuple[np.ndarray, float]:
        """Move the values towards a goal (p,) without raising the cost.

        The whole step is tried first, then points of the parabola that follows the model's
        curvature, then damped steps, which are shortest in directions that the rows determine
        least.

        Args:
            goal: (p,) values that solve the normal equations.
            now: (p,) present values.
            gram, moment: the normal equations.
            near: whether the goal is near; then fewer load passes are needed.
            least: (p,) steps that are at most this large are not tried, except the goal itself.

        Returns:
            The values (p,) that were reached, and their cost.

        Raises:
            JobError: the residual is not finite after any step that was tried.
        """
        before, failed = self.compute_cost(now), None
        for values in self._list_steps(goal, now, gram, moment, near):
            if values is not goal and (np.abs(values - now) <= least).all():
                break
            try:
                self._move_to(values, near)
                after = self.compute_cost(values)
                if after <= before + AMISS:
                    damping = self.damping / DAMPING_FACTOR
                    self.damping = damping if damping >= LEAST_DAMPING else 0.0
                    return values, after
            except JobError as error:
                failed = error
        if failed is not None:
            raise failed
        self.damping = 0.0
        self._move_to(now, near)
        return now, before

    def _list_steps(
        self, goal: np.ndarray, now: np.ndarray, gram: np.ndarray, moment: np.ndarray, near: bool
    ) -> Iterator[np.ndarray]:
        """Yield the values (p,) to try, in the order that `step_towards` describes."""
        if self.damping == 0.0:
            yield goal
            aside, bend = np.zeros(len(now)), np.zeros(len(now))
            with contextlib.suppress(JobError):
                self._move_to(now, near)
                for part in self.parts:
                    step, scale = (x[part.own_places] for x in (goal - now, self.scale))
                    bend[part.own_places] += part.project_curvature(step, scale, near)
                aside = self._solve_within(gram, moment - bend) - goal
            for share in SHARES if self.knows_noise else SHARES[:1]:
                yield np.clip(now + share * (goal - now) + share**2 * aside, *self.limits)
        begun, diagonal = (now - self.centre) / self.scale, np.diag(gram) + 1.0
        self.damping = max(self.damping, LEAST_DAMPING)
        while self.damping <= MOST_DAMPING:
            damped = self.damping * diagonal
            yield self._solve_within(gram + np.diag(damped), moment + damped * begun)
            self.damping *= DAMPING_FACTOR

    def _solve_within(self, gram: np.ndarray, moment: np.ndarray) -> np.ndarray:
        u = linear.solve_products(gram, moment, *self.bounds).u
        return np.clip(self.centre + u * self.scale, *self.limits)
