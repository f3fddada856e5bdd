"""Which model is written: the one with the least error that a command may expect of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.found import FoundEffect


def expected_commanded(
    fits: Mapping[str, ModelFit], found: Sequence[FoundEffect]
) -> dict[str, float]:
    """RMS error (m) of a command by each model, expected under the posterior.

    By the rows that were fitted.  A row's residual is what the model leaves there, less the share
    that the fit took: twice the variance of the prediction is added, which is what it misses on a
    new row (Mallows' C_p).  What the measuring side is said to do moves what is seen, not the tip,
    with the probability that it is the measuring side that does it; otherwise a command errs by it.

    Args:
        fits: by name, on the same rows.
        found: single effects of the fullest of them.
    """
    ours = 1.0
    for f in found:
        if isinstance(f.terms[0], Bias):
            ours *= f.there * dict(f.names).get(f.name, 0.0)
    return {name: _expected(fit, ours) for name, fit in fits.items()}


def _expected(fit: ModelFit, measuring_side: float) -> float:
    rows = fit.session.take(fit.weights > 0)
    seen, told = errors(fit.model, rows), commanded_errors(fit.model, rows)
    square = measuring_side * (seen**2).sum(1) + (1.0 - measuring_side) * (told**2).sum(1)
    columns = fit.columns[fit.weights > 0] * fit.metres[:, None]
    variance = np.einsum("nip,pq,niq->n", columns, fit.covariance, columns, optimize=True)
    return float(np.sqrt(square.mean() + 2.0 * variance.mean()))


def least(expected: Mapping[str, float]) -> str:
    """The model to write; of equals the plainer one, which comes first."""
    return min(expected, key=lambda name: expected[name])
