"""Finds the length of run-ups if a session holds only their side; errors may depend on the length.

One length holds for the whole session. It is no parameter of a fit, so it is found before the
search: the length of highest evidence, with all other effects of the library in the model.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SLIDE
from longarm_comp.core.calibration.candidates import Candidate, distinct_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import Marginal, marginalise_first
from longarm_comp.core.calibration.model_fit import prior_widths
from longarm_comp.core.calibration.noise import noise_from_residual
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.posterior.found import NONE
from longarm_comp.core.model.model import Model, slots_of

RUN_UPS = (0.02, 0.035, 0.05, 0.07, 0.1)
"""Lengths that are tried, rad. A slide moves by the number times `SLIDE`, in m. Data hardly
distinguish lengths within a factor of 1.5."""


def remembers_run_up(term: Effect | Bias) -> bool:
    """Tell whether an effect depends on the length of unrecorded run-ups, in its form `run_up`."""
    return isinstance(term, Effect) and "run_up" in term.forms


def with_run_ups(session: Session, arm: Arm, run_up: float) -> Session:
    """Return the session with a length (rad) for all run-ups whose length was not recorded.

    Slides move by the number times `SLIDE`, in m.
    """
    return session.with_run_ups(run_up * np.where(arm.slides, SLIDE, 1.0))


def with_fitted_run_ups(session: Session, model: Model) -> Session:
    """Set run-ups of unrecorded length to the longest of the model's effects, if there is one."""
    taken = (float(e.forms["run_up"]) for e in model.effects if remembers_run_up(e))
    longest = max(taken, default=0.0)
    return with_run_ups(session, model.arm, longest) if longest else session


def set_run_up(candidates: Iterable[Candidate], run_up: float) -> tuple[Candidate, ...]:
    """Return the candidates with the form `run_up` set to a length (rad), where they have it."""
    forms: dict[str, Any] = {"run_up": run_up}
    made = []
    for c in candidates:
        terms = (dataclasses.replace(t, **forms) if remembers_run_up(t) else t for t in c.terms)
        made.append(Candidate(c.name, tuple(terms)))
    return tuple(made)


def find_run_up(
    model: Model, rows: Callable[[float], Session], candidates: Sequence[Candidate]
) -> float:
    """Return the run-up length (rad) of highest evidence; 0 if the data do not show a length.

    Args:
        model: the model with its geometry, fitted or not.
        rows: returns the rows to fit for a length (rad) of unrecorded run-ups.
        candidates: the library.
    """
    families = [tuple(t for t in c.terms if remembers_run_up(t)) for c in candidates]
    terms = max(families, key=len, default=())
    if not terms or not rows(0.0).told.any():
        return 0.0
    fitted = fit_model(model, rows(0.0))
    columns = FitColumns(fitted)
    others = columns.prior_columns(distinct_terms(candidates, {t.key for t in terms}))
    noise, weights = noise_from_residual(
        fitted, np.concatenate([others, columns.prior_columns(terms)], axis=-1)
    )
    fitted = dataclasses.replace(fitted, sigma=noise.sigma, rho=noise.rho, weights=weights)
    design = np.concatenate([fitted.design, fitted.whiten_columns(others)], axis=1)
    marginal, slots = Marginal(design, fitted.data), slots_of(fitted.model.arm, terms)

    def evidence(length: float) -> float:
        """Compute the log evidence of a length; the posture, which it hardly changes, is kept."""
        session = rows(length)
        seen = session.take(session.seen)
        at = dataclasses.replace(fitted.posture, context=seen.context())
        found = make_equations(fitted.model, seen, slots, at=at).columns * prior_widths(slots)
        products = marginal.project_products(fitted.whiten_columns(found))
        return marginalise_first(*products, np.ones(len(slots)))[0]

    best = max(RUN_UPS, key=evidence)
    needed = evidence(0.0) + NONE + math.log(len(RUN_UPS))
    return best if evidence(best) > needed else 0.0
