"""Chooses the poses to measure next: those at which two explanations disagree most."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.model.model import Slot, unstack
from longarm_comp.core.planning.optimal_poses import POOL, Choice, alternate_sides


@dataclass(frozen=True, eq=False)
class SplittingPoses(Plan):
    """Poses that would tell two explanations apart, some of them with a payload.

    It is the largest payload of the session, or the declared one if that is larger.
    """

    between: tuple[str, str] = ("", "")  # names of the two effects
    log_bayes_factor: float = 0.0  # expected log odds once they are measured too


def choose_splitting_poses(
    fit: ModelFit, found: Candidate, other: Candidate, count: int, seed: int = 0
) -> SplittingPoses:
    """Choose, one by one, the poses that determine best how large the found effect is.

    Geometry and the other effect are free parameters beside it.

    Args:
        fit: a fit of a model with the found effect.
        found: the effect in the model.
        other: the effect that may be the true one instead.
        count: number of poses to choose.
    """
    arm = fit.model.arm
    from scipy.stats import qmc  # takes a quarter of a second

    unit = qmc.Sobol(arm.n, seed=seed).random(POOL)
    q = arm.lower + (arm.upper - arm.lower) * unit
    side = alternate_sides(POOL)
    recorded = fit.session.context().columns
    typical = {k: np.full(POOL, float(np.median(v))) for k, v in recorded.items()}
    declared = arm.payload.mass_kg if arm.payload is not None else 0.0
    heaviest = float(np.max(recorded.get("payload_kg", 0.0), initial=declared))
    if heaviest > 0:
        typical["payload_kg"] = np.where(np.arange(POOL) // 2 % 2 == 0, heaviest, 0.0)
    pool = Context(tuple(side for _ in range(arm.n)), typical)
    at = fit.model.posture(unstack(q), pool)

    def compute_columns(slots: Sequence[Slot]) -> np.ndarray:
        return make_equations(fit.model, fit.session, slots, at=fit.posture).columns

    theirs, mine = map(fit.whiten_columns, _compute_designs(fit, found, other, compute_columns))
    far, shift = _compute_designs(fit, found, other, lambda slots: fit.model.columns(at, slots)[1])
    if fit.session.blocks[0].kind == "position":  # an axis without noise has the smallest
        noise = np.where(np.isfinite(fit.sigma[:3]), fit.sigma[:3], np.min(fit.sigma[:3]))
    else:
        lengths = (fit.sigma * fit.metres)[(fit.metres > 0) & np.isfinite(fit.sigma)]
        noise = np.full(3, np.min(lengths))
    own = np.concatenate([theirs, mine], axis=1)
    information = own.T @ own + np.eye(own.shape[1])
    amount = np.zeros_like(information)
    amount[-1, -1] = 1.0
    choice = Choice(np.concatenate([far, shift], axis=2) / noise[:, None], information, amount)
    chosen = choice.add_best([], count)
    odds = 0.5 * (1.0 / choice.covariance(chosen)[-1, -1] - 1.0)  # less the prior's part
    payload = typical["payload_kg"][chosen] if heaviest > 0 else None
    between = (found.name, other.name)
    return SplittingPoses(q[chosen], side[chosen], payload, None, between, float(odds))


def _compute_designs(
    fit: ModelFit, found: Candidate, other: Candidate, of: Callable[[Sequence[Slot]], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns of all other parameters, and the shift (N, d, 1) by the found effect.

    The columns are (N, d, p), per prior width; the other effect's parameters come last. ``of``
    returns the columns (N, d, k) of parameters.
    """
    places = {t.key for t in found.terms}
    rest = tuple(s for s in fit.slots if s.owner.key not in places)
    rest += other.slots(fit.model.arm)
    own = [s for s in fit.slots if s.owner.key in places]
    values = np.array([s.value for s in own])
    return of(rest) * prior_widths(rest), (of(own) @ values)[..., None]
