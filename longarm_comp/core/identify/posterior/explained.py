"""The explained session: the model with the effects that were found, fitted."""

import math
from dataclasses import dataclass, replace

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import NoiseEstimate
from longarm_comp.core.identify.intervals import LOOSE
from longarm_comp.core.identify.model_tolerance import RIGID, ModelTolerance
from longarm_comp.core.identify.posterior.found import NONE, FoundEffect
from longarm_comp.core.identify.posterior.resampled import Resampling

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
        tolerance: the likeliest model tolerance.
        resampling: its linear stage, which can be repeated on other rows.
    """

    fit: ModelFit
    found: tuple[FoundEffect, ...]
    noise: NoiseEstimate
    doubtful: tuple[FoundEffect, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    tolerance: ModelTolerance = RIGID
    resampling: Resampling | None = None

    @property
    def chosen_terms(self) -> tuple[Term, ...]:
        """The terms of all found effects, as they were offered."""
        return tuple(t for f in self.found for t in f.terms)

    @property
    def needed_evidence(self) -> float:
        """Log Bayes factor above which a candidate is more likely there than not."""
        return NONE + math.log(max(len(self.candidates), 1))


def widen_prior(found: FoundEffect) -> FoundEffect:
    """Return a function without a name with a prior so wide that it hardly changes the amount.

    Its existence is decided already. A named effect is returned unchanged.
    """
    if not found.unnamed:
        return found
    terms = (
        replace(t, scale=max(t.scale, LOOSE * abs(t.amount)))  # type: ignore
        for t in found.terms
    )
    return found.with_terms(terms, loose=True)
