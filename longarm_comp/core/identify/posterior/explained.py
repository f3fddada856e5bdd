"""The explained session: the model with the effects that were found, fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from longarm_comp.core.calibration import noise as noise_step
from longarm_comp.core.calibration.candidates import Candidate, Term, distinct_terms
from longarm_comp.core.calibration.fit import fit_model, linearise_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import NoiseEstimate
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.intervals import LOOSE
from longarm_comp.core.identify.model_tolerance import RIGID, ModelTolerance
from longarm_comp.core.identify.posterior.found import NONE, FoundEffect, keys_of
from longarm_comp.core.identify.posterior.resampled import Resampling
from longarm_comp.core.model.model import Model

NEAR = 0.3
"""Size of the last step of a fit between rounds, in standard errors: a further step would be a
tenth of it or less. Only the final fit converges."""


@dataclass(frozen=True)
class ExplainedSession:
    """A model with the effects found in a session, fitted to it.

    Attributes:
        fit: the fitted model; at the end of the search also with the background compliance.
        found: the found effects in the model, with their credible sets.
        noise: the last estimate of the noise.
        doubtful: effects whose presence is in doubt; they are not in the model.
        candidates: the library as it was offered last.
        linear: the linear stage of the search, which can be repeated on other rows.
    """

    fit: ModelFit
    found: tuple[FoundEffect, ...]
    noise: NoiseEstimate
    doubtful: tuple[FoundEffect, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    tolerance: ModelTolerance = RIGID
    linear: Resampling | None = None

    @property
    def chosen_terms(self) -> tuple[Term, ...]:
        """The terms of all found effects, as they were offered."""
        return tuple(t for f in self.found for t in f.terms)

    @property
    def needed_evidence(self) -> float:
        """Log Bayes factor above which a candidate is more likely there than not."""
        return NONE + math.log(max(len(self.candidates), 1))


def judge_noise_and_fit(
    model: Model,
    session: Session,
    candidates: Sequence[Candidate],
    found: tuple[FoundEffect, ...] = (),
    before: ExplainedSession | None = None,
    *,
    known: NoiseEstimate | None = None,
) -> ExplainedSession:
    """Estimate the noise, then fit a model with this noise.

    The noise is estimated from the residual that would be left if the library explained as much as
    it can.

    Args:
        model: the model with the effects found.
        candidates: the library.
        found: the effects that the model holds besides the geometry.
        before: the last explained session, at whose fit the columns of the library are computed.
            Default: at a first fit of `model`.
        known: the noise by repeats, which is an upper limit.

    Raises:
        InputError, JobError: as `fit_model`.
    """
    if before is None or not found:
        first = fit_model(model, session)
        at = FitColumns(first)
    else:
        first, at = linearise_model(model, session, before.fit), FitColumns(before.fit)
    held = keys_of(found)
    judged, weights = noise_step.noise_from_residual(
        first, at.prior_columns(distinct_terms(candidates, held))
    )
    noise = judged if known is None else noise_step.limit_by_repeats(known, judged)
    fitted = fit_model(
        first.model,
        session,
        sigma=noise.sigma,
        rho=noise.rho,
        weights=weights,
        close=NEAR,
        begun=first,
    )
    return ExplainedSession(fitted, found, noise)


def drop_idle(fitted: ModelFit) -> ModelFit:
    """Return the fit without effects that act only through others, if none of these is there.

    For example, a mass moves the tip only through a part that yields under load.
    """
    model = fitted.model
    idle = {e.key for e in model.effects if e.through_others}
    if not idle or any(e.loaded for e in model.effects if e.key not in idle):
        return fitted
    return fit_model(model.without(idle), fitted.session, near=fitted, **fitted.noise_arguments)


def widen_prior(found: FoundEffect) -> FoundEffect:
    """Return a function without a name with a prior so wide that it hardly changes the amount.

    Its existence is decided already. A named effect is returned unchanged.
    """
    if not found.unnamed:
        return found
    terms = tuple(
        replace(t, scale=max(t.scale, LOOSE * abs(t.amount)))  # type: ignore
        for t in found.terms
    )
    return replace(found, terms=terms, loose=True)


def put_found(base: Model, now: Model, found: Sequence[FoundEffect]) -> Model:
    """Return the base model with found effects added; values are those in the model `now`."""
    known, alike = {t.key: t for t in now.terms}, {t.variant: t for t in now.terms}
    terms = (alike.get(t.variant, t) for f in found for t in f.terms)
    return base.with_terms([*(known.get(t.key, t) for t in base.terms), *terms])
