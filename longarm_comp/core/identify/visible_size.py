"""How large a candidate must be before the data show it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, distinct
from longarm_comp.core.identify.evidence import (
    IMPLAUSIBLE,
    FitColumns,
    FitMarginal,
    columns_at,
    rms_shift,
    score,
)
from longarm_comp.core.identify.model_fit import ModelFit


@dataclass(frozen=True)
class Smallest:
    """The smallest size of a candidate that would be accepted.

    Attributes:
        candidate: the hypothesis.
        log_bayes_factor: what it scores on these data.
        size: in its prior standard deviations; infinite where no size could be seen.
        shift_m: RMS shift of the tip that this size stands for, m; infinite as `size`.
    """

    candidate: Candidate
    log_bayes_factor: float
    size: float
    shift_m: float

    @property
    def visible(self) -> bool:
        """Whether a plausible size would have shown."""
        return self.size <= IMPLAUSIBLE


def smallest(
    fit: ModelFit,
    marginal: FitMarginal,
    columns: FitColumns,
    candidate: Candidate,
    threshold: float,
) -> Smallest:
    """Smallest size whose expected log Bayes factor reaches the threshold, noise apart.

    With ``S = B'PB`` of the k prior-scaled columns, parameters drawn with a standard deviation
    of c priors give ``E[t'(I+S)^-1 t] = c^2 tr(S (I+S)^-1 S)``; c solves
    ``c^2 tr(S (I+S)^-1 S) / 2 - ln|I+S| / 2 = threshold``.  An effect without parameters has
    one size: it is seen or not.

    Args:
        fit: whose rows, noise and weights count.
        marginal: what is in the model already.
        columns: of candidates at the fit's rows.
        candidate: the hypothesis.
        threshold: log Bayes factor to reach.
    """
    scored = score(fit, marginal, candidate, columns).log_bayes_factor
    if candidate.slots(fit.model.arm):
        raw = columns.of(candidate.terms)
    else:
        raw = columns.shift(candidate.terms)[..., None]
    b = fit.whitened(raw)
    s = b.T @ marginal.project(b)
    values = np.clip(np.linalg.eigvalsh((s + s.T) / 2), 0.0, None)
    if candidate.slots(fit.model.arm):
        gain = float((values**2 / (1.0 + values)).sum())
        need = 2.0 * threshold + float(np.log1p(values).sum())
        size = math.sqrt(need / gain) if gain > 1e-12 else math.inf
    else:
        size = 1.0 if values.sum() / 2.0 >= threshold else math.inf
    length = rms_shift(fit, raw)
    return Smallest(candidate, scored, size, size * length if length else math.inf)


def detectable(
    fit: ModelFit, candidates: Sequence[Candidate], threshold: float
) -> tuple[Smallest, ...]:
    """`smallest` of candidates on top of everything that was fitted, in the order given."""
    columns, marginal = columns_at(fit), FitMarginal(fit)
    columns.prepare(distinct(candidates))
    return tuple(smallest(fit, marginal, columns, c, threshold) for c in candidates)
