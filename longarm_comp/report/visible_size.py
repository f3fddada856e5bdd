"""How large a candidate must be before the data show it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit_columns import FitColumns, rms_shift
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.plausible import INCREDIBLE
from longarm_comp.core.identify.posterior.offers import evidence_of_each


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
        return self.size <= INCREDIBLE


def detectable(
    fit: ModelFit, candidates: Sequence[Candidate], threshold: float
) -> tuple[Smallest, ...]:
    """Of candidates on top of everything that was fitted, in the order given.

    The smallest size is the one whose expected log Bayes factor reaches the threshold, noise apart.
    With ``S = B'PB`` of the k prior-scaled columns, parameters drawn with a standard deviation
    of c priors give ``E[t'(I+S)^-1 t] = c^2 tr(S (I+S)^-1 S)``; c solves
    ``c^2 tr(S (I+S)^-1 S) / 2 - ln|I+S| / 2 = threshold``.  An effect without parameters has
    one size: it is seen or not.

    Args:
        fit: whose rows, noise and weights count.
        candidates: the hypotheses.
        threshold: log Bayes factor to reach.
    """
    columns = FitColumns(fit)
    marginal = columns.without(())
    worth = evidence_of_each(fit, marginal, candidates).tolist()
    made = []
    for candidate, factor in zip(candidates, worth, strict=True):
        free = candidate.slots(fit.model.arm)
        raw = columns.of(candidate.terms) if free else columns.shift(candidate.terms)[..., None]
        b = fit.whitened(raw)
        s = b.T @ marginal.project(b)
        values = np.clip(np.linalg.eigvalsh((s + s.T) / 2), 0.0, None)
        gain = float((values**2 / (1.0 + values)).sum())
        if not free:
            size = 1.0 if values.sum() / 2.0 >= threshold else math.inf
        elif gain > 1e-12:
            size = math.sqrt((2.0 * threshold + float(np.log1p(values).sum())) / gain)
        else:
            size = math.inf
        length = rms_shift(fit, raw)
        made.append(Smallest(candidate, factor, size, size * length if length else math.inf))
    return tuple(made)
