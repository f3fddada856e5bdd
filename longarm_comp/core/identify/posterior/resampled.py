"""The posterior over explanations, averaged over resampled rows.

If the true cause is not in the library, a single posterior is overconfident in the most similar
wrong name, and which name that is changes from sample to sample.  Averaged over samples of whole
blocks of rows, drawn with replacement, it tells what another session of this size would tell
(Huggins and Miller 2023, "Reproducible model choice using bagged posteriors", Bayesian Analysis 18,
arXiv 2007.14845).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.holdout import draw_row_counts
from longarm_comp.core.identify.model_tolerance import ModelTolerance
from longarm_comp.core.identify.posterior.found import (
    FoundEffect,
    PossibleCause,
    ProposedFunction,
    keys_of,
)
from longarm_comp.core.identify.posterior.offers import make_offers

SAMPLES = 12
"""Number of samples of the rows. The standard error of a probability is then at most 0.15."""
SAME_ROLE = 0.5
"""Squared correlation of the shifts of two effects (geometry projected out) from which on the one
counts as a replacement of the other."""


@dataclass(frozen=True)
class Resampling:
    """A finished search, whose linear stage may be repeated on other rows.

    Attributes:
        fit: the fit of the geometry and the found effects, without the background compliance.
        candidates, functions: the library and the functions without a name on offer.
        of_halves: the effects found by a search on each half of the rows.
    """

    fit: ModelFit
    candidates: Sequence[Candidate]
    functions: Sequence[ProposedFunction]
    found: Sequence[FoundEffect]
    tolerance: ModelTolerance
    of_halves: Sequence[Sequence[FoundEffect]] = ()

    def explain_sample(self, counts: np.ndarray) -> tuple[FoundEffect, ...]:
        """Find the effects that explain the rows if each row counts `counts` (N,) times.

        The search starts without effects and from the found ones; the better explanation is kept.
        """
        (bank,) = make_offers(
            self.fit, self.candidates, self.functions, self.found, [self.tolerance], counts=counts
        )
        return bank.find_with_names()

    def average_samples(self, seed: int) -> tuple[FoundEffect, ...]:
        """Return the found effects with probabilities averaged over samples of the rows.

        Averaged are the presence of each effect and the probabilities of its names.
        """
        if not self.found:
            return ()
        whole = self.explain_sample(np.ones(len(self.fit.session)))
        samples = [self.explain_sample(c) for c in draw_row_counts(self.fit.session, SAMPLES, seed)]
        every = [*samples, *self.of_halves]
        return tuple(self._average_effect(f, whole, every) for f in self.found)

    def _average_effect(
        self,
        found: FoundEffect,
        whole: Sequence[FoundEffect],
        samples: Sequence[Sequence[FoundEffect]],
    ) -> FoundEffect:
        """Return an effect with its presence and names averaged over the samples.

        The columns are linearised. If fits of all rows made a name likelier than its columns did,
        the same factor is applied in each sample.  The search on a half of the rows gives one name
        only. If this name is in the effect's credible set, the names of all rows are taken instead.
        The halves come last in `samples`; `whole` explains all rows by columns.
        """
        there, chances = 0.0, dict.fromkeys(found.names, 0.0)
        linear = self._in_its_place(found, whole)
        by_columns = {} if linear is None else linear.names
        correction = {n: p / by_columns[n] for n, p in found.names.items() if by_columns.get(n)}
        named = {c.name: c.candidate for c in found.causes}
        for n, effects in enumerate(samples):
            other = self._in_its_place(found, effects)
            if other is None:
                continue
            if n >= SAMPLES and linear is not None and other.name in found.credible:
                other = replace(linear, presence=other.presence)
            there += other.presence / len(samples)
            theirs = {c.name: c.candidate for c in other.causes}
            likely = {name: p * correction.get(name, 1.0) for name, p in other.names.items()}
            for name, chance in likely.items():
                share = other.presence * chance / sum(likely.values())
                chances[name] = chances.get(name, 0.0) + share / len(samples)
                named.setdefault(name, theirs[name])
        total = sum(chances.values())
        if not total:
            return replace(found, presence=0.0)
        own = max(chances[found.name], 1e-300)
        causes = {c.name: c for c in found.causes}
        for name in sorted(named):
            factor = found.log_bayes_factor + math.log(max(chances[name], 1e-300) / own)
            cause = causes.pop(name, PossibleCause(named[name], factor))
            causes[name] = replace(cause, probability=chances[name] / total)
        first = causes.pop(found.name)
        return replace(found.put_first(first, causes.values()), presence=min(there, found.presence))

    def _in_its_place(
        self, found: FoundEffect, effects: Sequence[FoundEffect]
    ) -> FoundEffect | None:
        """Return the effect in `effects` that moves the rows as `found` does, or None.

        Effects that may have its name come first, and are taken together: one sample may find them
        joint by joint, and another one at all joints.
        """
        mine, shares = self._shift_rows(found.terms), {}
        for e in effects:
            theirs = self._shift_rows(e.terms)
            sizes = np.linalg.norm(mine) * np.linalg.norm(theirs)
            shares[e] = float(mine @ theirs / max(sizes, 1e-300)) ** 2
        namesakes = [e for e in effects if found.name in e.credible]
        each = [self._shift_rows((t,)) for e in namesakes for t in e.terms]
        explained = 0.0
        if each:
            columns = np.stack(each, axis=1)
            left = mine - columns @ np.linalg.lstsq(columns, mine, rcond=None)[0]
            explained = 1.0 - float(left @ left / max(mine @ mine, 1e-300))
        if explained >= SAME_ROLE:
            missing = math.prod(1.0 - e.presence for e in namesakes)
            return replace(max(namesakes, key=shares.__getitem__), presence=1.0 - missing)
        alike = [e for e, share in shares.items() if share >= SAME_ROLE]
        return max(alike, key=shares.__getitem__, default=None)

    @cached_property
    def _geometry(self) -> Marginal:
        return FitColumns(self.fit).marginal_without(keys_of(self.found))

    def _shift_rows(self, terms: Sequence[Term]) -> np.ndarray:
        """Return the (m,) whitened shift of the rows by terms, less what geometry can explain."""
        shift = FitColumns(self.fit).shift_by(terms)
        return self._geometry.project(self.fit.whiten_columns(shift[..., None]))[:, 0]
