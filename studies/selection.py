"""Forward selection of families of effects on training rows, by blocked cross-validation.

A family is one effect in one form at every place it may have.  Each is tried on top of the model
so far with its columns at the present fit (one linear step per fold); the best is taken and
everything is refitted, for as long as the error on left-out rows falls by at least `WORTH`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify import linear
from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, library
from longarm_comp.core.identify.linear import whiten
from longarm_comp.core.identify.model_fit import ModelFit, priors

Term = Effect | Bias

WORTH = 0.15
"""A family must lower the cross-validated mean error by this share.

Less is not claimed: on an arm that is good to a tenth of a millimetre two or three quite different
families each take up a tenth of what is left, and none of them can be named.
"""
FOLDS = 5
BLOCKS = 25
MOST_FAMILIES = 8


def select(
    fits: Sequence[ModelFit],
    refit: Callable[[Sequence[tuple[Term, ...]]], Sequence[ModelFit]],
    progress: Callable[[str], None] | None = None,
) -> tuple[list[str], list[ModelFit]]:
    """Select the families that lower the error, and fit them.

    Args:
        fits: the model so far, one fit per part (arm); a part's rows are split in time.
        refit: fits all parts anew with further terms, one tuple per part.
        progress: called with the family that was added.

    Returns:
        Labels in the order taken, and the last fits.
    """
    taken: list[str] = []
    added: list[tuple[Term, ...]] = [() for _ in fits]
    current = list(fits)
    for _ in range(MOST_FAMILIES):
        menus = [_families(fit) for fit in current]
        shared = [label for label in menus[0] if all(label in menu for menu in menus)]
        views = [_View(fit) for fit in current]
        now = _pooled([view.left_out(()) for view in views])
        scores = {
            label: _pooled([v.left_out(m[label].terms) for v, m in zip(views, menus, strict=True)])
            for label in shared
        }
        if not scores:
            break
        best = min(scores, key=lambda label: scores[label])
        if scores[best] > (1.0 - WORTH) * now:
            break
        if progress is not None:
            progress(best)
        taken.append(best)
        added = [(*a, *m[best].terms) for a, m in zip(added, menus, strict=True)]
        current = list(refit(added))
    return taken, current


def _families(fit: ModelFit) -> dict[str, Candidate]:
    """Every effect that the rows can test, per form, at all its places together."""
    arm = fit.model.arm
    known = library(arm, fit.session.context(), declared=fit.model.terms)
    largest: dict[str, Candidate] = {}
    for candidate in known.testable:
        form = ", ".join(f"{k}={v}" for k, v in candidate.form)
        label = f"{candidate.name} ({form})" if form else candidate.name
        if label not in largest or len(candidate.terms) > len(largest[label].terms):
            largest[label] = candidate
    return {k: c for k, c in largest.items() if c.slots(arm)}


class _View:
    """One fit, linearised, and its rows in folds of whole blocks of time."""

    def __init__(self, fit: ModelFit) -> None:
        self.fit = fit
        seen = fit.session
        block = np.arange(len(seen)) * BLOCKS // len(seen)
        self.fold = np.random.default_rng(0).permutation(BLOCKS)[block] % FOLDS
        posture = fit.model.posture([seen.q[:, j] for j in range(seen.n)], seen.context())
        self.columns = CandidateColumns(fit.model, posture)
        self.data = fit.residual + fit.columns @ fit.model.values
        self.sigma = np.full(3, np.sqrt((fit.sigma**2).mean()))

    def left_out(self, terms: Sequence[Term]) -> np.ndarray:
        """(N,) length of the error of every row when its fold was not fitted, m."""
        design = np.concatenate(
            [self.fit.columns * priors(self.fit.slots), self.columns.of(terms)], axis=-1
        )
        slots = (*self.fit.slots, *Candidate("", tuple(terms)).slots(self.fit.model.arm))
        scale = priors(slots)
        lower = np.array([s.parameter.lower for s in slots]) / scale
        upper = np.array([s.parameter.upper for s in slots]) / scale
        length = np.empty(len(self.data))
        for number in range(FOLDS):
            mine = self.fold == number
            weights = np.where(mine, 0.0, self.fit.weights)
            rows = np.concatenate([design, self.data[..., None]], axis=-1)
            white = whiten(rows, weights, self.sigma, 0.0)
            u = linear.solve(white[:, :-1], white[:, -1], lower, upper).u
            length[mine] = np.linalg.norm(self.data[mine] - design[mine] @ u, axis=1)
        return length


def _pooled(lengths: Sequence[np.ndarray]) -> float:
    return float(np.concatenate(lengths).mean())
